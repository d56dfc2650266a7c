//! Options that several commands share, and what the library takes in their place.

use std::path::PathBuf;

use anyhow::{Context, anyhow, ensure};
use clap::Args;
use flockmap::grid::{MapperConfig, Preset};
use flockmap::sync::BYTES_PER_S_MIN;
use flockmap::{BatchConfig, Codec, FusionConfig, Resolution, RobotConfig, RobotId};
use flockmap_worlds::{Lidar, OptionError, Rendering};
use serde::de::{DeserializeOwned, IntoDeserializer as _};

use crate::given::Given;

/// How robots map and pack.
#[derive(Args, Debug, Clone)]
#[command(next_help_heading = "Mapping and packing")]
pub struct MapArgs {
    #[command(flatten)]
    pub given: Given,
    /// Side of a voxel in metres
    #[arg(long, value_name = "M", default_value_t = 0.1)]
    pub resolution: f64,
    /// Rays longer than this many metres are cut there
    #[arg(long, value_name = "M", default_value_t = 7.0)]
    pub range: f64,
    /// A batch of mapping is sent after so many seconds (the paper's t_l)
    #[arg(long, value_name = "S", default_value_t = 0.5)]
    pub publish_period: f64,
    /// Obstacles are sent after so many seconds, ahead of free space [default: with everything else]
    #[arg(long, value_name = "S")]
    pub obstacle_period: Option<f64>,
    /// A batch of mapping is sent once so many voxels have changed (the paper's d)
    #[arg(long, value_name = "N", default_value_t = 50_000)]
    pub batch_limit: usize,
    /// A submap begins after so many metres of way of the sensor [default: one for all]
    #[arg(long, value_name = "M")]
    pub submap_length: Option<f64>,
    /// Where a submap has an obstacle, those that older submaps of its run have within so many voxels go: 0 to 7
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub submap_clears: u8,
    /// Rules of the mapper: rog-map, racer or octomap
    #[arg(long, value_name = "NAME", default_value_t = Preset::RogMap)]
    pub mapper: Preset,
}

/// Options of [`SourceArgs`] that say how simulated robots fly and scan.
pub const OF_FLIGHTS: [&str; 10] = [
    "lidar",
    "lidar_range",
    "no_returns",
    "rendering",
    "range_noise",
    "drop_out",
    "scan_motion",
    "moving_obstacles",
    "speed",
    "world_resolution",
];

/// Options of [`MapArgs`] that say when batches are sent.
pub const OF_BATCHES: [&str; 3] = ["publish_period", "obstacle_period", "batch_limit"];

/// Options of [`SourceArgs`] that say how to read records.
pub const OF_RECORDS: [&str; 5] = ["poses", "scan_period", "points_topic", "odometry_topic", "map_frame"];

/// What the robots see.
#[derive(Args, Debug, Clone)]
#[command(next_help_heading = "Simulated flights")]
pub struct SourceArgs {
    #[command(flatten)]
    pub given: Given,
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
    /// How beams meet the world: cast (exact) or polar (an image of ranges from points, as the MARSIM
    /// simulator does)
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
    /// Robots are seen in each other's scans, and leave each other out of their maps. With records: they were
    /// seen, so leave them out (poses in one common frame)
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
    /// Side of the solid cells of a world made from a point cloud, in metres [default: 0.1, and 0.2 for .las
    /// and .laz]
    #[arg(long, value_name = "M")]
    pub world_resolution: Option<f64>,
    /// Pose file of a folder of scans, in KITTI's form, once for each folder [default: optimized_poses.txt,
    /// odom_poses.txt or poses.txt in it]
    #[arg(long, value_name = "FILE", help_heading = "Records")]
    pub poses: Vec<PathBuf>,
    /// Time between scans of a folder without times.txt, in seconds, for all or once for each folder
    #[arg(long, value_name = "S", help_heading = "Records")]
    pub scan_period: Vec<f64>,
    /// Topic of the scans in an .mcap or bag, for all or once for each robot; of a single record every topic
    /// makes a robot [default: the only one with PointCloud2]
    #[arg(long, value_name = "TOPIC", help_heading = "Records")]
    pub points_topic: Vec<String>,
    /// Topic of the odometry in an .mcap or bag, for all or once for each robot [default: the one that tells
    /// of the frame of the scans]
    #[arg(long, value_name = "TOPIC", help_heading = "Records")]
    pub odometry_topic: Vec<String>,
    /// Frame of the map in an .mcap or bag, for all or once for each robot [default: parent frame of the
    /// odometry, or root of tf]
    #[arg(long, value_name = "FRAME", help_heading = "Records")]
    pub map_frame: Vec<String>,
    /// Topics of the poses of submaps. Commands that play them have the option.
    #[arg(skip)]
    pub submaps_topic: Vec<String>,
}

impl Default for SourceArgs {
    /// As when nothing is said.
    fn default() -> Self {
        #[derive(clap::Parser)]
        struct Line {
            #[command(flatten)]
            source: SourceArgs,
        }
        <Line as clap::Parser>::parse_from(["flockmap"]).source
    }
}

impl MapArgs {
    /// The side of a voxel.
    pub fn resolution(&self) -> anyhow::Result<Resolution> {
        resolution("--resolution", self.resolution)
    }

    /// The mapper's configuration.
    pub fn mapper(&self) -> anyhow::Result<MapperConfig> {
        Ok(MapperConfig::preset(self.mapper, self.resolution()?, self.range()?))
    }

    /// Where rays are cut, in metres.
    pub fn range(&self) -> anyhow::Result<f64> {
        let voxel = self.resolution()?.metres();
        ensure!(
            self.range >= voxel || self.range <= 0.0,
            "--range is {}, less than one voxel of {voxel} m (--resolution is in metres too)",
            self.range
        );
        let most = 500.0 * voxel;
        ensure!(
            self.range > 0.0 && self.range <= most,
            "--range is {}, expected more than 0 and at most {most} m (500 voxels)",
            self.range
        );
        Ok(self.range)
    }

    /// A robot that maps and packs like this. Its id is still to be given.
    pub fn robot(&self, codec: Codec, seed: u64) -> anyhow::Result<RobotConfig> {
        let config = RobotConfig::new(RobotId(1), self.resolution()?, self.range);
        let submap_length_m = self.submap_length;
        if let Some(length) = submap_length_m {
            ensure!(
                (0.1..=1e6).contains(&length),
                "--submap-length is {length}, expected 0.1 to 1,000,000 m"
            );
        }
        let clears = self.submap_clears;
        ensure!(clears <= 7, "--submap-clears is {clears}, expected 0 to 7 voxels");
        let fusion = FusionConfig { submap_clears_voxels: clears, ..config.fusion };
        let (mapper, batch) = (self.mapper()?, self.batch()?);
        Ok(RobotConfig { mapper, batch, codec, seed, submap_length_m, fusion, ..config })
    }

    /// When batches close.
    pub fn batch(&self) -> anyhow::Result<BatchConfig> {
        ensure!(self.batch_limit > 0, "--batch-limit is 0, expected at least 1");
        let obstacle_period_ms =
            self.obstacle_period.map(|seconds| milliseconds("--obstacle-period", seconds)).transpose()?;
        Ok(BatchConfig {
            voxels_max: self.batch_limit,
            publish_period_ms: milliseconds("--publish-period", self.publish_period)?,
            obstacle_period_ms,
        })
    }
}

/// What a simulator says of an option, by the name that this has on the command line.
pub fn as_given(error: OptionError) -> anyhow::Error {
    let OptionError { name, value, expected } = error;
    let (option, unit) = match name {
        "robots" => ("--robots", ""),
        "threads" => ("--threads", ""),
        "speed_m_s" => ("--speed", " m/s"),
        "duration_s" => ("--seconds", " s"),
        "seconds_max" => ("--seconds-max", " s"),
        "range_noise_m" => ("--range-noise", " m"),
        "drop_out" => ("--drop-out", ""),
        name => (name, ""),
    };
    anyhow!("{option} is {value}, expected {expected}{unit}")
}

/// The side of a voxel from the command line.
pub fn resolution(option: &str, side: f64) -> anyhow::Result<Resolution> {
    Resolution::from_metres(side).with_context(|| format!("{option} is {side}, expected 0.001 to 100 m"))
}

/// Seconds from the command line as whole milliseconds.
pub fn milliseconds(option: &str, seconds: f64) -> anyhow::Result<u32> {
    ensure!((0.001..=3_600.0).contains(&seconds), "{option} is {seconds}, expected 0.001 to 3,600 s");
    Ok((seconds * 1e3).round() as u32)
}

/// A share of datagrams from the command line.
pub fn share(option: &str, share: f64) -> anyhow::Result<f64> {
    let fits = (0.0..=1.0).contains(&share);
    ensure!(fits, "{option} is {share}, expected 0 to 1 (0.2 loses every fifth datagram)");
    Ok(share)
}

/// A delay from the command line, in microseconds.
pub fn delay_micros(option: &str, ms: f64) -> anyhow::Result<i64> {
    ensure!((0.0..=60_000.0).contains(&ms), "{option} is {ms}, expected 0 to 60,000");
    Ok((ms * 1e3) as i64)
}

/// `--budget-kb-s` in bytes a second.
pub fn budget(kb_s: f64) -> anyhow::Result<u32> {
    let bytes = kb_s * 1024.0;
    ensure!(
        (f64::from(BYTES_PER_S_MIN)..=4e9).contains(&bytes),
        "--budget-kb-s is {kb_s}, expected at least 0.02 (20 bytes a second: a full datagram in a minute)"
    );
    Ok(bytes as u32)
}

/// An option by its name in configuration files.
pub fn named<T: DeserializeOwned>(name: &str) -> Result<T, serde::de::value::Error> {
    T::deserialize(name.into_deserializer())
}
