//! What may be said to `flockmap sim`.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use flockmap::Codec;

use crate::args::{MapArgs, SourceArgs};

#[derive(Subcommand, Debug)]
pub enum SimCommand {
    /// Fly a simulated swarm and write what each robot saw: one MCAP file a robot
    #[command(
        after_help = "\
Examples:
  flockmap sim fly --scene forest --robots 2 --seconds 60 --out flight
  flockmap replay flight/robot1.mcap flight/robot2.mcap --see-team-mates --loss 0.2
  flockmap sim fly --scene fr_079.bt --robots 3 --lidar mid360 --no-returns --out office

Each file holds the scans (PointCloud2), the pose of the sensor at each (Odometry and tf), and every 2 s a picture of the map that the robot has
made and of its way; ROS 2, Foxglove and Rerun open it as it is. The same command gives the same bytes, whatever --threads is.
A replay of the files is the replay of the flight itself: `replay forest --see-team-mates` gives the same bytes. Robots are in each other's scans;
--see-team-mates leaves them out of the maps again.",
        // What says how to read records, or when to send, says nothing here.
        mut_args(hide_foreign)
    )]
    Fly(Box<SimFlyArgs>),
    /// Let a swarm explore a world on its own until nothing is left to see, and write what each robot saw
    #[command(
        after_help = "\
Examples:
  flockmap sim explore --scene forest --robots 2 --out explored
  flockmap sim explore --scene cubicle_office.pcd --robots 5 --lidar mid360 --out office --json office.json
  flockmap sim explore --scene indoor --robots 3 --loss 0.3 --delay-ms 100 --budget-kb-s 20
  flockmap sim explore --scene indoor --robots 3 --no-sync

Each robot looks for frontiers in its own fused map, which holds what came over the radio: a slow or lossy radio costs time, and without one
(--no-sync) everybody sees everything. The files are as those of `sim fly`, with pictures of the fused map.",
        mut_args(hide_foreign_to_exploration)
    )]
    Explore(Box<SimExploreArgs>),
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
    /// Robots are not seen in each other's scans
    #[arg(long)]
    pub hide_team_mates: bool,
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

#[derive(Args, Debug)]
pub struct SimExploreArgs {
    /// forest, indoor, or a world file (.bt .pcd .ply .las .laz)
    #[arg(long, value_name = "SCENE", default_value = "forest")]
    pub scene: PathBuf,
    /// Folder for the files robot1.mcap, robot2.mcap …
    #[arg(long, value_name = "DIR", default_value = "flockmap-exploration")]
    pub out: PathBuf,
    /// The exploration ends after so many seconds of flight at the latest
    #[arg(long, value_name = "S", default_value_t = 600.0)]
    pub seconds_max: f64,
    /// Share of datagrams that the radio loses, 0 to 1
    #[arg(long, value_name = "P", default_value_t = 0.0)]
    pub loss: f64,
    /// Delay of the radio in milliseconds
    #[arg(long, value_name = "D", default_value_t = 0.0)]
    pub delay_ms: f64,
    /// Most kilobytes (1,024 bytes) that a robot sends in a second, IP and UDP headers counted [default: 1,953]
    #[arg(long, value_name = "B")]
    pub budget_kb_s: Option<f64>,
    /// No radio: every robot has only what it sees itself
    #[arg(long, conflicts_with_all = ["loss", "delay_ms", "budget_kb_s"])]
    pub no_sync: bool,
    /// Codec of the packages: flock, paper, nested-zlib, raw or racer
    #[arg(long, value_name = "NAME", default_value_t = Codec::Flock)]
    pub codec: Codec,
    /// Leave out the pictures of map and way
    #[arg(long)]
    pub no_view: bool,
    /// Threads on which robots scan, map and plan; what happens never depends on it [default: as many as there are cores]
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
