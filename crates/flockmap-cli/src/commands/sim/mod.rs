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

/// Options that the shared groups hold for other commands.
fn hide_foreign(arg: clap::Arg) -> clap::Arg {
    let foreign = [
        "see_team_mates",
        "poses",
        "scan_period",
        "points_topic",
        "odometry_topic",
        "map_frame",
        "t_l",
        "t_l_occupied",
        "d",
    ];
    if foreign.contains(&arg.get_id().as_str()) { arg.hide(true) } else { arg }
}

/// As [`hide_foreign`]; cycles count here, the length of flights does not.
fn hide_foreign_to_exploration(arg: clap::Arg) -> clap::Arg {
    match arg.get_id().as_str() {
        "t_l" | "t_l_occupied" | "d" => arg,
        "seconds" | "moving_obstacles" => arg.hide(true),
        _ => hide_foreign(arg),
    }
}
