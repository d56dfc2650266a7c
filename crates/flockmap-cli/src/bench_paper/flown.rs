//! Explorations of the paper's two scenes, flown once and recorded; every row replays the same record.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use flockmap::Stamp;
use flockmap_io::{Record, RecordOptions, open_record};
use flockmap_sim::{Flight, Lidar, Patrol, PatrolOptions, ScanOptions, World};

use super::figures::Scene;
use crate::progress::Progress;
use crate::sim::robot_record::{self, RecordFacts, RobotRecord};
use crate::sources::{Frame, Frames, Source};
use crate::stop;
use crate::team::Team;

/// The LiDAR sees as far as the longest range of the paper's rows needs.
pub const LIDAR_RANGE_M: f64 = 20.0;

/// A recorded exploration.
pub struct Flown {
    pub scene: Scene,
    /// What each robot's record holds.
    pub records: Vec<RecordFacts>,
    /// From the first to the last scan.
    pub seconds: f64,
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
    let folder: PathBuf = folder.join(scene.name());
    robot_record::prepare_folder(&folder, scene.robots())?;
    let world = Arc::new(scene.world(plan.seed));
    let options = PatrolOptions { duration_s: plan.seconds_max.min(60.0), ..PatrolOptions::default() };
    let scan = ScanOptions { range_m: LIDAR_RANGE_M, ..ScanOptions::default() };
    let patrols = Patrol::plan(&world, scene.robots(), plan.seed, &options)?;
    let mut flights: Vec<Flight> =
        patrols.into_iter().map(|patrol| Flight::new(Arc::clone(&world), plan.lidar, scan, patrol)).collect();
    let mut records = (1..=scene.robots())
        .map(|number| RobotRecord::create(&folder, &format!("robot{number}")))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let mut progress = Progress::new("seconds", plan.seconds_max.min(60.0).ceil() as u64);
    'flight: while !stop::requested() {
        for (flight, record) in flights.iter_mut().zip(&mut records) {
            let Some(frame) = flight.next() else { break 'flight };
            record.scan(&frame.scan, &frame.t_map_sensor)?;
            progress.set(frame.scan.stamp.seconds() as u64);
        }
    }
    let records = records.into_iter().map(RobotRecord::finish).collect::<anyhow::Result<Vec<_>>>()?;
    Ok(Flown {
        scene,
        seconds: records.iter().map(|record| record.seconds).fold(0.0, f64::max),
        records,
        seen_share: None,
        ended: "the time was over".to_owned(),
    })
}

impl Flown {
    /// The robots with what a LiDAR sees that reaches `range_m`: what is farther gives no return.
    pub fn sources(&self, range_m: f64) -> anyhow::Result<Vec<Source>> {
        let records: Vec<Record> = self
            .records
            .iter()
            .map(|record| open_record(&record.file, &RecordOptions::default()))
            .collect::<Result<_, _>>()?;
        let team = Team::new(records.iter().map(|record| (record.poses.as_slice(), Stamp(0))));
        let robots = records.into_iter().enumerate().map(|(number, record)| {
            let team = team.clone();
            let frames = record.frames.map(move |frame| {
                let mut frame = frame?;
                let limit = (range_m * range_m) as f32;
                frame.scan.points.retain(|p| p[0] * p[0] + p[1] * p[1] + p[2] * p[2] <= limit);
                let team_mates = team.mates(number, frame.scan.stamp);
                Ok(Frame { scan: frame.scan, pose: frame.t_map_sensor, team_mates })
            });
            Source {
                name: format!("robot{}", number + 1),
                frames_expected: record.summary.frames,
                seconds_expected: self.seconds,
                frames: Frames::new(frames),
            }
        });
        Ok(robots.collect())
    }
}
