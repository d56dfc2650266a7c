//! `flockmap sim`: simulated swarms: written as records, or in virtual time for their protocol.

pub mod explore;
mod fly;
pub mod robot_record;
mod swarm;
mod table;

use crate::args_sim::SimCommand;

/// Runs the command.
pub fn run(command: &SimCommand) -> anyhow::Result<bool> {
    match command {
        SimCommand::Fly(args) => fly::run(args),
        SimCommand::Explore(args) => explore::run(args),
        SimCommand::Swarm(args) => swarm::run(args),
        SimCommand::Table(args) => table::run(args),
    }
}
