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
    /// Fly the sync protocol of a whole swarm in virtual time, under everything that a seed can do, with checkers at every event
    #[command(after_help = "\
Examples:
  flockmap sim swarm --seed 7
  flockmap sim swarm --seed 1 --seeds 10000
  flockmap sim swarm --seed 3 --robots 5 --radio wifi_lossy --seconds 20 --cast broadcast
  flockmap sim swarm --file tests/seeds/once-failed.txt

One seed decides everything: number of robots, who hears whom, loss, bursts, delay, reordering, duplication, flipped bits, rates and queues,
partitions, half-open links, clocks (also such that step, repeat and rewind), crashes, restarts by the hundred, disks that fail, keys and an outsider,
faulty senders, budgets, limits. What was drawn is printed before the first event. An option takes the place of what would be drawn.
Each robot is a real one, with a mapper, codec, session and fused map, in a small world. Mapping ends, links heal, and then all must agree.

Checkers: voxel (a layer holds only what its origin told), layer (nothing older than what is held), packed (packages say what a cycle
changed), fused (the fused map follows from the layers), memory, in_flight (stated limits), twice (nothing twice within a round trip),
budget (bytes of any second), quiet (nothing but requests when nothing is missing), agreement (equal maps in time), still (time goes on),
nonce and key (sealed datagrams), identity (no run twice), path (an address is used after it has answered), work (what a datagram can cost),
crash (no panic). A failure names the checker, the robot, the time, and the one command that repeats it; the exit code is 1 then.")]
    Swarm(SimSwarmArgs),
    /// What a swarm costs by its radio and the number of its robots: bytes, airtime, age, time to agreement
    #[command(after_help = "\
Examples:
  flockmap sim table --robots-max 20
  flockmap sim table --file tests/tables/swarms.txt
  flockmap sim table --robots-max 20 --file tests/tables/swarms.txt --check

Broadcast, without crashes and partitions; the same on every machine. With --check nothing is written: the rows are held against
those of the file, and a row that differs is shown, with exit code 1. All checkers of `sim swarm` watch these flights too.")]
    Table(SimTableArgs),
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

#[derive(Args, Debug)]
pub struct SimSwarmArgs {
    /// Decides everything that is left to chance
    #[arg(long, value_name = "S", default_value_t = 1)]
    pub seed: u64,
    /// Fly so many seeds, from --seed on, and sum up
    #[arg(long, value_name = "N")]
    pub seeds: Option<u64>,
    /// Fly what a file says: options of this command on each line, words after a # are for people
    #[arg(long, value_name = "FILE", conflicts_with_all = ["seed", "seeds", "robots", "radio", "seconds", "cast", "budget", "calm", "json"])]
    pub file: Option<PathBuf>,
    /// Robots, 2 to 200 [default: drawn, 2 to 6]
    #[arg(long, value_name = "N")]
    pub robots: Option<usize>,
    /// lan, wifi, wifi_lossy, wifi_congested, mesh_line, intermittent or lora [default: drawn]
    #[arg(long, value_name = "PRESET")]
    pub radio: Option<flockmap_netsim::swarm::RadioPreset>,
    /// Seconds of mapping before links heal [default: drawn, 2 to 8]
    #[arg(long, value_name = "T")]
    pub seconds: Option<f64>,
    /// To each peer on its own, or to all at once [default: drawn]
    #[arg(long, value_name = "CAST")]
    pub cast: Option<CastArg>,
    /// Bytes that each robot may send in a second, 500 or more [default: drawn]
    #[arg(long, value_name = "BYTES_PER_S")]
    pub budget: Option<u32>,
    /// No crashes, partitions, half-open links, tight limits or mixed settings: the radio alone
    #[arg(long)]
    pub calm: bool,
    /// Threads that fly several seeds; what happens never depends on it [default: as many as there are cores]
    #[arg(long, value_name = "N")]
    pub threads: Option<usize>,
    /// Write what the table shows as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

#[derive(Args, Debug)]
pub struct SimTableArgs {
    /// Rows for up to so many robots, 2 to 100
    #[arg(long, value_name = "N", default_value_t = 100)]
    pub robots_max: usize,
    /// Write the table to this file
    #[arg(long, value_name = "FILE")]
    pub file: Option<PathBuf>,
    /// Hold the rows against those of --file
    #[arg(long, requires = "file")]
    pub check: bool,
}

/// How datagrams go out.
#[derive(clap::ValueEnum, Clone, Copy, Debug)]
pub enum CastArg {
    /// To each peer on its own.
    Unicast,
    /// To all at once.
    Broadcast,
}

impl From<CastArg> for flockmap::Cast {
    fn from(cast: CastArg) -> Self {
        match cast {
            CastArg::Unicast => Self::Unicast,
            CastArg::Broadcast => Self::Broadcast,
        }
    }
}
