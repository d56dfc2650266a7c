//! Exploring swarms, written as one record a robot.

use std::path::Path;
use std::sync::Arc;

use flockmap_autonomy::{ExploreError, ExploreOptions, Explorer};
use flockmap_worlds::World;

use crate::progress::Progress;
use crate::robot_record::{self, RecordFacts, RobotRecord};
use crate::stop;

/// Steps between two looks at the share that is seen.
const LOOK_EVERY_STEPS: u64 = 20;

/// Works out what can be seen, which takes some seconds. `None` after Ctrl-C.
pub fn prepare(world: Arc<World>, options: ExploreOptions) -> anyhow::Result<Option<Explorer>> {
    let progress = Progress::new("looking for what can be seen: percent", 100);
    let goes_on = |done: usize, of: usize| {
        progress.set(100 * done as u64 / of as u64);
        !stop::requested()
    };
    match Explorer::new_watched(world, options, &goes_on) {
        Err(ExploreError::Stopped) => Ok(None),
        made => Ok(Some(made?)),
    }
}

/// Explores to the end, or until Ctrl-C, and writes a record of each robot to a folder; with pictures of the
/// fused maps, if wanted.
pub fn record(
    explorer: &mut Explorer,
    folder: &Path,
    with_views: bool,
    what: &str,
) -> anyhow::Result<Vec<RecordFacts>> {
    let robots = explorer.robots().count();
    robot_record::prepare_folder(folder, robots)?;
    let mut records = (1..=robots)
        .map(|number| RobotRecord::create(folder, &format!("robot{number}")))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let progress = Progress::new(what, explorer.options().seconds_max.ceil() as u64);
    let mut steps = 0u64;
    while !stop::requested()
        && let Some(frames) = explorer.step()
    {
        for (record, frame) in records.iter_mut().zip(&frames) {
            record.scan(&frame.scan, &frame.t_map_sensor)?;
        }
        if with_views {
            view(explorer, &mut records, false)?;
        }
        if steps.is_multiple_of(LOOK_EVERY_STEPS) {
            let seen = explorer.progress();
            progress.say(format!("{:.1} % seen, {what}", seen.seen_share * 100.0));
            progress.set(seen.seconds as u64);
        }
        steps += 1;
    }
    drop(progress);
    if with_views {
        view(explorer, &mut records, true)?;
    }
    records.into_iter().map(RobotRecord::finish).collect()
}

/// Writes pictures of the fused maps where they are due, or of all.
fn view(explorer: &Explorer, records: &mut [RobotRecord], all: bool) -> anyhow::Result<()> {
    let resolution = explorer.options().resolution;
    for (record, robot) in records.iter_mut().zip(explorer.robots()) {
        if all || record.is_view_due() {
            record.view(resolution, robot_record::occupied(robot.map().blocks()))?;
        }
    }
    Ok(())
}
