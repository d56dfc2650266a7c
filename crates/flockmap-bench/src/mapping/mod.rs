//! `flockmap-bench mapping`: the mapper beside OctoMap, on the same scans in the same run.

mod mapped;
mod octomap;

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{bail, ensure};
use clap::Args;
use flockmap::grid::Mapper;
use flockmap::{
    Changes, MapperConfig, Preset, RaysWalked, Resolution, Robot, RobotConfig, RobotId, Stamp, State,
};
use flockmap_cli::document::DataTable;
use flockmap_cli::measure::{Comparison, TimeSummary, Times, side_by_side};
use flockmap_cli::numbers::{percent, thousands};
use flockmap_cli::options::{SourceArgs, resolution};
use flockmap_cli::outputs;
use flockmap_cli::parallel::cores;
use flockmap_cli::sources::{self, Frame};
use flockmap_cli::{json_file, stop};
use flockmap_worlds::Lidar;
use mapped::Mapped;
use octomap::Octomap;
use serde::Serialize;

/// The mapper beside OctoMap, on the same scans
#[derive(Args, Debug)]
#[command(after_help = "\
Example:
  flockmap-bench mapping --scans 40
  flockmap-bench mapping --lidar os128 --range 20 --scans 10 --threads 1,2 --runs 5
  flockmap-bench mapping --scene walk.mcap --resolution 0.2 --range 30

Needs a C++ compiler and Debian's liboctomap-dev for the OctoMap half; without them that half is skipped, and the output says why.")]
pub struct MappingArgs {
    /// World to fly through: forest, indoor, or a world file; or a record
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
    /// LiDAR of the flight: mid360, avia or os128
    #[arg(long, value_name = "NAME", default_value_t = Lidar::Mid360)]
    pub lidar: Lidar,
    /// Seed of the world and of the flight
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
    /// Threads that take in a scan together, a row for each number
    #[arg(long, value_name = "N,...", value_delimiter = ',', default_values_t = usual_threads())]
    pub threads: Vec<usize>,
    /// Runs of each mapper: the one with the median time is shown. Every other run goes in the opposite order
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub runs: usize,
    /// Write the table as JSON
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub json: Option<PathBuf>,
}

/// One, two, and one for each core.
fn usual_threads() -> Vec<usize> {
    let cores = cores();
    if cores > 2 { vec![1, 2, cores] } else { vec![1, 2] }
}

/// How far the simulated LiDAR sees.
const LIDAR_RANGE_M: f64 = 30.0;

#[derive(Serialize)]
struct Output {
    scene: String,
    /// Of the flight through a world.
    lidar: Option<String>,
    resolution_m: f64,
    range_m: f64,
    scans: usize,
    runs: usize,
    rays_per_scan: f64,
    mappers: Vec<Row>,
    /// Why OctoMap did not take part.
    octomap_skipped: Option<String>,
    differences: Option<Differences>,
}

#[derive(Serialize)]
struct Row {
    name: String,
    time: TimeSummary,
    /// How many times faster than OctoMap, by the median.
    faster: Option<f64>,
    free: usize,
    occupied: usize,
    memory_bytes: usize,
    bytes_per_voxel: f64,
}

/// The `octomap` preset's map beside OctoMap's.
#[derive(Serialize, Default)]
struct Differences {
    known: u64,
    equal: u64,
    /// Free here, Occupied there.
    free_here: u64,
    /// Occupied here, Free there.
    occupied_here: u64,
    /// Known here, Unknown there.
    only_here: u64,
    /// Unknown here, known there.
    only_there: u64,
}

/// By what a map is made, but for the number of threads.
type Rules = (Preset, RaysWalked);

/// Those that lead to OctoMap's map.
const LIKE_OCTOMAP: Rules = (Preset::OctoMap, RaysWalked::All);

/// Who makes a map.
#[derive(Clone, Copy)]
enum Contestant<'a> {
    Mapper(Rules, usize),
    /// A whole robot, with the map that it fuses; without what it does between scans.
    Robot(Rules, usize),
    Octomap(&'a Octomap),
}

/// Runs the command.
pub fn run(args: &MappingArgs) -> anyhow::Result<bool> {
    let resolution = resolution("--resolution", args.resolution)?;
    ensure!((1..=100_000).contains(&args.scans), "--scans is {}, expected 1 to 100,000", args.scans);
    ensure!((1..=1_000).contains(&args.runs), "--runs is {}, expected 1 to 1,000", args.runs);
    let frames = fly(args)?;
    let rays: usize = frames.iter().map(|frame| frame.scan.points.len() + frame.scan.no_returns.len()).sum();
    let octomap = Octomap::new(&frames);
    let octomap_skipped = octomap.as_ref().err().map(|reason| format!("{reason:#}"));
    let rules = [Preset::RogMap, Preset::Racer, Preset::OctoMap].map(|preset| (preset, RaysWalked::All));
    let rules = rules.into_iter().chain([(Preset::OctoMap, RaysWalked::OnePerEndVoxel)]);
    let of = |rules| args.threads.iter().map(move |threads| Contestant::Mapper(rules, *threads));
    let robots = args.threads.iter().map(|threads| Contestant::Robot(LIKE_OCTOMAP, *threads));
    let contestants = rules.flat_map(of).chain(robots);
    let contestants: Vec<Contestant<'_>> =
        contestants.chain(octomap.as_ref().ok().map(Contestant::Octomap)).collect();

    let mut runs: Vec<Vec<Mapped>> = contestants.iter().map(|_| Vec::new()).collect();
    for number in 0..args.runs {
        let mut order: Vec<usize> = (0..contestants.len()).collect();
        if number % 2 == 1 {
            order.reverse();
        }
        for at in order {
            runs[at].push(contestants[at].run(&frames, args, resolution)?);
            if stop::requested() {
                bail!("ended by Ctrl-C");
            }
        }
    }
    let results: Vec<Mapped> = runs.into_iter().filter_map(median).collect();
    let maps = || contestants.iter().zip(&results);
    for (who, mapped) in maps() {
        let first = maps().find(|(other, _)| other.rules() == who.rules()).map(|(_, first)| &first.map);
        ensure!(first == Some(&mapped.map), "{} makes another map than with other threads", who.name());
    }
    let of_octomap = maps().find(|(who, _)| who.rules().is_none()).map(|(_, mapped)| mapped);
    let ours = maps().find(|(who, _)| who.rules() == Some(LIKE_OCTOMAP)).map(|(_, mapped)| mapped);
    let differences = of_octomap.zip(ours).map(|(octomap, ours)| compare(&ours.map, &octomap.map));
    let octomap_ms = of_octomap.map(|mapped| mapped.times.summary().median_ms);
    let output = Output {
        scene: args.scene.display().to_string(),
        lidar: is_world(args).then(|| args.lidar.to_string()),
        resolution_m: args.resolution,
        range_m: args.range,
        scans: frames.len(),
        runs: args.runs,
        rays_per_scan: rays as f64 / frames.len().max(1) as f64,
        mappers: maps().map(|(who, mapped)| mapped.row(who, octomap_ms)).collect(),
        octomap_skipped,
        differences,
    };
    print(&output);
    json_file::write_asked(args.json.as_deref(), &output)?;
    Ok(true)
}

/// The run with the median time.
fn median(mut runs: Vec<Mapped>) -> Option<Mapped> {
    runs.sort_by(|a, b| a.times.summary().median_ms.total_cmp(&b.times.summary().median_ms));
    let middle = (runs.len().max(1) - 1) / 2;
    runs.into_iter().nth(middle)
}

fn is_world(args: &MappingArgs) -> bool {
    sources::check_scene(&args.scene).is_ok()
}

/// The scans of a flight, or of a record.
fn fly(args: &MappingArgs) -> anyhow::Result<Vec<Frame>> {
    let source = SourceArgs {
        lidar: args.lidar,
        lidar_range: Some(LIDAR_RANGE_M),
        // Every beam counts, also one that meets nothing: a scan is then as large as the LiDAR makes it.
        no_returns: true,
        seed: args.seed,
        robots: 1,
        seconds: is_world(args).then_some((args.scans as f64 / 10.0).max(0.1)),
        ..SourceArgs::default()
    };
    let flight = sources::open(std::slice::from_ref(&args.scene), &source, args.range, false)?;
    let frames: Vec<Frame> =
        flight.robots.into_iter().flat_map(|robot| robot.frames).take(args.scans).collect();
    ensure!(!frames.is_empty(), "{} has no scan", args.scene.display());
    Ok(frames)
}

impl Contestant<'_> {
    /// Whose map it makes; `None`: its own.
    const fn rules(&self) -> Option<Rules> {
        match self {
            Self::Mapper(rules, _) | Self::Robot(rules, _) => Some(*rules),
            Self::Octomap(_) => None,
        }
    }

    fn name(&self) -> String {
        let counted = |threads: usize| format!("{threads} thread{}", if threads == 1 { "" } else { "s" });
        match self {
            Self::Mapper((preset, RaysWalked::All), threads) => format!("{preset}, {}", counted(*threads)),
            Self::Mapper((preset, RaysWalked::OnePerEndVoxel), threads) => {
                format!("{preset}, one ray an end voxel, {}", counted(*threads))
            }
            Self::Robot((preset, _), threads) => format!("whole robot, {preset}, {}", counted(*threads)),
            Self::Octomap(_) => "OctoMap insertPointCloud".to_owned(),
        }
    }

    fn run(&self, frames: &[Frame], args: &MappingArgs, resolution: Resolution) -> anyhow::Result<Mapped> {
        let config = |(preset, rays), threads| MapperConfig {
            threads,
            rays,
            ..MapperConfig::preset(preset, resolution, args.range)
        };
        let mut times = Times::default();
        match *self {
            Self::Mapper(rules, threads) => {
                let mut mapper = Mapper::new(config(rules, threads))?;
                for frame in frames {
                    let started = Instant::now();
                    mapper.insert(&frame.scan, &frame.pose, &[]);
                    times.add(started.elapsed());
                }
                Ok(Mapped { times, map: map_of(&mapper), memory_bytes: mapper.memory_bytes() })
            }
            Self::Robot(rules, threads) => {
                let mut options = RobotConfig::new(RobotId(1), resolution, args.range);
                options.mapper = config(rules, threads);
                let mut robot = Robot::new(options, Stamp(0))?;
                for frame in frames {
                    let started = Instant::now();
                    robot.insert_scan(frame.scan.stamp, &frame.scan, &frame.pose)?;
                    times.add(started.elapsed());
                    robot.handle_timeout(frame.scan.stamp);
                    while robot.poll_event().is_some() {}
                }
                let memory_bytes = robot.mapper().memory_bytes();
                Ok(Mapped { times, map: map_of(robot.mapper()), memory_bytes })
            }
            Self::Octomap(octomap) => octomap.run(args.resolution, args.range),
        }
    }
}

fn map_of(mapper: &Mapper) -> Changes {
    Changes::from_blocks(mapper.blocks().map(|(index, block)| (index, *block)).collect())
}

impl Mapped {
    fn row(&self, who: &Contestant<'_>, octomap_ms: Option<f64>) -> Row {
        let time = self.times.summary();
        let occupied = self.map.voxels().filter(|(_, state)| *state == State::Occupied).count();
        let known = self.map.len();
        Row {
            name: who.name(),
            time,
            faster: octomap_ms.map(|ms| ms / time.median_ms.max(1e-9)),
            free: known - occupied,
            occupied,
            memory_bytes: self.memory_bytes,
            bytes_per_voxel: self.memory_bytes as f64 / known.max(1) as f64,
        }
    }
}

fn compare(ours: &Changes, theirs: &Changes) -> Differences {
    let mut differences = Differences::default();
    let mut all = Comparison::default();
    let blocks = |changes: &Changes| changes.blocks().to_vec();
    for [a, b] in side_by_side(blocks(ours), blocks(theirs)).values() {
        all.add(a, b);
        for z in 0..8 {
            let ones = |bits: u64| u64::from(bits.count_ones());
            differences.free_here += ones(a.free()[z] & b.occupied()[z]);
            differences.occupied_here += ones(a.occupied()[z] & b.free()[z]);
            differences.only_here += ones(a.known()[z] & !b.known()[z]);
            differences.only_there += ones(b.known()[z] & !a.known()[z]);
        }
    }
    (differences.known, differences.equal) = (all.known, all.equal);
    differences
}

fn print(output: &Output) {
    let of_lidar = output.lidar.as_ref().map(|lidar| format!(" of {lidar}")).unwrap_or_default();
    println!(
        "{}: {} scans{of_lidar} ({:.0} rays each), {} m voxels, {} m range\n",
        output.scene, output.scans, output.rays_per_scan, output.resolution_m, output.range_m
    );
    let table = DataTable::of_text(
        &output.mappers,
        &[
            ("mapper", &|row| row.name.clone()),
            ("mean ms", &|row| format!("{:.2}", row.time.mean_ms)),
            ("median ms", &|row| format!("{:.2}", row.time.median_ms)),
            ("99 % ms", &|row| format!("{:.2}", row.time.p99_ms)),
            ("faster", &|row| row.faster.map_or_else(String::new, |faster| format!("×{faster:.1}"))),
            ("free", &|row| thousands(row.free as u64)),
            ("occupied", &|row| thousands(row.occupied as u64)),
            ("bytes/voxel", &|row| format!("{:.1}", row.bytes_per_voxel)),
        ],
    );
    print!("{table}");
    println!(
        "\n  The first scans meet an empty map. Of each mapper the run with the median time. Bytes of the map for each voxel with a state."
    );
    if let Some(reason) = &output.octomap_skipped {
        println!("  OctoMap skipped: {reason}");
    }
    if let Some(d) = &output.differences {
        let share = Comparison { known: d.known, equal: d.equal }.share();
        println!(
            "\n  The octomap preset's map beside OctoMap's: {} of {} voxels equal ({}).\n  Free here and occupied there: {}; occupied here and free there: \
             {}; known here only: {}; known there only: {}.",
            thousands(d.equal),
            thousands(d.known),
            percent(share),
            thousands(d.free_here),
            thousands(d.occupied_here),
            thousands(d.only_here),
            thousands(d.only_there)
        );
        if d.equal != d.known {
            println!(
                "  Points reach OctoMap in the frame of the map as 32-bit floats, and it walks rays in them; here they are turned into that frame in 64 bits.\n  \
                 So a ray that passes within rounding of an edge may go through the voxel on its other side."
            );
        }
    }
}
