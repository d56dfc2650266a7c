//! `flockmap-bench mapping`: the mapper beside OctoMap, on the same scans in the same run.

use flockmap_cli::outputs;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

use anyhow::{Context, anyhow, bail, ensure};
use clap::Args;
use flockmap::codec::bytes::Reader;
use flockmap::grid::Mapper;
use flockmap::{Changes, MapperConfig, Preset, State, Voxel};
use flockmap_cli::document::DataTable;
use flockmap_cli::measure::{Comparison, TimeSummary, Times, side_by_side};
use flockmap_cli::numbers::{percent, thousands};
use flockmap_cli::options::{SourceArgs, resolution};
use flockmap_cli::progress::Progress;
use flockmap_cli::sources::{self, Frame};
use flockmap_cli::{json_file, stop};
use flockmap_worlds::Lidar;
use serde::Serialize;

/// The mapper beside OctoMap, on the same scans
#[derive(Args, Debug)]
#[command(after_help = "\
Example:
  flockmap-bench mapping --scans 40

Needs a C++ compiler and Debian's liboctomap-dev for the OctoMap half; without them that half is skipped, and the output says why.")]
pub struct MappingArgs {
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
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub json: Option<PathBuf>,
}

const OCTOMAP_SOURCE: &str = include_str!("octomap_bench.cpp");
/// How far the simulated LiDAR sees.
const LIDAR_RANGE_M: f64 = 30.0;

#[derive(Serialize)]
struct Output {
    scene: String,
    lidar: String,
    resolution_m: f64,
    range_m: f64,
    scans: usize,
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
    /// How many times faster than OctoMap, by the mean.
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

/// A mapper's result.
struct Mapped {
    name: String,
    times: Times,
    map: Changes,
    memory_bytes: usize,
}

/// Runs the command.
pub fn run(args: &MappingArgs) -> anyhow::Result<bool> {
    let resolution = resolution("--resolution", args.resolution)?;
    ensure!((1..=100_000).contains(&args.scans), "--scans is {}, expected 1 to 100,000", args.scans);
    let frames = fly(args)?;
    let rays: usize = frames.iter().map(|frame| frame.scan.points.len() + frame.scan.no_returns.len()).sum();
    let mut results = Vec::new();
    for preset in [Preset::RogMap, Preset::Racer, Preset::OctoMap] {
        let config = MapperConfig::preset(preset, resolution, args.range);
        results.push(map(&frames, preset.to_string(), config)?);
    }
    let octomap = run_octomap(&frames, args);
    let octomap_skipped = octomap.as_ref().err().map(|reason| format!("{reason:#}"));
    let octomap = octomap.ok();
    let differences =
        octomap.as_ref().zip(results.last()).map(|(octomap, ours)| compare(&ours.map, &octomap.map));
    let octomap_ms = octomap.as_ref().map(|mapped| mapped.times.summary().mean_ms);
    results.extend(octomap);
    let output = Output {
        scene: args.scene.display().to_string(),
        lidar: args.lidar.to_string(),
        resolution_m: args.resolution,
        range_m: args.range,
        scans: frames.len(),
        rays_per_scan: rays as f64 / frames.len().max(1) as f64,
        mappers: results.into_iter().map(|mapped| mapped.row(octomap_ms)).collect(),
        octomap_skipped,
        differences,
    };
    print(&output);
    json_file::write_asked(args.json.as_deref(), &output)?;
    Ok(true)
}

fn fly(args: &MappingArgs) -> anyhow::Result<Vec<Frame>> {
    let source = SourceArgs {
        lidar: args.lidar,
        lidar_range: Some(LIDAR_RANGE_M),
        // Every beam counts, also one that meets nothing: a scan is then as large as the LiDAR makes it.
        no_returns: true,
        seed: args.seed,
        robots: 1,
        seconds: Some((args.scans as f64 / 10.0).max(0.1)),
        ..SourceArgs::default()
    };
    sources::check_scene(&args.scene)?;
    let flight = sources::open(std::slice::from_ref(&args.scene), &source, args.range, false)?;
    let frames: Vec<Frame> =
        flight.robots.into_iter().flat_map(|robot| robot.frames).take(args.scans).collect();
    ensure!(!frames.is_empty(), "the flight has no scan");
    Ok(frames)
}

fn map(frames: &[Frame], name: String, config: MapperConfig) -> anyhow::Result<Mapped> {
    let mut mapper = Mapper::new(config)?;
    let mut times = Times::default();
    for frame in frames {
        let started = Instant::now();
        mapper.insert(&frame.scan, &frame.pose, &[]);
        times.add(started.elapsed());
    }
    let map = Changes::from_blocks(mapper.blocks().map(|(index, block)| (index, *block)).collect());
    Ok(Mapped { name, times, map, memory_bytes: mapper.memory_bytes() })
}

impl Mapped {
    fn row(self, octomap_ms: Option<f64>) -> Row {
        let time = self.times.summary();
        let occupied = self.map.voxels().filter(|(_, state)| *state == State::Occupied).count();
        let known = self.map.len();
        Row {
            name: self.name,
            time,
            faster: octomap_ms.map(|ms| ms / time.mean_ms.max(1e-9)),
            free: known - occupied,
            occupied,
            memory_bytes: self.memory_bytes,
            bytes_per_voxel: self.memory_bytes as f64 / known.max(1) as f64,
        }
    }
}

/// Compiles OctoMap's half and runs it on the same scans. An error is the reason why it cannot take part.
fn run_octomap(frames: &[Frame], args: &MappingArgs) -> anyhow::Result<Mapped> {
    let folder = tempfile::tempdir().context("cannot make a temporary folder")?;
    let path = |name: &str| folder.path().join(name);
    std::fs::write(path("octomap_bench.cpp"), OCTOMAP_SOURCE)?;
    let compiled = Command::new("c++")
        .args(["-std=c++17", "-O3", "-march=native", "-DNDEBUG", "-o"])
        .arg(path("octomap_bench"))
        .arg(path("octomap_bench.cpp"))
        .args(["-loctomap", "-loctomath"])
        .output();
    let compiled = compiled.map_err(|error| anyhow!("there is no C++ compiler `c++` ({error})"))?;
    if !compiled.status.success() {
        let text = String::from_utf8_lossy(&compiled.stderr);
        if text.contains("octomap/octomap.h") || text.contains("-loctomap") {
            bail!("liboctomap-dev is not installed");
        }
        bail!("its program does not compile: {}", text.lines().next().unwrap_or_default());
    }
    write_scans(&path("scans.bin"), frames)?;
    let mut running = Command::new(path("octomap_bench"))
        .args([path("scans.bin"), path("map.bin")])
        .args([args.resolution.to_string(), args.range.to_string()])
        .stdout(Stdio::piped())
        .spawn()
        .context("its program does not run")?;
    let progress = Progress::new("OctoMap: scans", frames.len() as u64);
    let (mut times, mut memory_bytes) = (Times::default(), 0);
    for line in BufReader::new(running.stdout.take().context("its output is gone")?).lines() {
        let line = line?;
        match line.split_once(' ') {
            Some(("scan", ms)) => times.0.push(ms.parse()?),
            Some(("memory", bytes)) => memory_bytes = bytes.parse()?,
            _ => bail!("its program says \"{line}\""),
        }
        progress.step();
        if stop::requested() {
            running.kill()?;
            running.wait()?;
            bail!("ended by Ctrl-C");
        }
    }
    ensure!(running.wait()?.success(), "its program failed");
    let dump = std::fs::read(path("map.bin"))?;
    let mut reader = Reader::new(&dump);
    let voxels = std::iter::from_fn(|| {
        let [x, y, z] = [reader.u32()?, reader.u32()?, reader.u32()?].map(|index| index as i32);
        Some((Voxel::new(x, y, z), if reader.u8()? == 1 { State::Occupied } else { State::Free }))
    });
    let name = "OctoMap insertPointCloud".to_owned();
    Ok(Mapped { name, times, map: Changes::from_voxels(voxels), memory_bytes })
}

/// Scans as OctoMap takes them: points in the map's frame, as `f32`.
fn write_scans(path: &Path, frames: &[Frame]) -> anyhow::Result<()> {
    let mut out = std::io::BufWriter::new(std::fs::File::create(path)?);
    out.write_all(&(frames.len() as u32).to_le_bytes())?;
    for frame in frames {
        let bytes = |point: [f64; 3]| point.map(|v| (v as f32).to_le_bytes()).concat();
        out.write_all(&bytes(frame.pose.translation()))?;
        out.write_all(&((frame.scan.points.len() + frame.scan.no_returns.len()) as u32).to_le_bytes())?;
        // OctoMap cuts what lies beyond the range by itself.
        for point in frame.scan.points.iter().chain(&frame.scan.no_returns) {
            out.write_all(&bytes(frame.pose.transform(point.map(f64::from))))?;
        }
    }
    out.flush()?;
    Ok(())
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
    println!(
        "{}: {} scans of {} ({:.0} rays each), {} m voxels, {} m range\n",
        output.scene, output.scans, output.lidar, output.rays_per_scan, output.resolution_m, output.range_m
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
        "\n  Each scan inserted on one core; the first ones meet an empty map. Bytes of the map for each voxel with a state."
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
