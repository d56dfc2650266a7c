//! How a program begins and ends.

use std::ffi::OsString;
use std::process::ExitCode;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::parser::ValueSource;
use clap::{ArgAction, ArgMatches, Command, Error, Parser};

use crate::stop;

/// The result is not what it must be: robots disagree, a codec is not lossless.
const EXIT_DISAGREEMENT: u8 = 1;
/// The work could not be done; the same code as for a wrong command line.
const EXIT_FAILED: u8 = 2;

/// Reads the command line, or says what is wrong with it and ends the program.
pub fn parse<C: Parser>() -> C {
    try_parse(std::env::args_os()).unwrap_or_else(|error| error.exit())
}

/// Reads a command line. Beside what clap does: `--range -3` is a number and not an option; and an option of a
/// shared group that is hidden from a command's help is none of that command's.
///
/// # Errors
/// What is wrong with it, as clap says it.
pub fn try_parse<C: Parser>(
    words: impl IntoIterator<Item = impl Into<OsString> + Clone>,
) -> Result<C, Error> {
    let mut command = with_negative_numbers(C::command());
    let matches = command.try_get_matches_from_mut(words)?;
    refuse_hidden(&mut command, &matches)?;
    C::from_arg_matches(&matches).map_err(|error| error.format(&mut command))
}

fn with_negative_numbers(command: Command) -> Command {
    let takes_value = |action: &ArgAction| matches!(action, ArgAction::Set | ArgAction::Append);
    command
        .mut_args(|arg| if takes_value(arg.get_action()) { arg.allow_negative_numbers(true) } else { arg })
        .mut_subcommands(with_negative_numbers)
}

fn refuse_hidden(command: &mut Command, matches: &ArgMatches) -> Result<(), Error> {
    if let Some((name, matches)) = matches.subcommand()
        && let Some(command) = command.find_subcommand_mut(name)
    {
        return refuse_hidden(command, matches);
    }
    let given = |id: &str| matches.value_source(id) == Some(ValueSource::CommandLine);
    let hidden = command.get_arguments().filter(|arg| arg.is_hide_set());
    let Some(name) = hidden.filter(|arg| given(arg.get_id().as_str())).find_map(|arg| arg.get_long()) else {
        return Ok(());
    };
    let others = command.get_arguments().filter(|arg| !arg.is_hide_set()).filter_map(|arg| arg.get_long());
    let similar = others.filter(|other| other.starts_with(name)).map(|other| format!("--{other}")).next();
    let name = format!("--{name}");
    let mut error = Error::new(ErrorKind::UnknownArgument).with_cmd(command);
    error.insert(ContextKind::InvalidArg, ContextValue::String(name));
    if let Some(similar) = similar {
        error.insert(ContextKind::SuggestedArg, ContextValue::String(similar));
    }
    error.insert(ContextKind::Usage, ContextValue::StyledStr(command.render_usage()));
    Err(error)
}

/// The exit code for what came of a command: whether all is as it must be.
pub fn exit_code(result: anyhow::Result<bool>) -> ExitCode {
    match result {
        Err(error) => {
            eprintln!("error: {}", in_words(&format!("{error:#}")));
            ExitCode::from(EXIT_FAILED)
        }
        Ok(_) if stop::requested() => ExitCode::from(stop::EXIT_CODE),
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(EXIT_DISAGREEMENT),
    }
}

/// A message without the numbers that the system gives its errors: its words say the same.
fn in_words(message: &str) -> String {
    let mut parts = message.split(" (os error ");
    let mut words = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        words += part.split_once(')').map_or(part, |(_, rest)| rest);
    }
    words
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
