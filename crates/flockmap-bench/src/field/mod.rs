//! `flockmap-bench field`: the distance field beside PyPI's `edt` and OctoMap's dynamicEDT3D, of the same boxes in the
//! same run.

mod rival;

use std::collections::VecDeque;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::ensure;
use clap::Args;
use flockmap::grid::{Mapper, Pose, VoxelBox};
use flockmap::{MapView, MapperConfig, Preset, Voxel};
use flockmap_cli::document::DataTable;
use flockmap_cli::options::{SourceArgs, resolution};
use flockmap_cli::progress::Progress;
use flockmap_cli::{json_file, outputs, sources, stop};
use flockmap_plan::{DistanceField, FieldConfig, Obstacles};
use rival::Rival;
use serde::Serialize;

/// The distance field beside PyPI's `edt` and OctoMap's dynamicEDT3D, of the same boxes
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap-bench field forest
  flockmap-bench field robot1.mcap --resolution 0.1 --python venv/bin/python

Needs a Python with `edt` and `numpy` from PyPI, and a C++ compiler with Debian's libdynamicedt3d-dev; what is missing is skipped, and the output says why.")]
pub struct FieldArgs {
    /// World to fly through (forest, indoor, or a world file), or a record
    #[arg(value_name = "SCENE")]
    pub scene: PathBuf,
    /// Side of a voxel in metres
    #[arg(long, value_name = "M", default_value_t = 0.1)]
    pub resolution: f64,
    /// Rays longer than this many metres are cut there
    #[arg(long, value_name = "M", default_value_t = 10.0)]
    pub range: f64,
    /// Size of the box about the robot in metres
    #[arg(long, value_name = "X,Y,Z", value_delimiter = ',', num_args = 3, default_values_t = [10.0, 10.0, 4.0])]
    pub size: Vec<f64>,
    /// Boxes, spread evenly over the scans
    #[arg(long, value_name = "N", default_value_t = 5)]
    pub boxes: usize,
    /// How often each box is done by each, in turn
    #[arg(long, value_name = "N", default_value_t = 11)]
    pub rounds: usize,
    /// Length of a simulated flight in seconds
    #[arg(long, value_name = "S", default_value_t = 30.0)]
    pub seconds: f64,
    /// Unknown counts as an obstacle
    #[arg(long)]
    pub unknown_is_obstacle: bool,
    /// Python that has `edt` and `numpy`
    #[arg(long, value_name = "FILE", default_value = "python3")]
    pub python: PathBuf,
    /// Write the table as JSON
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub json: Option<PathBuf>,
}

#[derive(Serialize)]
struct Output {
    scene: String,
    resolution_m: f64,
    size_voxels: [u32; 3],
    boxes: usize,
    /// Mean share of the voxels of a box that are obstacles.
    obstacles: f64,
    rows: Vec<Row>,
    skipped: Vec<String>,
}

/// Times of all boxes and rounds.
#[derive(Serialize)]
struct Row {
    name: String,
    least_ms: f64,
    median_ms: f64,
    /// Squared distances in voxels that are not ours.
    different: Option<u64>,
}

/// A map before and after a scan, and the box about the robot then.
struct Moment {
    before: MapView,
    after: MapView,
    region: VoxelBox,
}

/// Runs the command.
pub fn run(args: &FieldArgs) -> anyhow::Result<bool> {
    ensure!((1..=1000).contains(&args.boxes), "--boxes is {}, expected 1 to 1,000", args.boxes);
    ensure!((1..=1000).contains(&args.rounds), "--rounds is {}, expected 1 to 1,000", args.rounds);
    let obstacles = if args.unknown_is_obstacle { Obstacles::NotFree } else { Obstacles::Occupied };
    let config = FieldConfig { obstacles, ..FieldConfig::default() };
    let moments = moments(args)?;
    let names = ["new, allocated", "in the memory of the last", "update after a scan"];
    let mut ours = names.map(|name| Times { name: format!("Flockmap: {name}"), ..Times::default() });
    let rivals = [
        ("PyPI edt: edtsq", rival::Kind::Edt, "anew"),
        ("dynamicEDT3D: initializeMap, update", rival::Kind::DynamicEdt, "anew"),
        ("dynamicEDT3D: update after a scan", rival::Kind::DynamicEdt, "update"),
    ];
    let mut theirs = rivals.map(|(name, ..)| Times { name: name.to_owned(), ..Times::default() });
    let mut skipped = Vec::new();
    let mut occupied = 0.0;
    let progress = Progress::new("boxes × rounds", (moments.len() * args.rounds) as u64);
    for moment in &moments {
        let mut field = DistanceField::new(&moment.after, moment.region, &config)?;
        let cells = [&moment.before, &moment.after].map(|view| cells(view, &moment.region, obstacles));
        occupied += cells[1].iter().map(|cell| f64::from(*cell)).sum::<f64>() / cells[1].len() as f64;
        let mut running: Vec<Option<Rival>> = Vec::new();
        for (at, (_, kind, what)) in rivals.iter().enumerate() {
            let rival = Rival::start(*kind, &args.python, moment.region.size(), &cells);
            if let Err(reason) = &rival {
                skipped.push(format!("{}: {reason:#}", theirs[at].name));
            }
            let mut rival = rival.ok();
            if let Some(rival) = rival.as_mut().filter(|_| *what == "anew") {
                let squared = rival.squared()?;
                let same = |(voxel, theirs): (Voxel, &f32)| field.squared_voxels(voxel) == finite(*theirs);
                let different = in_order(&moment.region).zip(&squared).filter(|pair| !same(*pair)).count();
                *theirs[at].different.get_or_insert(0) += different as u64;
            }
            running.push(rival);
        }
        for _ in 0..args.rounds {
            ours[0].time(|| DistanceField::new(&moment.after, moment.region, &config))?;
            ours[1].time(|| field.move_to(&moment.after, moment.region))?;
            let mut before = DistanceField::new(&moment.before, moment.region, &config)?;
            ours[2].time(|| before.update(&moment.after));
            for ((rival, (.., what)), times) in running.iter_mut().zip(&rivals).zip(&mut theirs) {
                if let Some(rival) = rival {
                    times.ms.push(rival.ask(what)?);
                }
            }
            progress.step();
            if stop::requested() {
                anyhow::bail!("ended by Ctrl-C");
            }
        }
    }
    drop(progress);
    skipped.sort();
    skipped.dedup();
    let output = Output {
        scene: args.scene.display().to_string(),
        resolution_m: args.resolution,
        size_voxels: moments[0].region.size(),
        boxes: moments.len(),
        obstacles: occupied / moments.len() as f64,
        rows: ours.into_iter().chain(theirs).filter(|times| !times.ms.is_empty()).map(Times::row).collect(),
        skipped,
    };
    print(&output);
    json_file::write_asked(args.json.as_deref(), &output)?;
    Ok(true)
}

#[derive(Default)]
struct Times {
    name: String,
    ms: Vec<f64>,
    different: Option<u64>,
}

impl Times {
    fn time<T>(&mut self, work: impl FnOnce() -> T) -> T {
        let started = Instant::now();
        let done = work();
        self.ms.push(started.elapsed().as_secs_f64() * 1e3);
        done
    }

    fn row(mut self) -> Row {
        self.ms.sort_unstable_by(f64::total_cmp);
        Row {
            name: self.name,
            least_ms: self.ms[0],
            median_ms: self.ms[self.ms.len() / 2],
            different: self.different,
        }
    }
}

/// Flies, or reads the record, and maps it.
fn moments(args: &FieldArgs) -> anyhow::Result<Vec<Moment>> {
    let resolution = resolution("--resolution", args.resolution)?;
    let is_world = sources::is_world(&args.scene);
    let source = SourceArgs {
        robots: 1,
        seconds: is_world.then_some(args.seconds),
        lidar_range: is_world.then_some(30.0),
        ..SourceArgs::default()
    };
    let flight = sources::open(std::slice::from_ref(&args.scene), &source, args.range, false)?;
    let robot = flight.robots.into_iter().next().ok_or_else(|| anyhow::anyhow!("there is no robot in it"))?;
    let scans = robot.frames_expected.max(2);
    let every = (scans / (args.boxes as u64 + 1)).max(1);
    let mut mapper = Mapper::new(MapperConfig::preset(Preset::RogMap, resolution, args.range))?;
    let mut map = MapView::new(resolution);
    let mut moments = VecDeque::new();
    let progress = Progress::new("scans", scans);
    for (number, frame) in (1..).zip(robot.frames) {
        mapper.insert(&frame.scan, &frame.pose, &[]);
        let is_next = (number + 1) % every == 0;
        let is_asked = number % every == 0;
        if is_next || is_asked {
            let before = map.clone();
            mapper.blocks().for_each(|(index, block)| map.set_block(index, block));
            if is_asked && moments.len() < args.boxes {
                let region = about(&frame.pose, &map, &args.size)?;
                moments.push_back(Moment { before, after: map.clone(), region });
            }
        }
        progress.step();
    }
    ensure!(!moments.is_empty(), "there are fewer scans than boxes");
    Ok(moments.into())
}

fn about(pose: &Pose, map: &MapView, size: &[f64]) -> anyhow::Result<VoxelBox> {
    let side = map.resolution().metres();
    let voxels: [u32; 3] = core::array::from_fn(|axis| (size[axis] / side).round().clamp(1.0, 4e3) as u32);
    let at = pose.translation();
    let low = core::array::from_fn(|axis| at[axis] - f64::from(voxels[axis]) * side / 2.0);
    let low = map.resolution().voxel_at(low).and_then(|low| VoxelBox::new(low, voxels));
    low.ok_or_else(|| anyhow::anyhow!("the robot is not in the grid"))
}

/// The voxels of a box, x fastest.
fn in_order(region: &VoxelBox) -> impl Iterator<Item = Voxel> + use<> {
    let (low, high) = (region.min(), region.max());
    (low.z..=high.z).flat_map(move |z| {
        (low.y..=high.y).flat_map(move |y| (low.x..=high.x).map(move |x| Voxel::new(x, y, z)))
    })
}

fn cells(view: &MapView, region: &VoxelBox, obstacles: Obstacles) -> Vec<u8> {
    in_order(region).map(|voxel| obstacles.contain(view.state(voxel)).into()).collect()
}

/// A squared distance of a rival, where there is an obstacle: without one, `edt` says infinity and dynamicEDT3D a
/// number that no distance has.
fn finite(squared: f32) -> Option<u32> {
    (squared < 1e9).then_some(squared as u32)
}

fn print(output: &Output) {
    let [x, y, z] = output.size_voxels;
    println!(
        "{}: {} boxes of {x} × {y} × {z} voxels of {} m, {:.1} % of them obstacles\n",
        output.scene,
        output.boxes,
        output.resolution_m,
        output.obstacles * 100.0
    );
    let ours = output.rows[0].median_ms;
    let table = DataTable::of_text(
        &output.rows,
        &[
            ("distance field", &|row| row.name.clone()),
            ("least ms", &|row| format!("{:.2}", row.least_ms)),
            ("median ms", &|row| format!("{:.2}", row.median_ms)),
            ("of ours, new", &|row| format!("×{:.2}", row.median_ms / ours)),
            ("different", &|row| row.different.map_or_else(String::new, |count| count.to_string())),
        ],
    );
    print!("{table}");
    println!(
        "\n  Each on one thread, in turn. Ours is timed from the map; theirs from arrays of the box, which are made before. \
         Squared distances of all. Different: voxels whose squared distance is not ours."
    );
    for reason in &output.skipped {
        println!("  Skipped: {reason}");
    }
}
