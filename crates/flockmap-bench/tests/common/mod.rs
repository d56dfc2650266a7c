//! The program as a user runs it.
#![allow(dead_code, reason = "each test file uses its own part")]

use std::path::Path;
use std::process::Command;

use serde_json::Value;

/// The program with these arguments.
pub(crate) fn command(words: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_flockmap-bench"));
    command.args(words.split_whitespace()).env_remove("FLOCKMAP_DATA");
    command
}

/// What it prints, if all went well.
pub(crate) fn good(words: &str) -> String {
    let output = command(words).output().expect("the program starts");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{words}\n{text}\n{}", String::from_utf8_lossy(&output.stderr));
    text
}

/// A JSON file that it wrote.
pub(crate) fn json(path: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(path).expect("the file is there")).expect("it is JSON")
}
