//! Where the keys of a configuration stand, so that an error says in which line to look.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};

use toml::de::{DeTable, DeValue};

/// The keys of a configuration file and their places. A key of a section is named as in all errors: `[map]
/// range_m`; the section itself `[map]`.
#[derive(Clone, Debug, Default)]
pub(crate) struct Places {
    /// The file, if it is one.
    file: Option<PathBuf>,
    keys: BTreeMap<String, Place>,
    /// The text is that of no file: its lines mean nothing to anybody.
    has_no_lines: bool,
}

#[derive(Clone, Debug)]
struct Place {
    line: usize,
    /// The bytes of the key, and of its value.
    key: Range<usize>,
    value: Range<usize>,
}

impl Places {
    /// The keys of a text. None if it is no TOML.
    pub(super) fn of(text: &str) -> Self {
        let mut places = Self::default();
        if let Ok(table) = DeTable::parse(text) {
            places.note(text, "", table.get_ref());
        }
        places
    }

    /// The same for a text that is that of a file.
    pub(super) fn in_file(mut self, path: &Path) -> Self {
        self.file = Some(path.to_owned());
        self
    }

    /// The same for a text that was put together.
    pub(super) const fn without_lines(mut self) -> Self {
        self.has_no_lines = true;
        self
    }

    /// What is said of bytes of the text, with their line before it.
    pub(super) fn at_line(&self, text: &str, byte: usize, what: &str) -> String {
        if self.has_no_lines { what.to_owned() } else { format!("line {}: {what}", line_of(text, byte)) }
    }

    fn note(&mut self, text: &str, section: &str, table: &DeTable<'_>) {
        for (key, value) in table {
            let name = key.get_ref();
            let place = Place { line: line_of(text, key.span().start), key: key.span(), value: value.span() };
            let full = match (value.get_ref(), section) {
                (DeValue::Table(inside), "") => {
                    self.note(text, name, inside);
                    format!("[{name}]")
                }
                (DeValue::Table(inside), _) => {
                    self.note(text, &format!("{section}.{name}"), inside);
                    format!("[{section}.{name}]")
                }
                (_, "") => name.to_string(),
                _ => format!("[{section}] {name}"),
            };
            self.keys.insert(full, place);
        }
    }

    /// Whether the file has this key.
    pub(crate) fn has(&self, key: &str) -> bool {
        self.keys.contains_key(key)
    }

    /// The key whose name or value is at these bytes of the text: its full name, and whether it is the name.
    pub(super) fn at(&self, bytes: &Range<usize>) -> Option<(&str, bool)> {
        let is_within = |range: &Range<usize>| range.start <= bytes.start && bytes.end <= range.end;
        let found = self.keys.iter().filter(|(_, place)| is_within(&place.key) || is_within(&place.value));
        // Of a key and the section that it is in, the key.
        let found = found.min_by_key(
            |(_, place)| {
                if is_within(&place.key) { place.key.len() } else { place.value.len() }
            },
        );
        found.map(|(key, place)| (key.as_str(), is_within(&place.key)))
    }

    /// A text with the file, and the line of the first key that it names, before it.
    pub(crate) fn locate(&self, text: &str) -> String {
        let file = self.file.as_ref().map(|file| format!("{}: ", file.display())).unwrap_or_default();
        let line = self.line_of_first_key(text).filter(|_| !self.has_no_lines);
        let line = line.map(|line| format!("line {line}: ")).unwrap_or_default();
        format!("{file}{line}{text}")
    }

    fn line_of_first_key(&self, text: &str) -> Option<usize> {
        let first = text.split(' ').next().filter(|word| !word.starts_with('['));
        if let Some(place) = first.and_then(|word| self.keys.get(word)) {
            return Some(place.line);
        }
        let mut named = text.match_indices('[').filter_map(|(at, _)| {
            let section = &text[at..=at + text[at..].find(']')?];
            let key = text[at + section.len()..].strip_prefix(' ').unwrap_or_default();
            let end = key.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(key.len());
            let full = format!("{section} {}", &key[..end]);
            self.keys.get(&full).or_else(|| self.keys.get(section))
        });
        named.next().map(|place| place.line)
    }
}

/// The number of the line that has this byte, from 1 on.
pub(super) fn line_of(text: &str, byte: usize) -> usize {
    1 + text.bytes().take(byte).filter(|byte| *byte == b'\n').count()
}
