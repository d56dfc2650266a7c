//! `flockmap sim explore`: a swarm that explores on its own, written as one record a robot.

use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::{bail, ensure};
use flockmap::SessionConfig;
use flockmap_autonomy::{Ended, ExploreError, ExploreOptions, Explorer};
use flockmap_netsim::{IP_UDP_BYTES, Link, RadioConfig, Traffic};
use flockmap_worlds::World;
use serde_json::{Value, json};

use super::robot_record::{self, RecordFacts, RobotRecord};
use crate::args_sim::SimExploreArgs;
use crate::progress::Progress;
use crate::table::{Table, kb, thousands};
use crate::{command_line, json_file, sources, stop};

/// Steps between two looks at the share that is seen.
const LOOK_EVERY_STEPS: u64 = 20;

/// Runs the command.
pub fn run(args: &SimExploreArgs) -> anyhow::Result<bool> {
    if !sources::is_world(&args.scene) {
        bail!(
            "--scene {}: expected forest, indoor, or a .bt, .pcd, .ply, .las or .laz file",
            args.scene.display()
        );
    }
    let options = options(args)?;
    eprintln!("making the world ...");
    let world = Arc::new(sources::open_world(&args.scene, &args.source)?);
    let Some(mut explorer) = prepare(world, options)? else { return Ok(true) };
    let records = record(&mut explorer, &args.out, !args.no_view, "exploring: seconds")?;
    let facts = facts(&explorer, args);
    robot_record::print_table(&records);
    print_outcome(&explorer, args);
    if let Some(path) = &args.json {
        json_file::write(path, &with_records(facts, &records)?)?;
    }
    Ok(true)
}

/// Works out what can be seen, which takes some seconds. `None` after Ctrl-C.
pub fn prepare(world: Arc<World>, options: ExploreOptions) -> anyhow::Result<Option<Explorer>> {
    let progress = Mutex::new(Progress::new("looking for what can be seen: percent", 100));
    let goes_on = |done: usize, of: usize| {
        let mut progress = progress.lock().unwrap_or_else(PoisonError::into_inner);
        progress.set(100 * done as u64 / of as u64);
        !stop::requested()
    };
    match Explorer::new_watched(world, options, &goes_on) {
        Err(ExploreError::Stopped) => Ok(None),
        made => Ok(Some(made?)),
    }
}

/// Explores to the end, or until Ctrl-C, and writes a record of each robot to a folder; with pictures of the fused maps, if wanted.
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
    let mut progress = Progress::new(what, explorer.options().seconds_max.ceil() as u64);
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

fn options(args: &SimExploreArgs) -> anyhow::Result<ExploreOptions> {
    let SimExploreArgs { map, source, .. } = args;
    ensure!(args.threads.is_none_or(|n| (1..=64).contains(&n)), "--threads must be 1 to 64");
    ensure!((0.0..=1.0).contains(&args.loss), "--loss is {}, expected 0 to 1", args.loss);
    ensure!(
        (0.0..=60_000.0).contains(&args.delay_ms),
        "--delay-ms is {}, expected 0 to 60,000",
        args.delay_ms
    );
    ensure!(source.moving_obstacles == 0, "--moving-obstacles: explorers do not evade them; use `sim fly`");
    let mut session = SessionConfig::default();
    if let Some(kb) = args.budget_kb_s {
        let bytes = kb * 1024.0;
        ensure!(
            (500.0..=4e9).contains(&bytes),
            "--budget-kb-s is {kb}, expected at least 0.49 (500 bytes a second)"
        );
        session.radio_bytes_per_s = Some(bytes as u32);
    }
    let link = Link {
        loss: if args.no_sync { 1.0 } else { args.loss },
        delay_micros: (args.delay_ms * 1e3) as i64,
        ..Link::default()
    };
    let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get).min(64);
    let mut limits = ExploreOptions::default().limits;
    limits.speed_m_s = source.speed.unwrap_or(limits.speed_m_s);
    Ok(ExploreOptions {
        robots: source.robots,
        seed: source.seed,
        resolution: map.resolution()?,
        range_m: map.range,
        lidar: source.lidar,
        scan: sources::scan_options(source, map.range)?,
        seconds_max: args.seconds_max,
        limits,
        radio: RadioConfig { link, ..RadioConfig::default() },
        cycle: map.cycle()?,
        codec: args.codec,
        session,
        threads: args.threads.unwrap_or(cores),
        ..ExploreOptions::default()
    })
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

/// What robots sent over the radio; nothing if there was none.
fn sent(explorer: &Explorer, args: &SimExploreArgs) -> Vec<Traffic> {
    let of = |robot: &flockmap::Robot| explorer.radio().traffic(robot.own_stream().origin);
    explorer.robots().map(|robot| if args.no_sync { Traffic::default() } else { of(robot) }).collect()
}

const fn ended_in_words(ended: Ended) -> &'static str {
    match ended {
        Ended::Done => "nothing is left to see",
        Ended::TimeOut => "the time was over",
    }
}

fn print_outcome(explorer: &Explorer, args: &SimExploreArgs) {
    let outcome = explorer.outcome();
    let seconds = outcome.seconds.max(0.1);
    let mut table = Table::new(["robot", "metres", "sent KB", "KB/s", "datagrams"]);
    for (number, (path_m, traffic)) in outcome.path_m.iter().zip(sent(explorer, args)).enumerate() {
        table.row([
            format!("robot{}", number + 1),
            format!("{path_m:.1}"),
            kb(traffic.sent_bytes as f64),
            kb(traffic.sent_bytes as f64 / seconds),
            thousands(traffic.sent),
        ]);
    }
    print!("\n{table}");
    let ended = if stop::requested() { "ended by Ctrl-C" } else { ended_in_words(outcome.ended) };
    println!(
        "\n  {:.1} s: {ended}; {:.2} % of {} voxels that can be seen were seen, each by {:.2} robots",
        outcome.seconds,
        outcome.seen_share * 100.0,
        thousands(outcome.seeable_voxels),
        outcome.overlap,
    );
}

fn facts(explorer: &Explorer, args: &SimExploreArgs) -> Value {
    let outcome = explorer.outcome();
    let traffic = sent(explorer, args);
    let datagrams: u64 = traffic.iter().map(|t| t.sent).sum();
    json!({
        "command": command_line(),
        "seed": args.source.seed,
        "sync": !args.no_sync,
        "loss": args.loss,
        "delay_ms": args.delay_ms,
        "budget_kb_s": args.budget_kb_s,
        "ended": if stop::requested() { "interrupted" } else { match outcome.ended { Ended::Done => "done", Ended::TimeOut => "time-out" } },
        "seconds": outcome.seconds,
        "seen_share": outcome.seen_share,
        "seeable_voxels": outcome.seeable_voxels,
        "overlap": outcome.overlap,
        "path_m": outcome.path_m,
        "total_bytes": traffic.iter().map(|t| t.sent_bytes).sum::<u64>(),
        "ip_udp_bytes": datagrams * IP_UDP_BYTES as u64,
        "datagrams": datagrams,
        "sent_bytes": traffic.iter().map(|t| t.sent_bytes).collect::<Vec<_>>(),
    })
}

fn with_records(mut facts: Value, records: &[RecordFacts]) -> anyhow::Result<Value> {
    let records = serde_json::to_value(records)?;
    if let Value::Object(facts) = &mut facts {
        facts.insert("robots".to_owned(), records);
    }
    Ok(facts)
}
