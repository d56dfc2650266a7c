//! A report of tables, charts and words: said once, then printed, and written as a page, as CSV and as JSON.

mod data_table;
mod page;

use std::path::Path;

use anyhow::Context;
use maud::Markup;
use serde::Serialize;
use serde_json::{Map, Value, json};

use crate::json_file;
use crate::program::command_line;
pub use data_table::{Cell, Column, DataTable};

/// A report.
#[derive(Default)]
pub struct Document {
    /// What it is of.
    pub title: String,
    /// How it was made, in a line under the title of the text.
    pub about: String,
    /// Verdicts at the top of the page and the end of the text: whether it is good, and in what words.
    pub verdicts: Vec<(bool, String)>,
    /// Its parts.
    pub sections: Vec<Section>,
    /// The text leaves out the titles of sections: its tables say by themselves what they are.
    pub is_plain: bool,
    /// What the JSON holds beside the tables.
    pub facts: Map<String, Value>,
}

/// One part of a report. The id is its anchor in the page.
pub struct Section {
    pub id: &'static str,
    pub title: String,
    pub parts: Vec<Part>,
}

/// What a section is made of.
pub enum Part {
    /// A paragraph.
    Words(String),
    /// Words, one point each.
    Points(Vec<String>),
    /// A table with its note.
    Table(DataTable),
    /// Charts and pictures, for the page alone.
    Figure(Markup),
}

impl Section {
    /// A section.
    pub fn new(id: &'static str, title: impl Into<String>, parts: Vec<Part>) -> Self {
        Self { id, title: title.into(), parts }
    }
}

impl Document {
    /// Everything but what only the page can show; long tables only if `all`.
    pub fn print(&self, all: bool) {
        println!("{}", self.title);
        if !self.about.is_empty() {
            println!("  {}", self.about);
        }
        for section in &self.sections {
            if !self.is_plain {
                println!("\n{}", section.title);
            }
            let shown = |part: &&Part| match part {
                Part::Table(table) => all || !table.is_long,
                Part::Figure(_) => false,
                Part::Words(_) | Part::Points(_) => true,
            };
            for (number, part) in section.parts.iter().filter(shown).enumerate() {
                if number == 0 {
                    println!();
                }
                match part {
                    Part::Words(words) => println!("{}", wrapped(words, "  ", "  ")),
                    Part::Points(points) => {
                        points.iter().for_each(|point| println!("{}", wrapped(point, "  - ", "    ")));
                    }
                    Part::Table(table) => {
                        println!("{}{}", table.text(), wrapped(&table.note, "  ", "  ").trim_end());
                    }
                    Part::Figure(_) => {}
                }
            }
        }
        println!();
        self.verdicts.iter().for_each(|(_, verdict)| println!("{}", wrapped(verdict, "  ", "  ")));
    }

    /// The tables that have a name.
    fn tables(&self) -> impl Iterator<Item = &DataTable> {
        let parts = self.sections.iter().flat_map(|section| &section.parts);
        let tables = parts.filter_map(|part| if let Part::Table(table) = part { Some(table) } else { None });
        tables.filter(|table| !table.id.is_empty())
    }

    /// Facts, and every table as an array of objects.
    pub fn json(&self) -> Value {
        let mut value = self.facts.clone();
        let verdicts = self.verdicts.iter().map(|(good, words)| json!({"good": good, "words": words}));
        let tables = self.tables().map(|table| (table.id.clone(), table.json()));
        value.extend([
            ("title".to_owned(), json!(self.title)),
            ("command".to_owned(), json!(command_line())),
            ("version".to_owned(), json!(env!("CARGO_PKG_VERSION"))),
            ("verdicts".to_owned(), verdicts.collect()),
            ("tables".to_owned(), Value::Object(tables.collect())),
        ]);
        Value::Object(value)
    }

    /// Writes one of the tables as CSV.
    ///
    /// # Errors
    /// If there is no such table, or the file cannot be written.
    pub fn write_csv(&self, id: &str, path: &Path) -> anyhow::Result<()> {
        let table =
            self.tables().find(|table| table.id == id).with_context(|| format!("there is no table {id}"))?;
        put(path, table.csv())
    }

    /// Writes `report.html`, `report.json` and a CSV file for each table that has a name into a folder, which is made if it is not
    /// there.
    ///
    /// # Errors
    /// If one of them cannot be written.
    pub fn write(&self, folder: &Path, json: &impl Serialize) -> anyhow::Result<()> {
        std::fs::create_dir_all(folder)
            .with_context(|| format!("cannot make the folder {}", folder.display()))?;
        json_file::write(&folder.join("report.json"), json)?;
        for table in self.tables() {
            put(&folder.join(format!("{}.csv", table.id)), table.csv())?;
        }
        let page = folder.join("report.html");
        put(&page, page::render(self))?;
        println!("\n  report: {}", page.display());
        Ok(())
    }
}

fn put(path: &Path, text: String) -> anyhow::Result<()> {
    std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}

/// Words in lines of at most some 120 characters.
fn wrapped(words: &str, first: &str, others: &str) -> String {
    let mut text = String::new();
    let mut line = first.to_owned();
    let mut empty = true;
    for word in words.split_whitespace() {
        if !empty && line.chars().count() + 1 + word.chars().count() > 120 {
            text += &line;
            text.push('\n');
            line = others.to_owned();
            empty = true;
        }
        if !empty {
            line.push(' ');
        }
        line += word;
        empty = false;
    }
    text + &line
}

#[cfg(test)]
mod tests {
    use super::*;

    fn document() -> Document {
        let mut table =
            DataTable::new("bytes", &[("name", "who"), ("total_bytes", "bytes"), ("kb_s", "KB/s")]);
        table.row([Cell::text("a, \"b\" <c>"), Cell::Whole(1_234_567), Cell::Number(2.345_6, 2)]);
        table.row([Cell::text("d"), Cell::Missing, Cell::Number(f64::NAN, 2)]);
        table.note = "a `b<` & `c`".to_owned();
        Document {
            title: "T".to_owned(),
            verdicts: vec![(true, "fine".to_owned())],
            sections: vec![Section::new("s", "A & B", vec![Part::Table(table)])],
            facts: Map::from_iter([("seed".to_owned(), json!(7))]),
            ..Document::default()
        }
    }

    #[test]
    fn every_form_says_the_same() {
        let document = document();
        let table = document.tables().next().unwrap();
        assert_eq!(table.csv(), "name,total_bytes,kb_s\n\"a, \"\"b\"\" <c>\",1234567,2.3456\nd,,\n");
        let json = document.json();
        assert_eq!(json["tables"]["bytes"][0]["total_bytes"], 1_234_567);
        assert_eq!(json["tables"]["bytes"][1]["kb_s"], Value::Null);
        assert_eq!(json["seed"], 7);
        let page = page::render(&document);
        for expected in ["a, &quot;b&quot; &lt;c&gt;", "1,234,567", "2.35"] {
            assert!(page.contains(expected), "{page}");
        }
        assert!(table.text().to_string().contains("1,234,567"));
    }

    #[test]
    fn backticks_are_code_and_nothing_else_is_markup() {
        let page = page::render(&document());
        assert!(page.contains("a <code>b&lt;</code> &amp; <code>c</code>"), "{page}");
    }

    #[test]
    fn words_are_wrapped_and_none_is_lost() {
        let words = "word ".repeat(100);
        let text = wrapped(&words, "  - ", "    ");
        assert!(text.lines().all(|line| line.chars().count() <= 120));
        assert_eq!(text.matches("word").count(), 100);
    }
}
