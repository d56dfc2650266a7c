//! A report of tables, charts and text: stated once, then printed, and written as a page, as CSV and as JSON.

mod data_table;
mod files;
mod model;
mod page;
mod text;

pub use data_table::{Cell, Column, DataTable, TextColumn};
pub use model::{Document, Part, Section, Verdict};
pub use page::terms;

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{Value, json};

    fn document() -> Document {
        let table = DataTable {
            id: "bytes".to_owned(),
            columns: vec![("name", "who"), ("total_bytes", "bytes"), ("kb_s", "KB/s")],
            rows: vec![
                vec![Cell::text("a, \"b\" <c>"), Cell::Whole(1_234_567), Cell::Number(2.345_6, 2)],
                vec![Cell::text("d"), Cell::Missing, Cell::Number(f64::NAN, 2)],
            ],
            ..DataTable::default()
        }
        .with_note("a `b<` & `c`");
        Document {
            title: "T".to_owned(),
            verdicts: vec![Verdict::Good("fine".to_owned())],
            sections: vec![Section::new("s", "A & B", vec![Part::Table(table)])],
            facts: json!({"seed": 7}),
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
        assert!(table.to_string().contains("1,234,567"));
    }

    #[test]
    fn columns_line_up() {
        let rows = [["a", "1"], ["längst", "1,000,000"]].map(|row| row.map(str::to_owned));
        let text = DataTable::unnamed(["name", "bytes"], rows).to_string();
        let ends: Vec<usize> = text.lines().map(|l| l.chars().count()).collect();
        assert!(ends.windows(2).all(|w| w[0] == w[1]), "{text}");
    }

    #[test]
    fn only_a_failure_makes_a_report_bad_and_every_verdict_says_what_it_is() {
        let note = Verdict::Note("short".to_owned());
        let mut document = Document { verdicts: vec![note], ..document() };
        assert!(document.is_good());
        document.verdicts.push(Verdict::Failure("lost".to_owned()));
        assert!(!document.is_good());
        let page = page::render(&document);
        assert!(page.contains("<b>Worth knowing</b>") && page.contains("<b>FAILED</b>"), "{page}");
        assert_eq!(document.json()["verdicts"][1]["kind"], "failure");
    }

    #[test]
    fn a_column_of_words_wraps_and_one_of_figures_does_not() {
        let long = "a setting of many words, which would not fit a narrow screen";
        let table = DataTable::unnamed(
            ["option", "value"],
            [["radio", long], ["seed", "1"]].map(|r| r.map(str::to_owned)),
        );
        let section = Section::new("s", "S", vec![Part::Table(table)]);
        let page = page::render(&Document { sections: vec![section], ..Document::default() });
        assert_eq!(page.matches("words\">").count(), 3, "the heading and two cells: {page}");
        assert!(!page::render(&document()).contains("words\">"));
    }

    #[test]
    fn backticks_are_code_and_nothing_else_is_markup() {
        let page = page::render(&document());
        assert!(page.contains("a <code>b&lt;</code> &amp; <code>c</code>"), "{page}");
    }
}
