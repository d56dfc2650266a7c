//! The program `flockmap`.
#![forbid(unsafe_code)]
#![allow(unreachable_pub, reason = "a program has no outside")]

mod args;
mod bench_codecs;
mod json_file;
mod measure;
mod options;
mod progress;
mod sources;
mod stop;
mod table;

use std::process::ExitCode;

use clap::Parser;

use args::{BenchCommand, Cli, Command};

/// The result is not what it must be: robots disagree, a codec is not lossless.
const EXIT_DISAGREEMENT: u8 = 1;
/// The work could not be done; the same code as for a wrong command line.
const EXIT_FAILED: u8 = 2;

fn main() -> ExitCode {
    let cli = Cli::parse();
    if !matches!(cli.command, Command::Node(_)) {
        stop::listen();
    }
    let result = match &cli.command {
        Command::Bench(BenchCommand::Codecs(args)) => bench_codecs::run(args),
        _ => Ok(true),
    };
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
