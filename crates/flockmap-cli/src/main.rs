//! The program `flockmap`.
#![forbid(unsafe_code)]
#![allow(unreachable_pub, reason = "a program has no outside")]

mod args;
mod args_sim;
mod bench_application;
mod bench_catch_up;
mod bench_codecs;
mod bench_mapping;
mod bench_paper;
mod bench_random;
mod chart;
mod codec_run;
mod demo;
mod document;
mod export;
mod html;
mod info;
mod json_file;
mod key;
mod measure;
mod member;
mod options;
mod picture;
mod present_run;
mod progress;
mod radio;
mod replay;
mod report;
#[allow(dead_code, reason = "made for the comparison with the paper; its tests run it")]
mod rival_swarm;
mod sim;
mod sources;
mod stop;
mod swarm;
mod table;
mod team;

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
        Command::Bench(BenchCommand::CatchUp(args)) => bench_catch_up::run(args),
        Command::Bench(BenchCommand::Mapping(args)) => bench_mapping::run(args),
        Command::Bench(BenchCommand::Paper(args)) => bench_paper::run(args),
        Command::Bench(BenchCommand::Application(args)) => bench_application::run(args),
        Command::Bench(BenchCommand::Random(args)) => bench_random::run(args),
        Command::Replay(args) => replay::run(args),
        Command::Sim(command) => sim::run(command),
        Command::Demo(args) => demo::run(args),
        Command::Node(args) => flockmap_node::run(&args.config).map(|()| true),
        Command::Key(args) => key::run(args),
        Command::Radio(args) => radio::run(args),
        Command::Info(args) => info::run(args),
        Command::Export(args) => export::run(args),
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

/// The command as it was given, for reports: the same words make the same run again.
fn command_line() -> String {
    let quoted = |word: String| {
        if word.contains(|c: char| c.is_whitespace() || "'\"$`\\&;|<>()".contains(c)) {
            format!("'{}'", word.replace('\'', "'\\''"))
        } else {
            word
        }
    };
    let words = std::env::args_os().skip(1).map(|word| quoted(word.to_string_lossy().into_owned()));
    std::iter::once("flockmap".to_owned()).chain(words).collect::<Vec<_>>().join(" ")
}
