//! Explorations of the paper's two scenes, flown once and recorded; every row replays the same record.

use std::path::Path;
use std::sync::Arc;

use flockmap::{Codec, Stamp};
use flockmap_autonomy::{Ended, ExploreOptions};
use flockmap_cli::robot_record::{RecordFacts, file_bytes};
use flockmap_cli::sources::{self, Source};
use flockmap_cli::team::Team;
use flockmap_cli::{explore, stop};
use flockmap_io::{Frames, Record, RecordOptions, open_record};
use flockmap_worlds::{ScanOptions, World};

use super::args::PaperArgs;
use super::figures::{CHANGES_MAX, PUBLISH_PERIOD_S, TABLE_ONE};
use super::settings::batch;
use crate::place::Place;

/// The LiDAR sees as far as the longest range of the paper's rows needs.
pub const LIDAR_RANGE_M: f64 = 20.0;

/// A recorded exploration.
pub struct Flown {
    pub scene: Place,
    /// What each robot's record holds.
    pub records: Vec<RecordFacts>,
    /// From the first to the last scan.
    pub seconds: f64,
    /// What is known of a flight that was just flown.
    pub explored: Option<Explored>,
    /// Why it ended.
    pub ended: &'static str,
}

/// How an exploration went.
#[derive(Clone, Copy)]
pub struct Explored {
    /// Share of what can be seen from where robots can be that was seen.
    pub seen_share: f64,
    /// How many robots mapped a voxel, on average.
    pub overlap: f64,
    /// What the robots sent each other meanwhile.
    pub sent_bytes: u64,
}

/// How a scene is explored.
pub fn options(scene: Place, args: &PaperArgs, threads: usize) -> ExploreOptions {
    let row = TABLE_ONE.iter().find(|row| row.scene == scene);
    ExploreOptions {
        robots: scene.robots(),
        seed: args.seed,
        range_m: row.map_or(7.0, |row| row.range_m),
        lidar: args.lidar,
        scan: ScanOptions {
            range_m: LIDAR_RANGE_M,
            seed: args.seed,
            rendering: args.rendering,
            // Explorers have to distinguish the open sky from what they have not looked at.
            no_returns: true,
            ..ScanOptions::default()
        },
        seconds_max: args.seconds.unwrap_or(if args.quick { 10.0 } else { 400.0 }),
        batch: batch(PUBLISH_PERIOD_S, CHANGES_MAX),
        threads: threads.min(scene.robots()),
        // As the paper's robots, so that the flights are those of all earlier reports.
        codec: Codec::Paper,
        ..ExploreOptions::default()
    }
}

/// Flies and records. `None` if Ctrl-C came before the first step.
pub fn fly(
    scene: Place,
    world: World,
    options: ExploreOptions,
    folder: &Path,
) -> anyhow::Result<Option<Flown>> {
    let folder = folder.join(scene.name());
    let Some(mut explorer) = explore::prepare(Arc::new(world), options)? else { return Ok(None) };
    let records = explore::record(&mut explorer, &folder, true, "seconds flown")?;
    let outcome = explorer.outcome();
    let traffic =
        explorer.robots().map(|robot| explorer.radio().traffic(robot.own_stream().origin).sent_bytes);
    Ok(Some(Flown {
        scene,
        seconds: records.iter().map(|record| record.seconds).fold(0.0, f64::max),
        records,
        explored: Some(Explored {
            seen_share: outcome.seen_share,
            overlap: outcome.overlap,
            sent_bytes: traffic.sum(),
        }),
        ended: match outcome.ended {
            _ if stop::requested() => "ended by Ctrl-C",
            Ended::Done => "nothing was left to see",
            Ended::TimeOut => "the time was over",
        },
    }))
}

/// A flight that was recorded before: `FOLDER/forest/robot1.mcap` and so on.
pub fn open(scene: Place, folder: &Path) -> anyhow::Result<Flown> {
    let mut records = Vec::new();
    for number in 1..=scene.robots() {
        let robot = format!("robot{number}");
        let file = folder.join(scene.name()).join(format!("{robot}.mcap"));
        let summary = open_record(&file, &RecordOptions::default())?.summary;
        records.push(RecordFacts {
            robot,
            scans: summary.frames,
            points: summary.points.unwrap_or(0),
            seconds: summary.duration_s(),
            path_m: summary.path_m,
            file_bytes: file_bytes(&file)?,
            file,
            ..RecordFacts::default()
        });
    }
    Ok(Flown {
        scene,
        seconds: records.iter().map(|record| record.seconds).fold(0.0, f64::max),
        records,
        explored: None,
        ended: "recorded before",
    })
}

impl Flown {
    /// The robots with what the paper's simulated LiDAR delivers that reaches `range_m`: what is farther gives no
    /// return, and nobody hears of rays without one.
    pub fn sources(&self, range_m: f64) -> anyhow::Result<Vec<Source>> {
        let records = self.records.iter().map(|record| open_record(&record.file, &RecordOptions::default()));
        let records = records.collect::<Result<Vec<Record>, _>>()?;
        let team = Team::new(records.iter().map(|record| (record.poses.as_slice(), Stamp(0))));
        let robots = records.into_iter().enumerate().map(|(number, mut record)| {
            record.frames = Frames::new(record.frames.map(move |frame| {
                let mut frame = frame?;
                let limit = (range_m * range_m) as f32;
                frame.scan.points.retain(|p| p[0] * p[0] + p[1] * p[1] + p[2] * p[2] <= limit);
                frame.scan.no_returns.clear();
                Ok(frame)
            }));
            let (first, last) = record.summary.span.unwrap_or_default();
            let name = format!("robot{}", number + 1);
            sources::part(record, name, [first, last], Stamp(0), (team.clone(), number))
        });
        Ok(robots.collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap::{Resolution, Voxel};
    use flockmap_worlds::WorldError;

    /// A hall of 12 × 12 × 3 m with walls, floor and ceiling.
    fn hall() -> Result<World, WorldError> {
        let resolution = Resolution::from_metres(0.2).unwrap();
        let [x, y, z] = [60, 60, 15];
        let is_wall =
            |v: &Voxel| v.x == 0 || v.y == 0 || v.z == 0 || v.x == x - 1 || v.y == y - 1 || v.z == z - 1;
        let voxels = (0..x).flat_map(|x| (0..y).flat_map(move |y| (0..z).map(move |z| Voxel::new(x, y, z))));
        World::from_points(voxels.filter(is_wall).map(|voxel| resolution.centre(voxel)), resolution)
    }

    #[test]
    fn a_flight_is_recorded_and_opened_again() {
        let folder = tempfile::tempdir().unwrap();
        let scan = ScanOptions { range_m: LIDAR_RANGE_M, no_returns: true, ..ScanOptions::default() };
        let options = ExploreOptions {
            robots: 2,
            range_m: 7.0,
            scan,
            seconds_max: 1.0,
            threads: 2,
            ..ExploreOptions::default()
        };
        let flown = fly(Place::Forest, hall().unwrap(), options, folder.path()).unwrap().unwrap();
        assert_eq!((flown.records.len(), flown.ended), (2, "the time was over"));
        assert!(flown.explored.unwrap().seen_share > 0.0);
        let again = open(Place::Forest, folder.path()).unwrap();
        let facts =
            |of: &Flown| of.records.iter().map(|r| (r.scans, r.points, r.file_bytes)).collect::<Vec<_>>();
        assert_eq!(facts(&flown), facts(&again));
        assert!((flown.seconds - again.seconds).abs() < 1e-6);

        let near = |range: f64| {
            let scans = again.sources(range).unwrap().remove(0).frames;
            scans.map(|frame| (frame.scan.points.len(), frame.team_mates.len())).collect::<Vec<_>>()
        };
        let (all, some) = (near(50.0), near(3.0));
        assert_eq!(all.len(), some.len());
        assert!(all.iter().zip(&some).all(|(a, b)| a.0 > b.0 && a.1 == 1 && b.1 == 1), "{all:?} {some:?}");
    }
}
