//! The program as a user runs it.
#![allow(dead_code, reason = "each test file uses its own part")]

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

/// The program with these arguments.
pub(crate) fn command(words: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_flockmap"));
    command.args(words.split_whitespace());
    command
}

/// Runs the program with these arguments.
pub(crate) fn flockmap(words: &str) -> Output {
    command(words).output().expect("the program starts")
}

/// What it prints, if all went well.
pub(crate) fn good(words: &str) -> String {
    let output = flockmap(words);
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{words}\n{text}\n{}", String::from_utf8_lossy(&output.stderr));
    text
}

/// What it says where it cannot do its work.
pub(crate) fn fails(words: &str) -> String {
    let output = flockmap(words);
    assert_eq!(output.status.code(), Some(2), "{words}");
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// A JSON file that it wrote.
pub(crate) fn json(path: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(path).expect("the file is there")).expect("it is JSON")
}
