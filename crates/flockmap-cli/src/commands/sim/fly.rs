//! `flockmap sim fly`: simulated flights, written as one record a robot.

use flockmap_cli::outputs;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::ensure;
use clap::Args;
use flockmap::grid::Mapper;
use flockmap_cli::options::{MapArgs, OF_BATCHES, OF_RECORDS, SourceArgs};
use flockmap_cli::parallel::{cores, in_parallel};
use flockmap_cli::program::command_line;
use flockmap_cli::progress::Progress;
use flockmap_cli::robot_record::{self, RecordFacts, RobotRecord};
use flockmap_cli::sources::{self, Source};
use flockmap_cli::{json_file, stop};
use serde_json::json;

/// Fly a simulated swarm and write what each robot saw: one MCAP file a robot
#[derive(Args, Debug)]
#[command(
        after_help = "\
Examples:
  flockmap sim fly --scene forest --robots 2 --seconds 60 --out flight
  flockmap replay flight/robot1.mcap flight/robot2.mcap --see-team-mates --loss 0.2
  flockmap sim fly --scene fr_079.bt --robots 3 --lidar mid360 --no-returns --out office

Each file holds the scans (PointCloud2), the pose of the sensor at each (Odometry and tf), and every 2 s a picture of the map that the robot has
made and of its track; ROS 2, Foxglove and Rerun open it as it is. The same command gives the same bytes, whatever --threads is.
A replay of the files is the replay of the flight itself: `replay forest --see-team-mates` gives the same bytes. Robots are in each other's scans;
--see-team-mates leaves them out of the maps again.",
        mut_args(crate::commands::hidden::hide(&[&OF_RECORDS, &OF_BATCHES, &["see_team_mates"]]))
    )]
pub struct SimFlyArgs {
    /// forest, indoor, or a world file (.bt .pcd .ply .las .laz)
    #[arg(long, value_name = "SCENE", default_value = "forest")]
    pub scene: PathBuf,
    /// Folder for the files robot1.mcap, robot2.mcap …
    #[arg(long, value_name = "DIR", default_value = "flockmap-flight", value_parser = outputs::folder())]
    pub out: PathBuf,
    /// Leave out the pictures of map and track
    #[arg(long)]
    pub no_view: bool,
    /// Robots are not seen in each other's scans
    #[arg(long)]
    pub hide_team_mates: bool,
    /// Robots that are recorded at the same time [default: as many as there are cores]
    #[arg(long, value_name = "N")]
    pub threads: Option<usize>,
    /// Write what the table shows as JSON
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub json: Option<PathBuf>,
    #[command(flatten)]
    pub map: MapArgs,
    #[command(flatten)]
    pub source: SourceArgs,
}

/// Runs the command.
pub fn run(args: &SimFlyArgs) -> anyhow::Result<bool> {
    ensure!(args.threads.is_none_or(|n| (1..=1_000).contains(&n)), "--threads must be 1 to 1,000");
    // Wrong options are errors before anything is made.
    args.map.mapper()?;
    let source = SourceArgs { see_team_mates: !args.hide_team_mates, ..args.source.clone() };
    let sources = sources::open_scene(&args.scene, &source, args.map.range)?;
    robot_record::prepare_folder(&args.out, sources.robots.len())?;
    let records = write_all(sources.robots, args)?;
    robot_record::print_table(&records);
    if stop::requested() {
        eprintln!("warning: ended by Ctrl-C: the files hold what was flown so far");
    }
    let facts = json!({"command": command_line(), "title": sources.title, "seed": args.source.seed, "robots": records});
    json_file::write_asked(args.json.as_deref(), &facts)?;
    Ok(true)
}

/// Records every robot, several at the same time. Each file depends on its own robot only.
fn write_all(robots: Vec<Source>, args: &SimFlyArgs) -> anyhow::Result<Vec<RecordFacts>> {
    let threads = args.threads.unwrap_or_else(cores).min(robots.len());
    let progress = Progress::new("scans", robots.iter().map(|source| source.frames_expected).sum());
    let has_failed = AtomicBool::new(false);
    let records = in_parallel(threads, robots, |source| {
        let is_wanted = || {
            progress.step();
            !stop::requested() && !has_failed.load(Ordering::Relaxed)
        };
        let record = write_one(source, args, is_wanted);
        has_failed.fetch_or(record.is_err(), Ordering::Relaxed);
        record
    });
    records.into_iter().collect()
}

/// Writes the record of one robot, as long as the next scan is wanted.
fn write_one(
    source: Source,
    args: &SimFlyArgs,
    mut is_wanted: impl FnMut() -> bool,
) -> anyhow::Result<RecordFacts> {
    let mut record = RobotRecord::create(&args.out, &source.name)?;
    let resolution = args.map.resolution()?;
    let mut mapper = if args.no_view { None } else { Some(Mapper::new(args.map.mapper()?)?) };
    let mut frames = source.frames;
    while let Some(frame) = frames.next() {
        record.scan(&frame.scan, &frame.pose)?;
        if let Some(mapper) = &mut mapper {
            mapper.insert(&frame.scan, &frame.pose, &frame.masks());
            // The last picture shows all.
            if record.is_view_due() || frames.next_stamp().is_none() {
                record.view(resolution, robot_record::occupied(mapper.blocks()))?;
            }
        }
        if !is_wanted() {
            break;
        }
    }
    record.finish()
}
