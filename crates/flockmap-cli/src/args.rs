//! What may be said on the command line.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use flockmap::codec::Codec;
use flockmap::grid::Preset;
use flockmap_worlds::{Lidar, Rendering};

use crate::args_sim::SimCommand;
use crate::bench_application::BenchApplicationArgs;
use crate::bench_codecs::MethodName;
use crate::bench_paper::args::BenchPaperArgs;
use crate::bench_random::BenchRandomArgs;
use crate::radio::args::RadioArgs;

/// Keeps the 3-D occupancy map of every robot of a swarm in sync over a thin, lossy radio.
#[derive(Parser, Debug)]
#[command(name = "flockmap", version, arg_required_else_help = true, after_help = START_HERE)]
pub struct Cli {
    #[command(subcommand)]
    pub command: Command,
}

const START_HERE: &str = "\
Start here:
  flockmap demo                                 two robots, a forest, real sockets, one minute
  flockmap replay forest --loss 0.2             two simulated robots, every fifth datagram lost
  flockmap replay robot1.mcap robot2.mcap       your own records
  flockmap bench codecs forest                  what each codec costs on the same cycles

`flockmap COMMAND --help` says more, with examples.";

#[derive(Subcommand, Debug)]
pub enum Command {
    /// Fly a swarm over real UDP sockets on this machine and report what it cost
    #[command(after_help = "\
Examples:
  flockmap demo
  flockmap demo --scene indoor --robots 5 --seconds 30 --out /tmp/indoor

Each robot is a node of its own with its own socket. At the end there are a table here, and report.html and report.json
in the folder given by --out. Exit code 1 if any two robots disagree on a voxel.")]
    Demo(DemoArgs),
    /// Run one robot, for real
    #[command(after_help = "\
Example:
  flockmap node --config robot.toml

The file `robot.example.toml` of the crate flockmap-node holds every option with its meaning and default.")]
    Node(NodeArgs),
    /// Make a new swarm key: with it, robots believe only each other, and nobody else can read what they send
    #[command(after_help = "\
Examples:
  flockmap key --out swarm.key      a new file that only its owner can read
  flockmap key                      to the terminal

The key is 32 random bytes as 64 hex digits. Copy the file to every robot and name it in its configuration:
  [session]
  swarm_key_file = \"swarm.key\"
Or put the digits there as swarm_key, or into the environment variable FLOCKMAP_SWARM_KEY. docs/key.md says what a key
covers and what it does not.")]
    Key(KeyArgs),
    /// A bad radio on a desk: robots talk through it, and it loses, delays, doubles and damages what they say
    #[command(after_help = crate::radio::args::HELP)]
    Radio(RadioArgs),
    /// Put records through the whole stack in virtual time: map, pack, send, lose, repair, merge
    #[command(after_help = "\
Examples:
  flockmap replay robot1.mcap robot2.mcap --resolution 0.2 --range 30
  flockmap replay robot1.mcap robot2.mcap --resolution 0.2 --range 30 --loss 0.2 --delay-ms 50 --json out.json
  flockmap replay kaist03/ --resolution 0.2 --range 40
  flockmap replay fr_079.bt --robots 3 --seconds 30 --out report/
  flockmap replay forest --loss 0.3 --budget-kb-s 40

A RECORD is an .mcap (PointCloud2 with odometry or tf), or a folder with Scans/*.pcd, a KITTI pose file and times.txt;
each record is one robot; a single record is cut by time into --robots robots. In place of records one world can be named: forest, indoor, or a .bt, .pcd, .ply, .las or .laz file;
then --robots simulated robots fly through it. The same command gives the same bytes every time.
Exit code 1 if any two robots disagree on a voxel, or packages are missing at the end.")]
    Replay(ReplayArgs),
    /// Fly a simulated swarm and write it as records
    #[command(subcommand)]
    Sim(SimCommand),
    /// Measure codecs, or the mapper
    #[command(subcommand)]
    Bench(BenchCommand),
    /// Look into a record, a map, a point cloud, or a map package
    #[command(after_help = "\
Examples:
  flockmap info robot1.mcap
  flockmap info fr_079.bt
  flockmap info package.bin         the bytes of one map package
  flockmap info store/              what a robot has on disk for its next run

With --json the facts go to a file as well.")]
    Info(InfoArgs),
    /// Map a record and take the map elsewhere, or convert a map or cloud
    #[command(after_help = "\
Examples:
  flockmap export robot1.mcap --to map.bt --resolution 0.2 --range 30
  flockmap export robot1.mcap --to map.ply --free
  flockmap export fr_079.bt --to map.pcd
  flockmap export TLS_Clip.laz --to map.bt --resolution 0.2

A record is mapped with the mapper options. An OctoMap keeps its own resolution. Of a cloud every voxel with a point is
occupied. The ending of --to decides the format: .ply, .pcd or .bt.")]
    Export(ExportArgs),
}

#[derive(Subcommand, Debug)]
pub enum BenchCommand {
    /// All codecs on the same cycles of mapping: bytes, time, agreement
    #[command(after_help = "\
Examples:
  flockmap bench codecs forest --lidar avia
  flockmap bench codecs robot1.mcap robot2.mcap --resolution 0.2 --range 30 --json codecs.json
  flockmap bench codecs forest --codec paper,flock
  flockmap bench codecs forest --codec paper,flock --t-l-occupied 0.1 --t-l 2
  flockmap bench codecs forest --codec all

A method is `flock`, Flockmap's own codec, in packages of at most 1,150 bytes; or another codec (raw, nested-zlib, paper,
racer), which codes each cycle as one package, or with `-datagrams` in such packages as well; or a rival. Some rivals are
lossy or stale: they are marked, and their agreement is what they reach.
Exit code 1 if a lossless method gets a voxel wrong.")]
    Codecs(Box<BenchCodecsArgs>),
    /// The mapper beside OctoMap, on the same scans
    #[command(after_help = "\
Example:
  flockmap bench mapping --scans 40

Needs a C++ compiler and Debian's liboctomap-dev for the OctoMap half; without them that half is skipped with a word.")]
    Mapping(BenchMappingArgs),
    /// What an outage and a late joiner cost, beside the map coded once
    #[command(after_help = "\
Examples:
  flockmap bench catch-up forest --seconds 600 --outage 60
  flockmap bench catch-up robot1.mcap robot2.mcap --resolution 0.2 --range 30 --seconds 100 --outage 20

In the middle of the flight the first robot hears nobody and is heard by nobody. When the flight is over and everything has arrived, one
robot more comes with an empty map. Everything on the wire is counted, requests and headers of IP and UDP too. Exit code 1 if layers differ
at the end.")]
    CatchUp(Box<BenchCatchUpArgs>),
    /// Changes drawn at random, beside the entropy limit: the paper's Fig. 5
    #[command(after_help = "\
Examples:
  flockmap bench random --quick
  flockmap bench random --out fig5/ --csv fig5.csv

Four maps whose voxels need addresses of 2, 3, 3 and 4 bytes, shares of 0.0001 to 1, ten draws each.
Exit code 1 if any codec gets a voxel wrong.")]
    Random(BenchRandomArgs),
    /// The paper's whole evaluation: every table and figure of its Section V, with the rivals, in one report
    #[command(after_help = "\
Examples:
  flockmap bench paper --quick
  flockmap bench paper --out paper/
  flockmap bench paper --only table1,table2 --keep-records
  flockmap bench paper robot1.mcap robot2.mcap --only beyond --beyond-resolution 0.2 --beyond-range 30

Flies two explorations, records them, and measures every method on the same records. Half an hour at most on two cores, three minutes with
--quick. Writes report.html, report.json and a CSV file for each table. Exit code 1 if a lossless method gets a voxel wrong.")]
    Paper(BenchPaperArgs),
    /// A leader that looks backwards crosses a thicket on its follower's map: the paper's Sec. V-B
    #[command(after_help = "\
Examples:
  flockmap bench application --quick
  flockmap bench application --seeds 20 --json application.json
  flockmap bench application --rates 2,10 --losses 0 --obstacles-first 2

Every seed is a thicket of its own, flown without sync, with sync over a radio without limit, and with each budget and loss. Who
touches what is judged in the world as it is. The same command gives the same flights every time.")]
    Application(BenchApplicationArgs),
}

/// How robots map and pack.
#[derive(Args, Debug, Clone)]
#[command(next_help_heading = "Mapping and packing")]
pub struct MapArgs {
    /// Side of a voxel in metres
    #[arg(long, value_name = "M", default_value_t = 0.1)]
    pub resolution: f64,
    /// Rays longer than this many metres are cut there
    #[arg(long, value_name = "M", default_value_t = 7.0)]
    pub range: f64,
    /// A cycle of mapping is sent after so many seconds
    #[arg(long, value_name = "S", default_value_t = 0.5)]
    pub t_l: f64,
    /// Obstacles are sent after so many seconds, ahead of free space [default: with everything else]
    #[arg(long, value_name = "S")]
    pub t_l_occupied: Option<f64>,
    /// A cycle of mapping is sent once so many voxels have changed
    #[arg(long, value_name = "N", default_value_t = 50_000)]
    pub d: usize,
    /// Rules of the mapper: rog-map, racer or octomap
    #[arg(long, value_name = "NAME", default_value_t = Preset::RogMap)]
    pub mapper: Preset,
}

/// What the robots see.
#[derive(Args, Debug, Clone)]
#[command(next_help_heading = "Simulated flights and records")]
pub struct SourceArgs {
    /// LiDAR of simulated robots: avia (as on the paper's robots) or mid360
    #[arg(long, value_name = "NAME", default_value_t = Lidar::Avia)]
    pub lidar: Lidar,
    /// How far the simulated LiDAR sees, in metres. Returns from beyond --range carve free space up to there
    /// [default: --range, as in the paper's simulation: what is farther gives no return]
    #[arg(long, value_name = "M")]
    pub lidar_range: Option<f64>,
    /// Rays of the simulated LiDAR that hit nothing carve free space too
    #[arg(long)]
    pub no_returns: bool,
    /// How beams meet the world: cast (exact) or polar (an image of ranges from points, as the MARSIM simulator does)
    #[arg(long, value_name = "NAME", default_value_t = Rendering::Cast)]
    pub rendering: Rendering,
    /// Standard deviation of the noise on the range of a return, in metres (0.02 is that of real devices)
    #[arg(long, value_name = "M", default_value_t = 0.0)]
    pub range_noise: f64,
    /// Share of the returns that are lost, 0 to 1
    #[arg(long, value_name = "P", default_value_t = 0.0)]
    pub drop_out: f64,
    /// The simulated robot moves during a scan, and its points are not corrected for it
    #[arg(long)]
    pub scan_motion: bool,
    /// Spheres and boxes of 0.6 to 0.8 m that move about at 1 to 3 m/s and are seen by simulated robots
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub moving_obstacles: usize,
    /// Robots are seen in each other's scans, and leave each other out of their maps. With records: they were seen, so leave
    /// them out (poses in one common frame)
    #[arg(long)]
    pub see_team_mates: bool,
    /// Seed of generated worlds, flights, and of the radio
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
    /// Simulated robots; `replay` of a single record cuts it by time into as many
    #[arg(long, value_name = "N", default_value_t = 2)]
    pub robots: usize,
    /// Length of simulated flights, and where records are cut, in seconds [default: flights 60, records whole]
    #[arg(long, value_name = "S")]
    pub seconds: Option<f64>,
    /// Highest speed of simulated robots in m/s [default: 1.5; robots that explore: 2]
    #[arg(long, value_name = "M_S")]
    pub speed: Option<f64>,
    /// Side of the solid cells of a world made from a point cloud, in metres [default: 0.1, and 0.2 for .las and .laz]
    #[arg(long, value_name = "M")]
    pub world_resolution: Option<f64>,
    /// Pose file of a folder of scans, in KITTI's form [default: optimized_poses.txt, odom_poses.txt or poses.txt in it]
    #[arg(long, value_name = "FILE")]
    pub poses: Option<PathBuf>,
    /// Time between scans of a folder without times.txt, in seconds
    #[arg(long, value_name = "S")]
    pub scan_period: Option<f64>,
    /// Topic of the scans in an .mcap [default: the only one with PointCloud2]
    #[arg(long, value_name = "TOPIC")]
    pub points_topic: Option<String>,
    /// Topic of the odometry in an .mcap [default: the one that tells of the frame of the scans]
    #[arg(long, value_name = "TOPIC")]
    pub odometry_topic: Option<String>,
    /// Frame of the map in an .mcap [default: parent frame of the odometry, or root of tf]
    #[arg(long, value_name = "FRAME")]
    pub map_frame: Option<String>,
}

/// How datagrams go out.
#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq)]
pub enum CastName {
    /// To each robot on its own; every copy counts
    Unicast,
    /// Once for all, as on a shared radio
    Broadcast,
}

#[derive(Args, Debug)]
pub struct ReplayArgs {
    /// Records, one for each robot; or one world: forest, indoor, or a .bt .pcd .ply .las .laz file
    #[arg(value_name = "RECORD", required = true)]
    pub records: Vec<PathBuf>,
    /// Share of datagrams that the radio loses, 0 to 1
    #[arg(long, value_name = "P", default_value_t = 0.0)]
    pub loss: f64,
    /// Delay of the radio in milliseconds
    #[arg(long, value_name = "D", default_value_t = 0.0)]
    pub delay_ms: f64,
    /// Each datagram is late by up to so many milliseconds more, so that they overtake each other
    #[arg(long, value_name = "J", default_value_t = 0.0)]
    pub jitter_ms: f64,
    /// Share of datagrams that arrive twice, 0 to 1
    #[arg(long, value_name = "P", default_value_t = 0.0)]
    pub duplication: f64,
    /// Most kilobytes (1,024 bytes) that a robot sends in a second, IP and UDP headers counted; at least 0.49. Below 1.96
    /// it holds on average, with one datagram of 1,228 bytes at once [default: 1,953]
    #[arg(long, value_name = "B")]
    pub budget_kb_s: Option<f64>,
    /// Unicast or broadcast
    #[arg(long, value_enum, default_value_t = CastName::Unicast)]
    pub cast: CastName,
    /// Codec of the packages: flock, paper, nested-zlib, raw or racer
    #[arg(long, value_name = "NAME", default_value_t = Codec::Flock)]
    pub codec: Codec,
    /// The session behaves as in the paper: packages on request only, oldest first, everyone answers
    #[arg(long)]
    pub paper_session: bool,
    /// Records keep their own time in place of all starting together
    #[arg(long)]
    pub real_stamps: bool,
    /// Write what the table shows as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Write report.html and report.json to this folder
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    #[command(flatten)]
    pub map: MapArgs,
    #[command(flatten)]
    pub source: SourceArgs,
}

#[derive(Args, Debug)]
pub struct BenchCatchUpArgs {
    /// Records, one for each robot; or one world: forest, indoor, or a .bt .pcd .ply .las .laz file
    #[arg(value_name = "RECORD", required = true)]
    pub records: Vec<PathBuf>,
    /// Length of the outage in seconds; 0: none
    #[arg(long, value_name = "S", default_value_t = 60.0)]
    pub outage: f64,
    /// Most kilobytes (1,024 bytes) that a robot sends in a second, IP and UDP headers counted
    #[arg(long, value_name = "B", default_value_t = 20.0)]
    pub budget_kb_s: f64,
    /// Share of datagrams that the radio loses, 0 to less than 1
    #[arg(long, value_name = "P", default_value_t = 0.0)]
    pub loss: f64,
    /// Delay of the radio in milliseconds
    #[arg(long, value_name = "D", default_value_t = 20.0)]
    pub delay_ms: f64,
    /// Codec of the packages: flock, paper, nested-zlib, raw or racer
    #[arg(long, value_name = "NAME", default_value_t = Codec::Flock)]
    pub codec: Codec,
    /// Write what the table shows as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    #[command(flatten)]
    pub map: MapArgs,
    #[command(flatten)]
    pub source: SourceArgs,
}

#[derive(Args, Debug)]
pub struct DemoArgs {
    /// forest, indoor, or a world file (.bt .pcd .ply .las .laz)
    #[arg(long, value_name = "SCENE", default_value = "forest")]
    pub scene: PathBuf,
    /// Codec of the packages: flock, paper, nested-zlib, raw or racer
    #[arg(long, value_name = "NAME", default_value_t = Codec::Flock)]
    pub codec: Codec,
    /// Folder for report.html and report.json
    #[arg(long, value_name = "DIR", default_value = "flockmap-demo")]
    pub out: PathBuf,
    #[command(flatten)]
    pub map: MapArgs,
    #[command(flatten)]
    pub source: SourceArgs,
}

#[derive(Args, Debug)]
pub struct KeyArgs {
    /// New file for the key [default: the terminal]
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
}

#[derive(Args, Debug)]
pub struct NodeArgs {
    /// The robot's configuration
    #[arg(long, value_name = "FILE")]
    pub config: PathBuf,
}

#[derive(Args, Debug)]
pub struct BenchCodecsArgs {
    /// Records, or one world: forest, indoor, or a .bt .pcd .ply .las .laz file
    #[arg(value_name = "RECORD", required = true)]
    pub records: Vec<PathBuf>,
    /// Methods, separated by commas, or all [default: raw,nested-zlib,paper,racer,paper-datagrams,flock]
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub codec: Vec<MethodName>,
    /// Write the table as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    #[command(flatten)]
    pub map: MapArgs,
    #[command(flatten)]
    pub source: SourceArgs,
}

#[derive(Args, Debug)]
pub struct BenchMappingArgs {
    /// World to fly through: forest, indoor, or a world file
    #[arg(long, value_name = "SCENE", default_value = "forest")]
    pub scene: PathBuf,
    /// Scans to map
    #[arg(long, value_name = "N", default_value_t = 40)]
    pub scans: usize,
    /// Side of a voxel in metres
    #[arg(long, value_name = "M", default_value_t = 0.1)]
    pub resolution: f64,
    /// Rays longer than this many metres are cut there
    #[arg(long, value_name = "M", default_value_t = 7.0)]
    pub range: f64,
    /// LiDAR: mid360 or avia
    #[arg(long, value_name = "NAME", default_value_t = Lidar::Mid360)]
    pub lidar: Lidar,
    /// Seed of the world and of the flight
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
    /// Write the table as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

#[derive(Args, Debug)]
pub struct InfoArgs {
    /// A record, map, cloud, map package, or the folder of a store
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// Write the facts as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

#[derive(Args, Debug)]
pub struct ExportArgs {
    /// A record, an OctoMap, or a point cloud
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// Where to: a path that ends in .ply, .pcd or .bt
    #[arg(long, value_name = "MAP")]
    pub to: PathBuf,
    /// Write free voxels too (a .bt always holds them)
    #[arg(long)]
    pub free: bool,
    #[command(flatten)]
    pub map: MapArgs,
    #[command(flatten)]
    pub source: SourceArgs,
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    fn parse(line: &str) -> Result<Cli, clap::Error> {
        Cli::try_parse_from(line.split_whitespace())
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
            }
        }
        Cli::command().get_subcommands().for_each(check);
    }

    #[test]
    fn replay_takes_records_and_the_radio() {
        let cli =
            parse("flockmap replay a.mcap b.mcap --loss 0.2 --delay-ms 50 --cast broadcast --d 100").unwrap();
        let Command::Replay(args) = cli.command else { panic!("{cli:?}") };
        assert_eq!(args.records.len(), 2);
        assert_eq!((args.loss, args.delay_ms, args.map.d), (0.2, 50.0, 100));
        assert_eq!(args.cast, CastName::Broadcast);
        assert_eq!((args.map.resolution, args.map.range, args.map.t_l), (0.1, 7.0, 0.5));
    }

    #[test]
    fn bench_codecs_takes_a_list_of_methods() {
        let cli = parse("flockmap bench codecs forest --codec paper,racer,paper-datagrams").unwrap();
        let Command::Bench(BenchCommand::Codecs(args)) = cli.command else { panic!("{cli:?}") };
        let names: Vec<String> = args.codec.iter().map(ToString::to_string).collect();
        assert_eq!(names, ["paper", "racer", "paper-datagrams"]);
    }

    #[test]
    fn wrong_words_are_named() {
        let error = parse("flockmap bench codecs forest --codec paper,zip").unwrap_err().to_string();
        assert!(error.contains("zip") && error.contains("nested-zlib"), "{error}");
        let error = parse("flockmap replay forest --mapper octo").unwrap_err().to_string();
        assert!(error.contains("octo") && error.contains("rog-map"), "{error}");
        assert!(parse("flockmap replay").is_err());
        assert!(parse("flockmap replay forest --looss 0.2").unwrap_err().to_string().contains("--loss"));
    }
}
