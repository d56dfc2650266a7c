//! `flockmap replay`: records, or simulated flights, through the whole stack in virtual time.

use anyhow::ensure;
use flockmap::{RobotConfig, RobotId, SessionConfig};
use flockmap_netsim::{Link, RadioConfig};

use crate::args::ReplayArgs;
use crate::report::Settings;
use crate::{html, json_file, sources, swarm};

/// Runs the command. Whether everything arrived and every voxel is equal.
pub fn run(args: &ReplayArgs) -> anyhow::Result<bool> {
    for (name, share) in [("--loss", args.loss), ("--duplication", args.duplication)] {
        ensure!(
            (0.0..=1.0).contains(&share),
            "{name} is {share}, expected 0 to 1 (0.2 loses every fifth datagram)"
        );
    }
    for (name, ms) in [("--delay-ms", args.delay_ms), ("--jitter-ms", args.jitter_ms)] {
        ensure!((0.0..=60_000.0).contains(&ms), "{name} is {ms}, expected 0 to 60,000");
    }
    let base = RobotConfig {
        mapper: args.map.mapper()?,
        cycle: args.map.cycle()?,
        codec: args.codec,
        session: session(args)?,
        seed: args.source.seed,
        ..RobotConfig::new(RobotId(1), args.map.resolution()?, args.map.range)
    };
    base.session.validate()?;
    let sources = match args.records.as_slice() {
        // One robot alone has nobody to sync with.
        [record] if !sources::is_world(record) && args.source.robots > 1 => {
            sources::open_parts(record, &args.source)?
        }
        records => sources::open(records, &args.source, args.map.range, args.real_stamps)?,
    };
    let link = Link {
        loss: args.loss,
        delay_micros: (args.delay_ms * 1e3) as i64,
        jitter_micros: (args.jitter_ms * 1e3) as i64,
        duplication: args.duplication,
    };
    let radio = RadioConfig { seed: args.source.seed, link, ..RadioConfig::default() };
    let title = format!("replay of {}", sources.title);
    let run = swarm::run(sources.robots, |id| RobotConfig { id, ..base.clone() }, radio)?;
    let settings =
        Settings::new(&args.map, args.codec, args.cast.name(), radio_in_words(args), args.source.seed);
    let report = run.report(title, settings)?;
    report.print();
    if let Some(path) = &args.json {
        json_file::write(path, &report)?;
    }
    if let Some(folder) = &args.out {
        html::write(folder, &report)?;
    }
    Ok(report.is_good())
}

fn session(args: &ReplayArgs) -> anyhow::Result<SessionConfig> {
    let mut session = if args.paper_session { SessionConfig::paper() } else { SessionConfig::default() };
    session.cast = args.cast.into();
    if let Some(kb) = args.budget_kb_s {
        let bytes = kb * 1024.0;
        ensure!(
            (500.0..=4e9).contains(&bytes),
            "--budget-kb-s is {kb}, expected at least 0.49 (500 bytes a second: a datagram in two and a half seconds)"
        );
        session.radio_bytes_per_s = Some(bytes as u32);
    }
    Ok(session)
}

fn radio_in_words(args: &ReplayArgs) -> String {
    let mut words =
        vec![format!("{} % of datagrams lost", args.loss * 100.0), format!("{} ms delay", args.delay_ms)];
    if args.jitter_ms > 0.0 {
        words.push(format!("up to {} ms jitter", args.jitter_ms));
    }
    if args.duplication > 0.0 {
        words.push(format!("{} % arrive twice", args.duplication * 100.0));
    }
    if let Some(kb) = args.budget_kb_s {
        words.push(format!("at most {kb} KB/s a robot"));
    }
    words.join(", ")
}
