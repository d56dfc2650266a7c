//! Writing JSON files.

use std::path::Path;

use anyhow::Context;
use serde::Serialize;

/// Writes a value as indented JSON.
pub fn write(path: &Path, value: &impl Serialize) -> anyhow::Result<()> {
    let mut text = serde_json::to_string_pretty(value)?;
    text.push('\n');
    std::fs::write(path, text).with_context(|| {
        format!("cannot write {}: does its folder exist, and may you write there?", path.display())
    })
}

/// The same, if a file was asked for.
pub fn write_asked(path: Option<&Path>, value: &impl Serialize) -> anyhow::Result<()> {
    path.map_or(Ok(()), |path| write(path, value))
}
