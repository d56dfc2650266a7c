//! The program `flockmap-bench`: what Flockmap costs, beside the methods of others, and the tables that its
//! codec ships.
#![forbid(unsafe_code)]
#![allow(unreachable_pub, reason = "a program has no outside")]

mod application;
mod baselines;
mod batcher;
mod calls;
mod catch_up;
mod codec_run;
mod codecs;
mod corridor;
mod day;
mod field;
mod layers;
mod loops;
mod mapping;
mod paper;
mod place;
mod processor;
mod random;
mod rival_swarm;
mod snapshot_run;
mod states;
mod train;

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use flockmap_cli::{program, stop};

/// Measures what Flockmap costs, beside the paper's figures and the methods of others.
#[derive(Parser, Debug)]
#[command(name = "flockmap-bench", version, arg_required_else_help = true, after_help = START_HERE)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

const START_HERE: &str = "\
Start here:
  flockmap-bench codecs forest                  what each method costs on the same batches
  flockmap-bench paper --quick                  everything once, on short flights

`flockmap-bench COMMAND --help` says more, with examples.";

#[derive(Subcommand, Debug)]
enum Command {
    Codecs(Box<codecs::CodecsArgs>),
    States(Box<states::StatesArgs>),
    Layers(Box<layers::LayersArgs>),
    Calls(calls::CallsArgs),
    Day(day::DayArgs),
    Mapping(mapping::MappingArgs),
    Field(field::FieldArgs),
    CatchUp(Box<catch_up::CatchUpArgs>),
    Loops(Box<loops::LoopsArgs>),
    Random(random::RandomArgs),
    Paper(paper::PaperArgs),
    Application(application::ApplicationArgs),
    Train(train::TrainArgs),
}

fn main() -> ExitCode {
    let cli: Cli = program::parse();
    // Training leaves nothing behind before its end: Ctrl-C may end it at once.
    if !matches!(cli.command, Command::Train(_)) {
        stop::listen();
    }
    program::exit_code(match &cli.command {
        Command::Codecs(args) => codecs::run(args),
        Command::States(args) => states::run(args),
        Command::Layers(args) => layers::run(args),
        Command::Calls(args) => calls::run(args),
        Command::Day(args) => day::run(args),
        Command::Mapping(args) => mapping::run(args),
        Command::Field(args) => field::run(args),
        Command::CatchUp(args) => catch_up::run(args),
        Command::Loops(args) => loops::run(args),
        Command::Random(args) => random::run(args),
        Command::Paper(args) => paper::run(args),
        Command::Application(args) => application::run(args),
        Command::Train(args) => train::run(args),
    })
}

#[cfg(test)]
#[path = "../../flockmap-cli/tests/common/documents.rs"]
mod documents;

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    fn parse(line: &str) -> Result<Cli, clap::Error> {
        program::try_parse(line.split_whitespace())
    }

    #[test]
    fn the_definition_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn every_command_shows_examples() {
        for command in Cli::command().get_subcommands() {
            let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
            assert!(help.contains("Example"), "`{}` has no example", command.get_name());
            assert!(help.contains("flockmap-bench "), "{help}");
            assert!(command.get_about().is_some(), "`{}` says nothing", command.get_name());
        }
    }

    #[test]
    fn codecs_takes_a_list_of_methods() {
        let cli = parse("flockmap-bench codecs forest --codec paper,racer,paper-datagrams").unwrap();
        let Command::Codecs(args) = cli.command else { panic!("{cli:?}") };
        let names: Vec<String> =
            args.codec.iter().flat_map(|named| &named.0).map(ToString::to_string).collect();
        assert_eq!(names, ["paper", "racer", "paper-datagrams"]);
        let error = parse("flockmap-bench codecs forest --codec paper,zip").unwrap_err().to_string();
        assert!(error.contains("zip") && error.contains("nested-zlib"), "{error}");
    }

    #[test]
    fn training_writes_or_checks() {
        for wrong in ["", "--threads 2", "--check --out file", "--check --threads 0"] {
            assert!(parse(&format!("flockmap-bench train {wrong}")).is_err(), "{wrong:?}");
        }
        assert!(parse("flockmap-bench train --check").is_ok());
    }

    #[test]
    fn every_command_in_the_documents_is_understood() {
        documents::assert_understood::<Cli>("flockmap-bench", 10);
    }
}
