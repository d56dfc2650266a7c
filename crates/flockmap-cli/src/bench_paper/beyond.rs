//! The same methods on recordings of real sensors.

use std::path::{Path, PathBuf};

use clap::Parser;
use flockmap::{Codec, SessionConfig};
use flockmap_baselines::Method;
use flockmap_netsim::Link;

use super::args::BenchPaperArgs;
use super::figures::{CHANGES_MAX, T_L_S};
use super::jobs::{self, Job};
use super::methods::{self, MethodRow, MethodRows};
use super::stack::{self, Stack, StackPlan};
use super::table1::{self, STACK};
use super::{cycle, mapper};
use crate::args::SourceArgs;
use crate::codec_run::{CodecRun, Outcome};
use crate::document::{Part, Section};
use crate::progress::Progress;
use crate::sources::{self, Sources};

/// Options of records as they are when nothing is said.
#[derive(Parser)]
struct Defaults {
    #[command(flatten)]
    source: SourceArgs,
}

/// What was measured, or why nothing was.
pub struct Measured {
    pub title: String,
    pub methods: MethodRows,
}

enum Piece {
    Codec(Outcome),
    Stack(Box<Stack>),
    Rival(MethodRow),
    Relay(Outcome),
}

/// The records that the command line names, or those in the data folder.
pub fn records(args: &BenchPaperArgs) -> Vec<PathBuf> {
    if !args.records.is_empty() {
        return args.records.clone();
    }
    let Some(folder) = std::env::var_os("FLOCKMAP_DATA") else { return Vec::new() };
    let files = [1, 2].map(|number| Path::new(&folder).join(format!("hku_mb/robot{number}.mcap")));
    if files.iter().all(|file| file.is_file()) { files.to_vec() } else { Vec::new() }
}

/// All methods, and our own stack, on the records as robots.
pub fn measure(
    args: &BenchPaperArgs,
    records: &[PathBuf],
    threads: usize,
) -> anyhow::Result<Option<Measured>> {
    let source =
        SourceArgs { seconds: args.quick.then_some(20.0), ..Defaults::parse_from(["records"]).source };
    let open = || -> anyhow::Result<Sources> {
        match records {
            [record] => sources::open_parts(record, &source),
            records => sources::open(records, &source, args.beyond_range, false),
        }
    };
    let Sources { robots, title } = open()?;
    let count = robots.len();
    drop(robots);
    let mapper = mapper(args.beyond_resolution, args.beyond_range)?;
    let cycle = cycle(T_L_S, CHANGES_MAX);
    let mut jobs = vec![Job::new("recordings, whole stack", || {
        let plan = StackPlan {
            title: title.clone(),
            mapper: mapper.clone(),
            cycle,
            codec: Codec::Flock,
            session: SessionConfig::default(),
            link: Link::default(),
            seed: args.seed,
        };
        stack::run(&plan, open()?.robots).map(|stack| Piece::Stack(Box::new(stack)))
    })];
    jobs.push(Job::new("recordings, racer-code", || {
        table1::rival_run(&mapper, open()?.robots, args.seed).map(Piece::Rival)
    }));
    // A scan of these recordings is a quarter of a simulated one: there is time for more of them.
    let relayed_s = 3.0 * methods::relayed_s(args.quick);
    let (mapper, open) = (&mapper, &open);
    let run = move |number: usize, seconds: f64, methods: &[Method]| -> anyhow::Result<Outcome> {
        let source = open()?.robots.swap_remove(number);
        let mut run = CodecRun::new(mapper.clone(), cycle, methods, count - 1);
        let mut progress = Progress::new("scans", source.frames_expected);
        let frames = source.frames.take_while(|frame| frame.scan.stamp.seconds() < seconds);
        run.record(frames, || progress.step())?;
        Ok(run.finish())
    };
    for number in 0..count {
        jobs.push(Job::new(format!("recordings, robot {}", number + 1), move || {
            run(number, f64::INFINITY, &methods::all()).map(Piece::Codec)
        }));
        jobs.push(Job::new(format!("recordings, scans relayed, robot {}", number + 1), move || {
            run(number, relayed_s, &methods::relays()).map(Piece::Relay)
        }));
    }
    let (mut robots, mut relays, mut rival, mut stack) = (Vec::new(), Vec::new(), None, None);
    for piece in jobs::run(threads, jobs)?.into_iter().flatten() {
        match piece {
            Piece::Codec(outcome) => robots.push(outcome),
            Piece::Stack(done) => stack = Some(done),
            Piece::Relay(outcome) => relays.push(outcome),
            Piece::Rival(row) => rival = Some(row),
        }
    }
    let Some(stack) = stack.filter(|_| robots.len() == count) else { return Ok(None) };
    let mut methods = MethodRows::of_robots(&robots, count - 1);
    if relays.len() == count {
        methods.add_relays(MethodRows::of_robots(&relays, count - 1), relayed_s);
    }
    methods.add(rival);
    methods.add([stack.row(STACK, "As in Table I.")]);
    Ok(Some(Measured { title, methods }))
}

pub fn section(args: &BenchPaperArgs, measured: Option<&Measured>) -> Section {
    let mut parts = Vec::new();
    match measured {
        Some(Measured { title, methods }) => {
            let mut table = methods.table("beyond");
            table.note = format!(
                "{title}: {} m voxels, {} m range, t_l {T_L_S} s; {} voxels changed.",
                args.beyond_resolution,
                args.beyond_range,
                crate::table::thousands(methods.changed_voxels)
            );
            parts.push(Part::Words(
                "The paper has no recordings to repeat. These are of a real sensor, and none was used to choose anything.".to_owned(),
            ));
            parts.push(Part::Html(methods.bars()));
            parts.push(Part::Table(table));
        }
        None => parts.push(Part::Words(
            "Skipped: no recording was named, and there is none in the folder that FLOCKMAP_DATA names (hku_mb/robot1.mcap, robot2.mcap)."
                .to_owned(),
        )),
    }
    Section { id: "beyond", title: "Beyond the paper: recordings".to_owned(), parts }
}
