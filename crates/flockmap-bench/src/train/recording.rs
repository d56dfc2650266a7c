//! Flies a scene and maps it: the batches that robots would send.

use std::sync::Arc;

use anyhow::Context;
use flockmap::{Batch, BatchConfig, Changes, MapperConfig, Pose, Preset, Resolution, Scan, Stamp};
use flockmap_cli::parallel::in_parallel;
use flockmap_cli::progress::Progress;
use flockmap_worlds::{ScanOptions, Scanner, Trajectory, TrajectoryOptions, World};

use super::scenes::{MapSize, ROBOTS, Scans, Scene};
use crate::batcher::{Batcher, Step};

/// When batches close. Each flight is mapped with both, as robots can be set to either.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Closing {
    /// All changes every half second.
    Together,
    /// Obstacles every tenth of a second, free space every two seconds.
    ObstaclesAhead,
}

impl Closing {
    const ALL: [Self; 2] = [Self::Together, Self::ObstaclesAhead];

    fn config(self) -> BatchConfig {
        let (publish_period_ms, obstacle_period_ms) = match self {
            Self::Together => (500, None),
            Self::ObstaclesAhead => (2_000, Some(100)),
        };
        BatchConfig { publish_period_ms, obstacle_period_ms, ..BatchConfig::default() }
    }
}

/// All batches of one robot, in order.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Recording {
    pub scans: Scans,
    pub closing: Closing,
    pub batches: Vec<(Batch, Changes)>,
}

/// A flight that is still to be flown.
struct Flight<'a> {
    scene: &'a Scene,
    robot: usize,
    world: Arc<World>,
    poses: Vec<(Stamp, Pose)>,
}

/// Flies all scenes and maps every flight at every size, with both closings. The same recordings in the same
/// order, whatever the number of threads. Holds all batches: about 130 bytes for each block of 8³ voxels that
/// changed.
pub fn record(scenes: &[Scene], threads: usize) -> anyhow::Result<Vec<Recording>> {
    let progress = Progress::new("worlds", scenes.len() as u64);
    let planned = in_parallel(threads, scenes, |scene| {
        let flights = plan(scene)?;
        progress.step();
        anyhow::Ok(flights)
    });
    let flights: Vec<Flight<'_>> =
        planned.into_iter().collect::<anyhow::Result<Vec<_>>>()?.into_iter().flatten().collect();
    let progress = Progress::new("flights", flights.len() as u64);
    let recordings = in_parallel(threads, &flights, |flight| {
        let recordings = fly(flight)?;
        progress.step();
        anyhow::Ok(recordings)
    });
    Ok(recordings.into_iter().collect::<anyhow::Result<Vec<_>>>()?.into_iter().flatten().collect())
}

fn plan(scene: &Scene) -> anyhow::Result<Vec<Flight<'_>>> {
    let world = Arc::new(scene.place.world(scene.seed));
    let options = TrajectoryOptions { duration_s: scene.seconds, ..TrajectoryOptions::default() };
    let trajectories = Trajectory::plan(&world, ROBOTS, scene.seed, &options)
        .with_context(|| format!("no flight through {scene}"))?;
    let flight = |(robot, trajectory): (usize, Trajectory)| {
        let poses = trajectory.into_poses().into_iter().skip(scene.every - 1).step_by(scene.every).collect();
        Flight { scene, robot, world: Arc::clone(&world), poses }
    };
    Ok(trajectories.into_iter().enumerate().map(flight).collect())
}

/// Scans take longest to make, so each goes to all mappers while it is there.
fn fly(flight: &Flight<'_>) -> anyhow::Result<Vec<Recording>> {
    let Flight { scene, robot, world, poses } = flight;
    let options = ScanOptions {
        range_m: scene.sight_m,
        drop_out: scene.drop_out,
        range_noise_m: scene.noise_m,
        seed: scene.seed,
        ..ScanOptions::default()
    };
    let mut scanner = Scanner::new(Arc::clone(world), scene.lidar, options);
    let mut makers = Vec::new();
    for size in scene.sizes {
        for closing in Closing::ALL {
            makers.push(Maker::new(scene.scans, closing, *robot, *size)?);
        }
    }
    for (stamp, pose) in poses {
        let scan = scanner.scan(*stamp, pose, None, &[]);
        makers.iter_mut().try_for_each(|maker| maker.scan(&scan, pose))?;
    }
    Ok(makers.into_iter().map(Maker::finish).collect())
}

/// A robot whose batches are kept.
struct Maker {
    robot: Batcher,
    recording: Recording,
}

impl Maker {
    fn new(scans: Scans, closing: Closing, robot: usize, size: MapSize) -> anyhow::Result<Self> {
        let resolution = Resolution::from_metres(size.resolution_m)
            .with_context(|| format!("no map has voxels of {} m", size.resolution_m))?;
        let mapper = MapperConfig::preset(Preset::RogMap, resolution, size.range_m);
        Ok(Self {
            robot: Batcher::new(robot, &mapper, closing.config())?,
            recording: Recording { scans, closing, batches: Vec::new() },
        })
    }

    fn scan(&mut self, scan: &Scan, pose: &Pose) -> anyhow::Result<()> {
        self.robot.scan(scan, pose, &[], |_, step| {
            if let Step::Closed(batch, changes) = step {
                self.recording.batches.push((batch, changes));
            }
            Ok(())
        })
    }

    fn finish(mut self) -> Recording {
        self.recording.batches.extend(self.robot.end());
        self.recording
    }
}
