//! `flockmap sim`: simulated swarms: written as records, or in virtual time for their protocol.

mod explore;
mod fly;
mod swarm;
mod table;

use clap::Subcommand;

/// Fly a simulated swarm and write it as records
#[derive(Subcommand, Debug)]
pub enum SimCommand {
    Fly(Box<fly::SimFlyArgs>),
    Explore(Box<explore::SimExploreArgs>),
    Swarm(swarm::SimSwarmArgs),
    Table(table::SimTableArgs),
}

/// Runs the command.
pub fn run(command: &SimCommand) -> anyhow::Result<bool> {
    match command {
        SimCommand::Fly(args) => fly::run(args),
        SimCommand::Explore(args) => explore::run(args),
        SimCommand::Swarm(args) => swarm::run(args),
        SimCommand::Table(args) => table::run(args),
    }
}
