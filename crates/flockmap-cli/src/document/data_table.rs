//! Tables whose cells keep their values, so that every form of them says the same.

use core::fmt;

use serde_json::{Value, json};

use crate::numbers::{percent, thousands};

/// A table of values.
#[derive(Default)]
pub struct DataTable {
    /// Name of the CSV file, and of the table in the JSON. Without one it is in neither: what it shows is
    /// among the facts.
    pub id: String,
    /// Name in CSV and JSON, with unit, and heading for people.
    pub columns: Vec<(&'static str, &'static str)>,
    /// As many cells in each as there are columns.
    pub rows: Vec<Vec<Cell>>,
    /// The row that sums up.
    pub sum: Option<usize>,
    /// What the figures mean.
    pub note: String,
    /// What headings and other words of it mean, for who has not met them; only for the page.
    pub terms: Vec<(&'static str, String)>,
    /// Too long for the text.
    pub is_long: bool,
}

/// Characters of a cell that is never broken into lines.
const ONE_LINE: usize = 28;

/// One column of rows of `R`: its name in CSV and JSON, with unit; its heading for people; its cell in a row.
pub type Column<'a, R> = (&'static str, &'static str, &'a dyn Fn(&R) -> Cell);

/// One column of rows of `R` for people only: its heading, and its cell in a row.
pub type TextColumn<'a, R> = (&'static str, &'a dyn Fn(&R) -> String);

/// One value.
#[derive(Clone, Debug, PartialEq)]
pub enum Cell {
    /// Text.
    Text(String),
    /// A whole number.
    Whole(u64),
    /// A number, and digits after the point for people.
    Number(f64, usize),
    /// A share of 1, shown as per cent.
    Share(f64),
    /// Not known, or not said.
    Missing,
}

impl DataTable {
    /// A table with a row for each of these.
    pub fn of<R>(id: impl Into<String>, rows: &[R], columns: &[Column<'_, R>]) -> Self {
        let names = columns.iter().map(|(key, heading, _)| (*key, *heading)).collect();
        let row = |row: &R| columns.iter().map(|(.., cell)| cell(row)).collect();
        Self { id: id.into(), columns: names, rows: rows.iter().map(row).collect(), ..Self::default() }
    }

    /// A table without a name: headings, and what stands below them in a row for each of these.
    pub fn of_text<R>(rows: &[R], columns: &[TextColumn<'_, R>]) -> Self {
        let row = |row: &R| columns.iter().map(|(_, cell)| Cell::Text(cell(row))).collect();
        Self {
            columns: columns.iter().map(|(heading, _)| ("", *heading)).collect(),
            rows: rows.iter().map(row).collect(),
            ..Self::default()
        }
    }

    /// A table without a name, of cells that are ready.
    pub fn unnamed<const N: usize>(
        headings: [&'static str; N],
        rows: impl IntoIterator<Item = [String; N]>,
    ) -> Self {
        let rows = rows.into_iter().map(|row| row.into_iter().map(Cell::Text).collect());
        Self {
            columns: headings.map(|heading| ("", heading)).to_vec(),
            rows: rows.collect(),
            ..Self::default()
        }
    }

    /// The same with a note.
    #[must_use]
    pub fn with_note(self, note: impl Into<String>) -> Self {
        Self { note: note.into(), ..self }
    }

    /// The same with the meaning of its words.
    #[must_use]
    pub fn with_terms<T: Into<String>>(self, terms: impl IntoIterator<Item = (&'static str, T)>) -> Self {
        Self { terms: terms.into_iter().map(|(term, meaning)| (term, meaning.into())).collect(), ..self }
    }

    /// Whether a column holds text that does not fit one line of a narrow screen.
    pub(super) fn is_words(&self, column: usize) -> bool {
        let long = |cell: &Cell| matches!(cell, Cell::Text(text) if text.chars().count() > ONE_LINE);
        self.rows.iter().filter_map(|row| row.get(column)).any(long)
    }

    pub(super) fn csv(&self) -> String {
        let line = |cells: Vec<String>| cells.join(",") + "\n";
        let mut csv = line(self.columns.iter().map(|(key, _)| quoted(key)).collect());
        for row in &self.rows {
            csv += &line(row.iter().map(|cell| quoted(&cell.plain())).collect());
        }
        csv
    }

    pub(super) fn json(&self) -> Value {
        let row = |row: &Vec<Cell>| {
            let fields =
                self.columns.iter().zip(row).map(|((key, _), cell)| ((*key).to_owned(), cell.json()));
            Value::Object(fields.collect())
        };
        self.rows.iter().map(row).collect()
    }
}

/// For people: the first column is set left, the others right.
impl fmt::Display for DataTable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let headings = self.columns.iter().map(|(_, heading)| (*heading).to_owned()).collect();
        let rows = self.rows.iter().map(|row| row.iter().map(Cell::shown).collect());
        let lines: Vec<Vec<String>> = [headings].into_iter().chain(rows).collect();
        let width = |column: usize| {
            let cells = lines.iter().filter_map(|line| line.get(column));
            cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
        };
        let widths: Vec<usize> = (0..self.columns.len()).map(width).collect();
        for (number, line) in lines.iter().enumerate() {
            let mut text = String::from(" ");
            for (column, (cell, width)) in line.iter().zip(&widths).enumerate() {
                text += &if column == 0 { format!(" {cell:<width$}") } else { format!("  {cell:>width$}") };
            }
            writeln!(f, "{}", text.trim_end())?;
            if number == 0 {
                let all: usize = widths.iter().sum::<usize>() + 2 * widths.len().saturating_sub(1);
                writeln!(f, "  {}", "─".repeat(all))?;
            }
        }
        Ok(())
    }
}

impl Cell {
    /// Text.
    pub fn text(text: impl Into<String>) -> Self {
        Self::Text(text.into())
    }

    /// How many there are.
    pub const fn count(count: usize) -> Self {
        Self::Whole(count as u64)
    }

    /// A number that may not be known.
    pub fn maybe(number: Option<f64>, digits: usize) -> Self {
        number.map_or(Self::Missing, |number| Self::Number(number, digits))
    }

    /// For people.
    pub(super) fn shown(&self) -> String {
        match self {
            Self::Text(text) => text.clone(),
            Self::Whole(number) => thousands(*number),
            Self::Number(number, 0) if number.is_finite() && *number >= 1_000.0 => {
                thousands(number.round() as u64)
            }
            Self::Number(number, digits) if number.is_finite() => format!("{number:.digits$}"),
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

/// A field of a CSV file (RFC 4180).
fn quoted(field: &str) -> String {
    if field.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", field.replace('"', "\"\""))
    } else {
        field.to_owned()
    }
}
