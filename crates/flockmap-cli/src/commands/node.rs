//! `flockmap node`: one robot.

use std::path::PathBuf;

use clap::Args;

/// Run one robot, for real
#[derive(Args, Debug)]
#[command(after_help = "\
Example:
  flockmap node --config robot.toml

The file `robot.example.toml` of the crate flockmap-node holds every option with its meaning and default.")]
pub struct NodeArgs {
    /// The robot's configuration
    #[arg(long, value_name = "FILE")]
    pub config: PathBuf,
}

/// Runs the command until the robot is told to end.
pub fn run(args: &NodeArgs) -> anyhow::Result<bool> {
    flockmap_node::run(&args.config).map(|()| true)
}
