//! What may be said to `flockmap sim`.

use std::path::PathBuf;

use clap::{Args, Subcommand};

use crate::args::{MapArgs, SourceArgs};

#[derive(Subcommand, Debug)]
pub enum SimCommand {
    /// Fly a simulated swarm and write what each robot saw: one MCAP file a robot
    #[command(
        after_help = "\
Examples:
  flockmap sim fly --scene forest --robots 2 --seconds 60 --out flight
  flockmap replay flight/robot1.mcap flight/robot2.mcap --loss 0.2
  flockmap sim fly --scene fr_079.bt --robots 3 --lidar mid360 --no-returns --out office

Each file holds the scans (PointCloud2), the pose of the sensor at each (Odometry and tf), and every 2 s a picture of the map that the robot has
made and of its way; ROS 2, Foxglove and Rerun open it as it is. The same command gives the same bytes, whatever --threads is.
A replay of the files is the replay of the flight itself.",
        // What says how to read records, or when to send, says nothing here.
        mut_args(hide_foreign)
    )]
    Fly(SimFlyArgs),
}

/// Options that the shared groups hold for other commands.
fn hide_foreign(arg: clap::Arg) -> clap::Arg {
    let foreign =
        ["poses", "scan_period", "points_topic", "odometry_topic", "map_frame", "t_l", "t_l_occupied", "d"];
    if foreign.contains(&arg.get_id().as_str()) { arg.hide(true) } else { arg }
}

#[derive(Args, Debug)]
pub struct SimFlyArgs {
    /// forest, indoor, or a world file (.bt .pcd .ply .las .laz)
    #[arg(long, value_name = "SCENE", default_value = "forest")]
    pub scene: PathBuf,
    /// Folder for the files robot1.mcap, robot2.mcap …
    #[arg(long, value_name = "DIR", default_value = "flockmap-flight")]
    pub out: PathBuf,
    /// Leave out the pictures of map and way
    #[arg(long)]
    pub no_view: bool,
    /// Robots that are recorded at the same time [default: as many as there are cores]
    #[arg(long, value_name = "N")]
    pub threads: Option<usize>,
    /// Write what the table shows as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    #[command(flatten)]
    pub map: MapArgs,
    #[command(flatten)]
    pub source: SourceArgs,
}
