//! What may be said to `flockmap-bench paper`.

use flockmap_cli::outputs;
use std::path::PathBuf;

use clap::{Args, ValueEnum};
use flockmap_worlds::{Lidar, Rendering};

/// The paper's whole evaluation: every table and figure of its Section V, with the rivals, in one report
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap-bench paper --quick
  flockmap-bench paper --out paper/
  flockmap-bench paper --only table1,table2 --keep-records
  flockmap-bench paper robot1.mcap robot2.mcap --only beyond --beyond-resolution 0.2 --beyond-range 30

Flies two explorations, records them, and measures every method on the same records. Half an hour at most on two cores, three minutes with
--quick. Writes report.html, report.json and a CSV file for each table. Exit code 1 if a lossless method gets a voxel wrong.")]
pub struct PaperArgs {
    /// Recordings to measure beyond the paper: one is cut by time into two robots, several are a robot each
    /// [default: hku_mb in the folder that FLOCKMAP_DATA names, if it is there]
    #[arg(value_name = "RECORD")]
    pub records: Vec<PathBuf>,
    /// Everything on a small scale, for a first look: short flights, few draws and seeds; the figures are not
    /// the paper's
    #[arg(long)]
    pub quick: bool,
    /// Folder for report.html, report.json and a CSV file for each table
    #[arg(long, value_name = "DIR", default_value = "flockmap-paper", value_parser = outputs::folder())]
    pub out: PathBuf,
    /// Keep the flights: DIR/records/forest/robot1.mcap and so on
    #[arg(long)]
    pub keep_records: bool,
    /// Take flights that were kept before in place of exploring: DIR/forest/robot1.mcap and robot2.mcap,
    /// DIR/indoor/robot1.mcap to robot5.mcap
    #[arg(long, value_name = "DIR", conflicts_with = "keep_records")]
    pub flights: Option<PathBuf>,
    /// Only these parts
    #[arg(long, value_name = "PARTS", value_delimiter = ',', value_enum)]
    pub only: Vec<Stage>,
    /// Seed of worlds, flights, draws and radio
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
    /// LiDAR of the simulated robots
    #[arg(long, value_name = "NAME", default_value_t = Lidar::Avia)]
    pub lidar: Lidar,
    /// How its beams meet the world: polar (an image of ranges from points, as in the MARSIM simulator of the
    /// paper) or cast (exact)
    #[arg(long, value_name = "NAME", default_value_t = Rendering::Polar)]
    pub rendering: Rendering,
    /// Explorations are ended after so many seconds of flight, complete or not [default: 400; with --quick 10]
    #[arg(long, value_name = "S")]
    pub seconds: Option<f64>,
    /// Seeds of the application [default: 20; with --quick 2]
    #[arg(long, value_name = "N")]
    pub seeds: Option<u32>,
    /// Rows that are measured at the same time; figures do not depend on it [default: as many as there are cores]
    #[arg(long, value_name = "N")]
    pub threads: Option<usize>,
    /// Voxel side for the recordings beyond the paper, in metres
    #[arg(long, value_name = "M", default_value_t = 0.2)]
    pub beyond_resolution: f64,
    /// Range for the recordings beyond the paper, in metres
    #[arg(long, value_name = "M", default_value_t = 30.0)]
    pub beyond_range: f64,
}

/// A part of the paper's Section V.
#[derive(ValueEnum, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub enum Stage {
    /// Changes drawn at random
    Fig5,
    /// Bandwidth on four explorations, all methods; the map over time (Fig. 6)
    Table1,
    /// Hilbert walk against nested order
    Table2,
    /// Two nodes over an emulated Wi-Fi with loss, over time (Fig. 9)
    Table3,
    /// Times to pack and to merge
    Table4,
    /// Flying on a team-mate's map (Sec. V-B)
    Application,
    /// The same methods on recordings
    Beyond,
}
