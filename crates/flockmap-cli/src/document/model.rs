//! What a report says.

use maud::Markup;
use serde_json::{Value, json};

use super::data_table::DataTable;
use crate::program::command_line;

/// A report.
#[derive(Default)]
pub struct Document {
    /// What it is of.
    pub title: String,
    /// How it was made, in a line under the title of the text.
    pub about: String,
    /// Verdicts at the top of the page and the end of the text: whether it is good, and the text.
    pub verdicts: Vec<(bool, String)>,
    /// Its parts.
    pub sections: Vec<Section>,
    /// The text leaves out the titles of sections: its tables say by themselves what they are.
    pub is_plain: bool,
    /// What the JSON holds beside the tables: an object, or nothing.
    pub facts: Value,
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
    /// Paragraphs, one point each.
    Points(Vec<String>),
    /// A table with its note.
    Table(DataTable),
    /// Charts and pictures, only for the page.
    Figure(Markup),
}

impl Section {
    /// A section.
    pub fn new(id: &'static str, title: impl Into<String>, parts: Vec<Part>) -> Self {
        Self { id, title: title.into(), parts }
    }
}

impl Document {
    /// The tables that have a name.
    pub(super) fn tables(&self) -> impl Iterator<Item = &DataTable> {
        let parts = self.sections.iter().flat_map(|section| &section.parts);
        let tables = parts.filter_map(|part| if let Part::Table(table) = part { Some(table) } else { None });
        tables.filter(|table| !table.id.is_empty())
    }

    /// Facts, and every table as an array of objects.
    pub fn json(&self) -> Value {
        let mut value = self.facts.clone();
        let verdicts = self.verdicts.iter().map(|(good, words)| json!({"good": good, "words": words}));
        let tables = self.tables().map(|table| (table.id.clone(), table.json()));
        value["title"] = json!(self.title);
        value["command"] = json!(command_line());
        value["version"] = json!(env!("CARGO_PKG_VERSION"));
        value["verdicts"] = verdicts.collect();
        value["tables"] = Value::Object(tables.collect());
        value
    }
}
