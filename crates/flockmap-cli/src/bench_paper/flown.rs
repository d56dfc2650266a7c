//! Explorations of the paper's two scenes, flown once and recorded; every row replays the same record.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context;
use flockmap::Stamp;
use flockmap::grid::Sphere;
use flockmap_io::{RecordOptions, RecordWriter, open_record};
use flockmap_sim::{Flight, Lidar, Patrol, PatrolOptions, ScanOptions, World};

use super::figures::Scene;
use crate::progress::Progress;
use crate::sources::{Frame, Frames, Source};
use crate::stop;

/// The LiDAR sees as far as the longest range of the paper's rows needs.
pub const LIDAR_RANGE_M: f64 = 20.0;

/// Where a robot was, when.
pub type Way = Vec<(Stamp, [f64; 3])>;

/// A recorded exploration.
#[derive(Clone)]
pub struct Flown {
    pub scene: Scene,
    /// A file for each robot.
    pub files: Vec<PathBuf>,
    /// From the first to the last scan.
    pub seconds: f64,
    pub scans: u64,
    pub points: u64,
    /// Bytes of all files.
    pub file_bytes: u64,
    /// Way of each robot in metres.
    pub path_m: Vec<f64>,
    /// Where each robot was at each scan.
    pub positions: Arc<Vec<Way>>,
    /// Share of what can be seen that was seen, if the flight was an exploration.
    pub seen_share: Option<f64>,
    /// How it ended.
    pub ended: String,
}

/// What is flown.
pub struct FlightPlan {
    pub scene: Scene,
    pub seed: u64,
    pub lidar: Lidar,
    /// The flight is ended after so long.
    pub seconds_max: f64,
}

impl Scene {
    pub fn world(self, seed: u64) -> World {
        match self {
            Self::Forest => World::forest(seed),
            Self::Indoor => World::indoor(seed),
        }
    }
}

/// Flies and records.
pub fn fly(plan: &FlightPlan, folder: &Path) -> anyhow::Result<Flown> {
    let scene = plan.scene;
    let folder = folder.join(scene.name());
    std::fs::create_dir_all(&folder)
        .with_context(|| format!("cannot make the folder {}", folder.display()))?;
    let world = Arc::new(scene.world(plan.seed));
    let options = PatrolOptions { duration_s: plan.seconds_max.min(60.0), ..PatrolOptions::default() };
    let scan = ScanOptions { range_m: LIDAR_RANGE_M, ..ScanOptions::default() };
    let patrols = Patrol::plan(&world, scene.robots(), plan.seed, &options)?;
    let mut flights: Vec<Flight> =
        patrols.into_iter().map(|patrol| Flight::new(Arc::clone(&world), plan.lidar, scan, patrol)).collect();

    let files: Vec<PathBuf> =
        (1..=scene.robots()).map(|number| folder.join(format!("robot{number}.mcap"))).collect();
    let mut writers: Vec<RecordWriter> = files
        .iter()
        .enumerate()
        .map(|(number, file)| RecordWriter::create(file, &format!("robot{}", number + 1)))
        .collect::<Result<_, _>>()?;
    let mut positions = vec![Vec::new(); scene.robots()];
    let (mut scans, mut points) = (0, 0);
    let mut progress =
        Progress::new("scans", (plan.seconds_max.min(60.0) * 10.0) as u64 * scene.robots() as u64);
    'flight: while !stop::requested() {
        for (number, flight) in flights.iter_mut().enumerate() {
            let Some(frame) = flight.next() else { break 'flight };
            writers[number].write(&frame.scan, &frame.t_map_sensor)?;
            positions[number].push((frame.scan.stamp, frame.t_map_sensor.translation()));
            scans += 1;
            points += frame.scan.points.len() as u64;
            progress.step();
        }
    }
    writers.into_iter().try_for_each(RecordWriter::finish)?;
    let mut file_bytes = 0;
    for file in &files {
        file_bytes +=
            std::fs::metadata(file).with_context(|| format!("cannot read {}", file.display()))?.len();
    }
    let last =
        positions.iter().filter_map(|way| way.last()).map(|(stamp, _)| *stamp).max().unwrap_or_default();
    Ok(Flown {
        scene,
        files,
        seconds: last.seconds(),
        scans,
        points,
        file_bytes,
        path_m: positions.iter().map(|way| length_m(way)).collect(),
        positions: Arc::new(positions),
        seen_share: None,
        ended: "the time was over".to_owned(),
    })
}

fn length_m(way: &[(Stamp, [f64; 3])]) -> f64 {
    let step = |a: [f64; 3], b: [f64; 3]| (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt();
    way.windows(2).map(|pair| step(pair[0].1, pair[1].1)).sum()
}

impl Flown {
    /// The robots with what a LiDAR sees that reaches `range_m`: what is farther gives no return.
    pub fn sources(&self, range_m: f64) -> anyhow::Result<Vec<Source>> {
        self.files
            .iter()
            .enumerate()
            .map(|(number, file)| {
                let record = open_record(file, &RecordOptions::default())?;
                let frames = record.frames.map(move |frame| {
                    let mut frame = frame?;
                    let limit = (range_m * range_m) as f32;
                    frame.scan.points.retain(|p| p[0] * p[0] + p[1] * p[1] + p[2] * p[2] <= limit);
                    Ok(Frame { scan: frame.scan, pose: frame.t_map_sensor })
                });
                Ok(Source {
                    name: format!("robot{}", number + 1),
                    frames_expected: record.summary.frames,
                    seconds_expected: self.seconds,
                    frames: Frames::new(frames),
                })
            })
            .collect()
    }

    /// Where the other robots are when one of them scans: returns within these spheres are the robots themselves.
    pub fn masks(&self, robot: usize, at: Stamp, radius: f64) -> Vec<Sphere> {
        let others = self.positions.iter().enumerate().filter(|(other, _)| *other != robot);
        others
            .filter_map(|(_, way)| {
                let next = way.partition_point(|(stamp, _)| *stamp <= at);
                let (_, centre) = way.get(next.checked_sub(1)?)?;
                Some(Sphere { centre: *centre, radius })
            })
            .collect()
    }
}
