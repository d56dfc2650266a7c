//! The program `flockmap`.
#![forbid(unsafe_code)]
#![allow(unreachable_pub, reason = "a program has no outside")]

mod commands;

use std::process::ExitCode;

use anyhow::anyhow;
use clap::{Parser, Subcommand};
use commands::{demo, export, info, key, mirror, node, plan_radio, radio, render, replay, sim, view};
use flockmap_cli::{program, stop};

/// Keeps the 3-D occupancy map of every robot of a swarm in sync over a thin, lossy radio.
#[derive(Parser, Debug)]
#[command(name = "flockmap", version, arg_required_else_help = true, after_help = START_HERE)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

const START_HERE: &str = "\
Start here:
  flockmap demo                                 two robots, a forest, a radio that loses every fifth datagram: one minute
  flockmap demo --view                          the same, seen live in a browser
  flockmap replay forest --loss 0.2             two simulated robots, every fifth datagram lost
  flockmap replay robot1.mcap robot2.mcap       your own records

`flockmap COMMAND --help` says more, with examples. What it costs beside other methods is measured by a program of its own, `flockmap-bench`.";

#[derive(Subcommand, Debug)]
enum Command {
    Demo(demo::DemoArgs),
    Node(node::NodeArgs),
    Mirror(mirror::MirrorArgs),
    Key(key::KeyArgs),
    Radio(radio::RadioArgs),
    PlanRadio(plan_radio::PlanRadioArgs),
    Replay(replay::ReplayArgs),
    #[command(subcommand)]
    Sim(sim::SimCommand),
    Info(info::InfoArgs),
    Export(export::ExportArgs),
    Render(render::RenderArgs),
    View(view::ViewFileArgs),
    /// Went to a program of its own.
    #[command(hide = true, disable_help_flag = true)]
    Bench {
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        words: Vec<String>,
    },
}

fn main() -> ExitCode {
    let cli: Cli = program::parse();
    // A node listens by itself.
    if !matches!(cli.command, Command::Node(_)) {
        stop::listen();
    }
    program::exit_code(match &cli.command {
        Command::Demo(args) => demo::run(args),
        Command::Node(args) => node::run(args),
        Command::Mirror(args) => mirror::run(args),
        Command::Key(args) => key::run(args),
        Command::Radio(args) => radio::run(args),
        Command::PlanRadio(args) => plan_radio::run(args),
        Command::Replay(args) => replay::run(args),
        Command::Sim(command) => sim::run(command),
        Command::Info(args) => info::run(args),
        Command::Export(args) => export::run(args),
        Command::Render(args) => render::run(args),
        Command::View(args) => view::run(args),
        Command::Bench { words } => Err(anyhow!(
            "benchmarks are in a program of their own: cargo run --release -p flockmap-bench -- {}",
            words.join(" ")
        )),
    })
}

#[cfg(test)]
#[path = "../tests/common/documents.rs"]
mod documents;

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;
    use flockmap::Cast;

    fn parse(line: &str) -> Result<Cli, clap::Error> {
        program::try_parse(line.split_whitespace())
    }

    #[test]
    fn the_definition_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn every_command_shows_examples() {
        fn check(command: &clap::Command) {
            if command.has_subcommands() {
                command.get_subcommands().for_each(check);
            } else {
                let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
                assert!(help.contains("Example"), "`{}` has no example", command.get_name());
                assert!(help.contains("flockmap "), "{help}");
                assert!(command.get_about().is_some(), "`{}` says nothing", command.get_name());
            }
        }
        Cli::command().get_subcommands().filter(|command| !command.is_hide_set()).for_each(check);
    }

    #[test]
    fn replay_takes_records_and_the_radio() {
        let cli = parse(
            "flockmap replay a.mcap b.mcap --loss 0.2 --delay-ms 50 --cast broadcast --batch-limit 100",
        )
        .unwrap();
        let Command::Replay(args) = cli.command else { panic!("{cli:?}") };
        assert_eq!(args.records.len(), 2);
        assert_eq!((args.loss, args.delay_ms, args.map.batch_limit), (0.2, 50.0, 100));
        assert_eq!(args.cast, Cast::Broadcast);
        assert_eq!((args.map.resolution, args.map.range, args.map.publish_period), (0.1, 7.0, 0.5));
    }

    #[test]
    fn wrong_words_are_named() {
        let error = parse("flockmap replay forest --mapper octo").unwrap_err().to_string();
        assert!(error.contains("octo") && error.contains("rog-map"), "{error}");
        assert!(parse("flockmap replay").is_err());
        assert!(parse("flockmap replay forest --looss 0.2").unwrap_err().to_string().contains("--loss"));
    }

    #[test]
    fn every_command_in_the_documents_is_understood() {
        documents::assert_understood::<Cli>("flockmap", 20);
    }
}
