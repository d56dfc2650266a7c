//! A report of tables, charts and words: said once, then printed, and written as a page, as CSV and as JSON.

use std::path::Path;

use anyhow::Context;
use serde_json::{Map, Value, json};

use crate::html::{escape, foot, head};
use crate::table::{Table, percent, thousands};
use crate::{command_line, json_file};

/// A report.
pub struct Document {
    pub title: String,
    /// Verdicts at the top: whether it is good, and in what words.
    pub verdicts: Vec<(bool, String)>,
    pub sections: Vec<Section>,
    /// What the JSON holds beside the tables.
    pub facts: Map<String, Value>,
}

/// One part of a report. The id is its anchor in the page.
pub struct Section {
    pub id: &'static str,
    pub title: String,
    pub parts: Vec<Part>,
}

pub enum Part {
    /// A paragraph.
    Words(String),
    /// Words, one point each.
    Points(Vec<String>),
    Table(DataTable),
    /// Charts and pictures, for the page alone.
    Html(String),
}

/// A table whose cells keep their values, so that every form of it says the same.
pub struct DataTable {
    /// Name of the CSV file, and of the table in the JSON.
    pub id: String,
    pub columns: Vec<Column>,
    pub rows: Vec<Vec<Cell>>,
    pub note: String,
    /// Long: the page shows it when asked to.
    pub is_folded: bool,
}

/// A column: its name in CSV and JSON, with unit, and its heading for people.
#[derive(Clone, Copy)]
pub struct Column {
    pub key: &'static str,
    pub heading: &'static str,
}

#[derive(Clone, Debug, PartialEq)]
pub enum Cell {
    Text(String),
    Whole(u64),
    /// A number, and digits after the point for people.
    Number(f64, usize),
    /// A share of 1, shown as per cent.
    Share(f64),
    /// Not known, or not said.
    Missing,
}

impl DataTable {
    pub fn new(id: impl Into<String>, columns: &[(&'static str, &'static str)]) -> Self {
        let columns = columns.iter().map(|&(key, heading)| Column { key, heading }).collect();
        Self { id: id.into(), columns, rows: Vec::new(), note: String::new(), is_folded: false }
    }

    pub fn row(&mut self, cells: impl IntoIterator<Item = Cell>) {
        self.rows.push(cells.into_iter().collect());
    }

    fn csv(&self) -> String {
        let line = |cells: Vec<String>| cells.join(",") + "\n";
        let mut csv = line(self.columns.iter().map(|column| quoted(column.key)).collect());
        for row in &self.rows {
            csv += &line(row.iter().map(|cell| quoted(&cell.plain())).collect());
        }
        csv
    }

    fn json(&self) -> Value {
        let row = |row: &Vec<Cell>| {
            let fields =
                self.columns.iter().zip(row).map(|(column, cell)| (column.key.to_owned(), cell.json()));
            Value::Object(fields.collect())
        };
        Value::Array(self.rows.iter().map(row).collect())
    }

    fn text(&self) -> Table {
        let mut table = Table::new(self.columns.iter().map(|column| column.heading));
        self.rows.iter().for_each(|row| table.row(row.iter().map(Cell::shown)));
        table
    }

    fn html(&self) -> String {
        let heads: String =
            self.columns.iter().map(|column| format!("<th>{}</th>", escape(column.heading))).collect();
        let mut rows = String::new();
        for row in &self.rows {
            rows += "<tr>";
            for (number, cell) in row.iter().enumerate() {
                let tag = if number == 0 { "th" } else { "td" };
                let class = if *cell == Cell::Missing { " class=\"missing\"" } else { "" };
                rows += &format!("<{tag}{class}>{}</{tag}>", escape(&cell.shown()));
            }
            rows += "</tr>";
        }
        let note = if self.note.is_empty() {
            String::new()
        } else {
            format!("<p class=\"note\">{}</p>", inline(&self.note))
        };
        format!(
            "<div class=\"scroll\"><table><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table></div>{note}"
        )
    }
}

impl Cell {
    pub fn text(text: impl Into<String>) -> Self {
        Self::Text(text.into())
    }

    /// For people.
    fn shown(&self) -> String {
        match self {
            Self::Text(text) => text.clone(),
            Self::Whole(number) => thousands(*number),
            Self::Number(number, digits) if number.is_finite() => {
                if *number >= 1_000.0 && *digits == 0 {
                    thousands(number.round() as u64)
                } else {
                    format!("{number:.digits$}")
                }
            }
            Self::Share(share) => percent(*share),
            Self::Number(..) | Self::Missing => "–".to_owned(),
        }
    }

    /// For CSV: whole precision, no separators, nothing where nothing is known.
    fn plain(&self) -> String {
        match self {
            Self::Text(text) => text.clone(),
            Self::Whole(number) => number.to_string(),
            Self::Number(number, _) | Self::Share(number) if number.is_finite() => number.to_string(),
            _ => String::new(),
        }
    }

    fn json(&self) -> Value {
        match self {
            Self::Text(text) => json!(text),
            Self::Whole(number) => json!(number),
            // Not a number and infinity become null.
            Self::Number(number, _) | Self::Share(number) => json!(number),
            Self::Missing => Value::Null,
        }
    }
}

/// Words as HTML; what stands between backticks is code.
fn inline(words: &str) -> String {
    let mut html = String::new();
    for (number, piece) in words.split('`').enumerate() {
        let piece = escape(piece);
        html += &if number % 2 == 1 { format!("<code>{piece}</code>") } else { piece };
    }
    html
}

/// A field of a CSV file (RFC 4180).
fn quoted(field: &str) -> String {
    if field.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", field.replace('"', "\"\""))
    } else {
        field.to_owned()
    }
}

impl Document {
    /// Everything but what only the page can show; folded tables only if `all`.
    pub fn print(&self, all: bool) {
        println!("{}", self.title);
        for section in &self.sections {
            println!("\n{}\n", section.title);
            for part in &section.parts {
                match part {
                    Part::Words(words) => println!("{}", wrapped(words, "  ", "  ")),
                    Part::Points(points) => {
                        points.iter().for_each(|point| println!("{}", wrapped(point, "  - ", "    ")));
                    }
                    Part::Table(table) if table.is_folded && !all => {}
                    Part::Table(table) => {
                        print!("{}", table.text());
                        println!("{}", wrapped(&table.note, "  ", "  "));
                    }
                    Part::Html(_) => {}
                }
            }
        }
        println!();
        self.verdicts.iter().for_each(|(_, verdict)| println!("{}", wrapped(verdict, "  ", "  ")));
    }

    /// The page.
    pub fn page(&self) -> String {
        let mut page = head(&escape(&self.title));
        for (good, verdict) in &self.verdicts {
            let class = if *good { "good" } else { "bad" };
            page += &format!("<p class=\"verdict {class}\">{}</p>", inline(verdict));
        }
        if self.sections.len() > 2 {
            let links =
                self.sections.iter().map(|s| format!("<a href=\"#{}\">{}</a> ", s.id, escape(&s.title)));
            page += &format!("<nav>{}</nav>", links.collect::<String>());
        }
        for section in &self.sections {
            page += &format!("<section id=\"{}\"><h2>{}</h2>", section.id, escape(&section.title));
            for part in &section.parts {
                page += &match part {
                    Part::Words(words) => format!("<p>{}</p>", inline(words)),
                    Part::Points(points) => {
                        let points: String =
                            points.iter().map(|point| format!("<li>{}</li>", inline(point))).collect();
                        format!("<ul>{points}</ul>")
                    }
                    Part::Table(table) => table.html(),
                    Part::Html(html) => html.clone(),
                };
            }
            page += "</section>";
        }
        page + &foot(&command_line())
    }

    fn tables(&self) -> impl Iterator<Item = &DataTable> {
        let parts = self.sections.iter().flat_map(|section| &section.parts);
        parts.filter_map(|part| if let Part::Table(table) = part { Some(table) } else { None })
    }

    /// Facts, and every table as an array of objects.
    pub fn json(&self) -> Value {
        let mut value = self.facts.clone();
        value.insert("title".to_owned(), json!(self.title));
        value.insert("command".to_owned(), json!(command_line()));
        value.insert("version".to_owned(), json!(env!("CARGO_PKG_VERSION")));
        let verdicts: Vec<Value> =
            self.verdicts.iter().map(|(good, words)| json!({"good": good, "words": words})).collect();
        value.insert("verdicts".to_owned(), Value::Array(verdicts));
        let tables = self.tables().map(|table| (table.id.clone(), table.json()));
        value.insert("tables".to_owned(), Value::Object(tables.collect()));
        Value::Object(value)
    }

    /// Writes one of the tables as CSV.
    pub fn write_csv(&self, id: &str, path: &Path) -> anyhow::Result<()> {
        let table =
            self.tables().find(|table| table.id == id).with_context(|| format!("there is no table {id}"))?;
        std::fs::write(path, table.csv()).with_context(|| format!("cannot write {}", path.display()))
    }

    /// Writes `report.html`, `report.json` and a CSV file for each table into a folder, which is made if it is not there.
    pub fn write(&self, folder: &Path) -> anyhow::Result<()> {
        std::fs::create_dir_all(folder)
            .with_context(|| format!("cannot make the folder {}", folder.display()))?;
        json_file::write(&folder.join("report.json"), &self.json())?;
        let put = |name: &str, text: String| {
            let path = folder.join(name);
            std::fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))
        };
        for table in self.tables() {
            put(&format!("{}.csv", table.id), table.csv())?;
        }
        put("report.html", self.page())?;
        println!("\n  report: {}", folder.join("report.html").display());
        Ok(())
    }
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
        let section = Section { id: "s", title: "A & B".to_owned(), parts: vec![Part::Table(table)] };
        Document {
            title: "T".to_owned(),
            verdicts: vec![(true, "fine".to_owned())],
            sections: vec![section],
            facts: Map::from_iter([("seed".to_owned(), json!(7))]),
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
        let page = document.page();
        assert!(
            page.contains("a, &quot;b&quot; &lt;c&gt;")
                && page.contains("1,234,567")
                && page.contains("2.35")
        );
        assert!(table.text().to_string().contains("1,234,567"));
    }

    #[test]
    fn backticks_are_code_and_nothing_else_is_markup() {
        assert_eq!(inline("a `b<` & `c`"), "a <code>b&lt;</code> &amp; <code>c</code>");
    }

    #[test]
    fn words_are_wrapped_and_none_is_lost() {
        let words = "word ".repeat(100);
        let text = wrapped(&words, "  - ", "    ");
        assert!(text.lines().all(|line| line.chars().count() <= 120));
        assert_eq!(text.matches("word").count(), 100);
    }
}
