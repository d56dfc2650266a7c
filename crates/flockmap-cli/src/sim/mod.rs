//! `flockmap sim`: simulated swarms, written as records.

pub mod explore;
mod fly;
pub mod robot_record;

use crate::args_sim::SimCommand;

/// Runs the command.
pub fn run(command: &SimCommand) -> anyhow::Result<bool> {
    match command {
        SimCommand::Fly(args) => fly::run(args),
        SimCommand::Explore(args) => explore::run(args),
    }
}
