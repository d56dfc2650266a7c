//! What the reader of TOML and serde find wrong, in the words of whoever writes a configuration.

use std::fmt::Write as _;

use serde_json::Value;

use super::error::ConfigError;
use super::places::{Places, line_of};
use super::schema::{OWN_KEYS, schema};

/// What keys were called before.
const RENAMED: [(&str, &str); 6] = [
    ("cycle", "batch"),
    ("t_l_ms", "publish_period_ms"),
    ("t_l_occupied_ms", "obstacle_period_ms"),
    ("changes_max", "voxels_max"),
    ("present_state_kb_min", "snapshot_kb_min"),
    ("present_state_range_max", "snapshot_range_max"),
];

/// What serde calls a thing, and what it is called here.
const NAMES: [(&str, &str); 12] = [
    ("u16", "a whole number, 0 to 65,535"),
    ("u32", "a whole number, 0 to 4,294,967,295"),
    ("u64", "a whole number, 0 or more"),
    ("usize", "a whole number, 0 or more"),
    ("f64", "a number"),
    ("a boolean", "true or false"),
    ("a string", "a text in quotes"),
    ("path string", "a path in quotes"),
    ("a sequence", "a list, in [ ]"),
    ("an array of length 3", "a list of 3 numbers, in [ ]"),
    ("an array of length 4", "a list of 4 numbers, in [ ]"),
    ("a map", "a section"),
];

/// A value that is longer is not shown in full.
const VALUE_BYTES_MAX: usize = 60;

/// The error of a text.
pub(super) fn explain(text: &str, places: &Places, error: &toml::de::Error) -> ConfigError {
    let message = error.message();
    let Some(span) = error.span() else {
        return parse(missing(message, "").unwrap_or_else(|| message.to_owned()));
    };
    let line = line_of(text, span.start);
    let start = span.start;
    let at_line = |what: String| parse(places.at_line(text, start, &what));
    let Some((key, is_name)) = places.at(&span) else {
        // No TOML at all, or the whole of it.
        let shown = text.lines().nth(line - 1).unwrap_or_default().trim();
        return match missing(message, "") {
            Some(text) => parse(text),
            None => at_line(format!("`{}`: {message}", shortened(shown))),
        };
    };
    if let Some(unknown) = quoted(message.strip_prefix("unknown field ").unwrap_or_default()).next() {
        return at_line(unknown_key(unknown, section_of(key), message));
    }
    if let Some(text) = missing(message, key) {
        return at_line(text);
    }
    if is_name && (key.starts_with("[alignment.") || key.starts_with("[clock_offset_ms]")) {
        return at_line(format!("{key} is for no robot, expected its id in this place, 0 to 65535"));
    }
    let got = if key.ends_with("swarm_key") {
        "no text".to_owned()
    } else {
        shortened(text.get(span).unwrap_or_default())
    };
    at_line(format!("{key} is {got}, expected {}", expected(message)) + &meant(message))
}

fn parse(text: String) -> ConfigError {
    ConfigError::Parse { text }
}

/// The section that a key is in; empty for those of the whole file.
fn section_of(key: &str) -> &str {
    if key.starts_with('[') && !key.contains("] ") {
        return key.rsplit_once('.').map_or("", |(section, _)| section);
    }
    key.split_once(']').map_or("", |(section, _)| section).trim_start_matches('[')
}

fn missing(message: &str, key: &str) -> Option<String> {
    let missing = quoted(message.strip_prefix("missing field ")?).next()?;
    let section = if key.is_empty() { String::new() } else { format!("{key} has no ") };
    Some(match missing {
        "map" => "there is no section [map], expected one with resolution_m and range_m".into(),
        "id" => "there is no id, expected the number of this robot, as in `id = 1`".into(),
        _ => format!("{section}{missing}, and every configuration needs it"),
    })
}

/// What was meant by a key that is none.
fn unknown_key(unknown: &str, section: &str, message: &str) -> String {
    if let Some((_, new)) = RENAMED.iter().find(|(old, _)| *old == unknown) {
        return format!("`{unknown}` is called `{new}` now");
    }
    let place = if section.is_empty() { "of the whole file".into() } else { format!("of [{section}]") };
    let mut text = format!("`{unknown}` is no key {place}");
    let own = OWN_KEYS.iter().filter(|(of, _)| *of == section).map(|(_, key)| *key);
    let listed = message.split_once("expected").map_or("", |(_, listed)| listed);
    let known: Vec<&str> = quoted(listed).filter(|key| !key.contains('.')).chain(own).collect();
    let _ = match nearest(unknown, &known) {
        Some(best) => write!(text, ", did you mean `{best}`?"),
        None => match sections_with(unknown)[..] {
            [] => write!(text, ", expected one of {}", known.join(", ")),
            ref sections => write!(text, ", but of {}", sections.join(" and ")),
        },
    };
    text
}

/// The sections that have a key of this name.
fn sections_with(key: &str) -> Vec<String> {
    let schema = schema();
    let sections = schema["properties"].as_object().into_iter().flatten();
    sections
        .filter(|(_, section)| section["properties"].get(key).is_some_and(Value::is_object))
        .map(|(name, _)| format!("[{name}]"))
        .collect()
}

/// What would work, as serde says it, in our words.
fn expected(message: &str) -> String {
    if message.contains("socket address") {
        return "ADDRESS:PORT in quotes, such as \"10.0.0.1:7700\"".into();
    }
    if message.contains("IP") && message.contains("address") {
        return "an IPv4 address in quotes, such as \"10.0.0.1\"".into();
    }
    let expected = message.split_once("expected ").map_or(message, |(_, expected)| expected);
    let expected = expected.strip_prefix("one of ").unwrap_or(expected);
    if expected.starts_with("struct ") {
        return "a section, with its keys below its name in [ ]".into();
    }
    let name = NAMES.iter().find(|(name, _)| *name == expected);
    name.map_or(expected, |(_, plain)| plain).to_owned()
}

/// Which of the names that a value may have was meant.
fn meant(message: &str) -> String {
    let mut words = quoted(message.strip_prefix("unknown variant ").unwrap_or_default());
    let Some(unknown) = words.next() else { return String::new() };
    let known: Vec<&str> = words.collect();
    nearest(unknown, &known).map_or_else(String::new, |known| format!(", did you mean `{known}`?"))
}

fn nearest<'a>(unknown: &str, known: &[&'a str]) -> Option<&'a str> {
    let scored = known.iter().map(|known| (strsim::jaro_winkler(unknown, known), *known));
    scored.max_by(|a, b| a.0.total_cmp(&b.0)).filter(|(score, _)| *score >= 0.75).map(|(_, known)| known)
}

/// The words between backticks.
fn quoted(text: &str) -> impl Iterator<Item = &str> {
    text.split('`').skip(1).step_by(2)
}

/// The first line of a text, as far as there is room for it.
fn shortened(text: &str) -> String {
    let line = text.lines().next().unwrap_or_default();
    let line: String = line.chars().map(|c| if c.is_control() { '\u{fffd}' } else { c }).collect();
    let end = line.char_indices().map(|(at, _)| at).find(|at| *at > VALUE_BYTES_MAX).unwrap_or(line.len());
    let more = if end < line.len() || text.contains('\n') { " …" } else { "" };
    format!("{}{more}", &line[..end])
}
