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
    /// At the top of the page and the end of the text.
    pub verdicts: Vec<Verdict>,
    /// Its parts.
    pub sections: Vec<Section>,
    /// The text leaves out the titles of sections: its tables say by themselves what they are.
    pub is_plain: bool,
    /// What the JSON holds beside the tables: an object, or nothing.
    pub facts: Value,
    /// Pictures that stand in the folder beside the page: names of files, and SVG.
    pub pictures: Vec<(&'static str, String)>,
}

/// What came of it, in a sentence.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Verdict {
    /// It is as it must be.
    Good(String),
    /// It is no fault, and whoever reads the figures should know it.
    Note(String),
    /// It is not as it must be: the exit code is 1.
    Failure(String),
}

impl Verdict {
    /// Good if so, else a failure.
    pub fn good_if(good: bool, words: impl Into<String>) -> Self {
        if good { Self::Good(words.into()) } else { Self::Failure(words.into()) }
    }

    /// Good if so, else worth knowing.
    pub fn good_or_note(good: bool, words: impl Into<String>) -> Self {
        if good { Self::Good(words.into()) } else { Self::Note(words.into()) }
    }

    /// Its kind: in a word for people, and as the class of the page's style and in JSON.
    pub(super) const fn kind(&self) -> (&'static str, &'static str) {
        match self {
            Self::Good(_) => ("Good", "good"),
            Self::Note(_) => ("Worth knowing", "note"),
            Self::Failure(_) => ("FAILED", "failure"),
        }
    }

    pub(super) fn words(&self) -> &str {
        let (Self::Good(words) | Self::Note(words) | Self::Failure(words)) = self;
        words
    }
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
    /// Whether nothing failed.
    pub fn is_good(&self) -> bool {
        !self.verdicts.iter().any(|verdict| matches!(verdict, Verdict::Failure(_)))
    }

    /// The tables that have a name.
    pub(super) fn tables(&self) -> impl Iterator<Item = &DataTable> {
        let parts = self.sections.iter().flat_map(|section| &section.parts);
        let tables = parts.filter_map(|part| if let Part::Table(table) = part { Some(table) } else { None });
        tables.filter(|table| !table.id.is_empty())
    }

    /// Facts, and every table as an array of objects.
    pub fn json(&self) -> Value {
        let mut value = self.facts.clone();
        let verdicts = self.verdicts.iter().map(|v| json!({"kind": v.kind().1, "words": v.words()}));
        let tables = self.tables().map(|table| (table.id.clone(), table.json()));
        value["title"] = json!(self.title);
        value["command"] = json!(command_line());
        value["version"] = json!(env!("CARGO_PKG_VERSION"));
        value["verdicts"] = verdicts.collect();
        value["tables"] = Value::Object(tables.collect());
        value
    }
}
