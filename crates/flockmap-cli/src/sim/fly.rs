//! `flockmap sim fly`: simulated flights, written as one record a robot.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use anyhow::{bail, ensure};
use flockmap::grid::Mapper;
use serde_json::json;

use super::robot_record::{self, RecordFacts, RobotRecord};
use crate::args::SourceArgs;
use crate::args_sim::SimFlyArgs;
use crate::progress::Progress;
use crate::sources::{self, Source};
use crate::{command_line, json_file, stop};

/// How often the progress is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// Runs the command.
pub fn run(args: &SimFlyArgs) -> anyhow::Result<bool> {
    ensure!(args.threads.is_none_or(|n| (1..=1_000).contains(&n)), "--threads must be 1 to 1,000");
    if !sources::is_world(&args.scene) {
        bail!(
            "--scene {}: expected forest, indoor, or a .bt, .pcd, .ply, .las or .laz file",
            args.scene.display()
        );
    }
    // Wrong options are told before anything is made.
    args.map.mapper()?;
    eprintln!("making the world and planning the flights ...");
    let source = SourceArgs { see_team_mates: !args.hide_team_mates, ..args.source.clone() };
    let sources = sources::open(std::slice::from_ref(&args.scene), &source, args.map.range, false)?;
    robot_record::prepare_folder(&args.out, sources.robots.len())?;
    let records = write_all(sources.robots, args)?;
    robot_record::print_table(&records);
    if stop::requested() {
        eprintln!("warning: ended by Ctrl-C: the files hold what was flown so far");
    }
    if let Some(path) = &args.json {
        json_file::write(
            path,
            &json!({"command": command_line(), "title": sources.title, "seed": args.source.seed, "robots": records}),
        )?;
    }
    Ok(true)
}

/// Records every robot, several at the same time. Each file depends on its own robot alone.
fn write_all(robots: Vec<Source>, args: &SimFlyArgs) -> anyhow::Result<Vec<RecordFacts>> {
    let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let threads = args.threads.unwrap_or(cores).min(robots.len());
    let mut progress = Progress::new("scans", robots.iter().map(|source| source.frames_expected).sum());
    let scans = AtomicU64::new(0);
    let has_failed = AtomicBool::new(false);
    let waiting = Mutex::new(robots.into_iter().enumerate().rev().collect::<Vec<_>>());
    let mut records = Vec::new();
    std::thread::scope(|scope| {
        let work = || {
            let mut done = Vec::new();
            loop {
                let next = waiting.lock().ok().and_then(|mut waiting| waiting.pop());
                let Some((number, source)) = next else { return done };
                let is_wanted = || {
                    scans.fetch_add(1, Ordering::Relaxed);
                    !stop::requested() && !has_failed.load(Ordering::Relaxed)
                };
                let record = write_one(source, args, is_wanted);
                has_failed.fetch_or(record.is_err(), Ordering::Relaxed);
                done.push((number, record));
            }
        };
        let workers: Vec<_> = (0..threads).map(|_| scope.spawn(work)).collect();
        while workers.iter().any(|worker| !worker.is_finished()) {
            progress.set(scans.load(Ordering::Relaxed));
            std::thread::sleep(LOOK_EVERY);
        }
        for worker in workers {
            match worker.join() {
                Ok(done) => records.extend(done),
                Err(panic) => std::panic::resume_unwind(panic),
            }
        }
    });
    records.sort_by_key(|(number, _)| *number);
    records.into_iter().map(|(_, record)| record).collect()
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
