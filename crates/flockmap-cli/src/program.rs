//! How a program begins and ends.

use std::process::ExitCode;

use crate::stop;

/// The result is not what it must be: robots disagree, a codec is not lossless.
const EXIT_DISAGREEMENT: u8 = 1;
/// The work could not be done; the same code as for a wrong command line.
const EXIT_FAILED: u8 = 2;

/// The exit code for what came of a command: whether all is as it must be.
pub fn exit_code(result: anyhow::Result<bool>) -> ExitCode {
    match result {
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::from(EXIT_FAILED)
        }
        Ok(_) if stop::requested() => ExitCode::from(stop::EXIT_CODE),
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(EXIT_DISAGREEMENT),
    }
}

/// The command as it was given, for reports: it makes the same run again.
pub fn command_line() -> String {
    let mut words = std::env::args_os().map(|word| word.to_string_lossy().into_owned());
    let path = words.next().unwrap_or_default();
    let name = std::path::Path::new(&path).file_stem().unwrap_or_default().to_string_lossy().into_owned();
    std::iter::once(name).chain(words).map(quoted).collect::<Vec<_>>().join(" ")
}

/// A word as a shell takes it for one.
pub fn quoted(word: String) -> String {
    if word.contains(|c: char| c.is_whitespace() || "'\"$`\\&;|<>()".contains(c)) {
        format!("'{}'", word.replace('\'', "'\\''"))
    } else {
        word
    }
}
