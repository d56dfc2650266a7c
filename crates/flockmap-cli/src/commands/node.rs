//! `flockmap node`: one robot.

use std::path::PathBuf;

use clap::Args;

/// Run one robot, for real
#[derive(Args, Debug)]
#[command(after_help = "\
Example:
  flockmap node --config robot.toml

  flockmap node --schema > robot.schema.json

The file `robot.example.toml` of the crate flockmap-node holds every option with its meaning and default. An editor that knows TOML
completes and checks them in a file that begins with `#:schema robot.schema.json`.")]
pub struct NodeArgs {
    /// The robot's configuration
    #[arg(long, value_name = "FILE", required_unless_present = "schema")]
    pub config: Option<PathBuf>,
    /// Print what a configuration may hold as a JSON schema
    #[arg(long, conflicts_with = "config")]
    pub schema: bool,
}

/// Runs the command until the robot is told to end.
pub fn run(args: &NodeArgs) -> anyhow::Result<bool> {
    match &args.config {
        Some(config) => flockmap_node::run(config)?,
        None => println!("{:#}", flockmap_node::schema()),
    }
    Ok(true)
}
