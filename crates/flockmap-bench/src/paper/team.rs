//! All methods on the records of one team of robots.

use flockmap::grid::MapperConfig;
use flockmap_cli::measure::IP_UDP_BYTES;
use flockmap_cli::measure::KB;
use flockmap_cli::progress::Progress;
use flockmap_cli::report::Report;
use flockmap_cli::sources::{Frame, Source};
use flockmap_netsim::{Link, RadioConfig};

use super::figures::{CHANGES_MAX, PUBLISH_PERIOD_S};
use super::jobs;
use super::methods::{self, MethodRow, MethodRows};
use super::settings::{batch, robot};
use super::stack::{self, Stack};
use crate::baselines::Method;
use crate::baselines::racer_code::{RacerCast, RacerConfig};
use crate::codec_run::CodecRun;
use crate::rival_swarm;

/// The name of our own stack's row.
const STACK: &str = "flockmap, whole stack";
/// The name of RACER's own session's row.
pub const RACER_CODE: &str = "racer-code";

/// Robots with their records.
pub struct Team<'a> {
    /// For progress.
    pub name: String,
    /// Of the run of our own stack, and a sentence about it.
    pub title: String,
    pub about_stack: &'static str,
    pub mapper: MapperConfig,
    pub robots: usize,
    /// The records from their beginning.
    pub open: Box<dyn Fn() -> anyhow::Result<Vec<Source>> + Sync + 'a>,
    /// So much of each record goes to the methods that relay scans, in seconds.
    pub relayed_s: f64,
    /// Whether a frame, by its number, lies within so many seconds.
    pub is_within: fn(usize, &Frame, f64) -> bool,
}

/// What came of a team.
pub struct Measured {
    pub methods: MethodRows,
    /// The run of our own stack, with pictures.
    pub stack: Option<Report>,
}

/// What one job measures.
#[derive(Clone, Copy)]
enum Task {
    Stack,
    Rival,
    /// All methods that code batches on the record of this robot.
    Robot(usize),
    /// Those that relay scans.
    Relay(usize),
}

enum Finished {
    Stack(Box<Stack>),
    Rival(MethodRow),
    Robot(CodecRun),
    Relay(CodecRun),
}

/// What is measured of a team so far.
#[derive(Default)]
struct Done {
    robots: Vec<CodecRun>,
    relays: Vec<CodecRun>,
    rival: Option<MethodRow>,
    stack: Option<Stack>,
}

/// Measures all teams. `None` for those that Ctrl-C kept from being measured.
pub fn measure(teams: &[Team<'_>], seed: u64, threads: usize) -> anyhow::Result<Vec<Option<Measured>>> {
    // The longest first, so that no core is left with one at the end.
    let mut order: Vec<(usize, Task)> = (0..teams.len()).map(|number| (number, Task::Stack)).collect();
    order.extend((0..teams.len()).map(|number| (number, Task::Rival)));
    for (number, team) in teams.iter().enumerate() {
        order.extend((0..team.robots).map(|robot| (number, Task::Robot(robot))));
        order.extend((0..team.robots).map(|robot| (number, Task::Relay(robot))));
    }
    let pieces = order.iter().map(|&(number, task)| {
        let name = match task {
            Task::Stack => "whole stack".to_owned(),
            Task::Rival => RACER_CODE.to_owned(),
            Task::Robot(robot) => format!("robot {}", robot + 1),
            Task::Relay(robot) => format!("scans relayed, robot {}", robot + 1),
        };
        (format!("{}, {name}", teams[number].name), (number, task))
    });
    let pieces = jobs::run(threads, pieces.collect(), |(number, task)| teams[number].piece(task, seed))?;
    let mut done: Vec<Done> = teams.iter().map(|_| Done::default()).collect();
    for ((number, _), piece) in order.iter().zip(pieces) {
        match piece {
            Some(Finished::Stack(stack)) => done[*number].stack = Some(*stack),
            Some(Finished::Rival(row)) => done[*number].rival = Some(row),
            Some(Finished::Robot(run)) => done[*number].robots.push(run),
            Some(Finished::Relay(run)) => done[*number].relays.push(run),
            None => {}
        }
    }
    Ok(teams.iter().zip(done).map(|(team, done)| team.measured(done)).collect())
}

impl Team<'_> {
    fn piece(&self, task: Task, seed: u64) -> anyhow::Result<Finished> {
        let mut sources = (self.open)()?;
        let mapper = &self.mapper;
        let receivers = self.robots - 1;
        Ok(match task {
            Task::Stack => Finished::Stack(Box::new(self.stack(sources, seed)?)),
            Task::Rival => Finished::Rival(rival(mapper, sources, seed)?),
            Task::Robot(robot) => {
                let source = sources.swap_remove(robot);
                Finished::Robot(codecs(source, mapper, receivers, &methods::all(), |_, _| true)?)
            }
            Task::Relay(robot) => {
                let is_within = |number, frame: &Frame| (self.is_within)(number, frame, self.relayed_s);
                let source = sources.swap_remove(robot);
                Finished::Relay(codecs(source, mapper, receivers, &methods::relays(), is_within)?)
            }
        })
    }

    fn stack(&self, sources: Vec<Source>, seed: u64) -> anyhow::Result<Stack> {
        let robot = robot(self.mapper.clone(), batch(PUBLISH_PERIOD_S, CHANGES_MAX), seed);
        stack::run(self.title.clone(), &robot, Link::default(), sources)
    }

    fn measured(&self, done: Done) -> Option<Measured> {
        if done.robots.len() < self.robots {
            return None;
        }
        let mut methods = MethodRows::of_robots(done.robots)?;
        if done.relays.len() == self.robots {
            methods.add_relays(MethodRows::of_robots(done.relays)?, self.relayed_s);
        }
        methods.add(done.rival);
        methods.add(done.stack.as_ref().map(|stack| stack.row(STACK, self.about_stack)));
        Some(Measured { methods, stack: done.stack.map(|stack| stack.report) })
    }
}

/// These methods on the record of one robot, as long as frames are wanted.
pub fn codecs(
    source: Source,
    mapper: &MapperConfig,
    receivers: usize,
    methods: &[Method],
    is_wanted: impl Fn(usize, &Frame) -> bool,
) -> anyhow::Result<CodecRun> {
    let mut run = CodecRun::new(mapper.clone(), batch(PUBLISH_PERIOD_S, CHANGES_MAX), methods, receivers);
    let progress = Progress::new("scans", source.frames_expected);
    let frames = source.frames.enumerate().take_while(|(number, frame)| is_wanted(*number, frame));
    run.record(frames.map(|(_, frame)| frame), || progress.step())?;
    Ok(run)
}

/// RACER's own session on the same frames.
fn rival(mapper: &MapperConfig, sources: Vec<Source>, seed: u64) -> anyhow::Result<MethodRow> {
    let robots = sources.len() as u16;
    let config =
        |id| RacerConfig { cast: RacerCast::Unicast, ..RacerConfig::new(id, robots, mapper.clone()) };
    let run = rival_swarm::run(sources, config, RadioConfig { seed, ..RadioConfig::default() })?;
    let agreement = run.agreement();
    let total_bytes: u64 = run.measures.iter().map(|of| of.sent.payload.total()).sum();
    let largest_second = run.measures.iter().map(|of| of.sent.payload.largest_second()).max().unwrap_or(0);
    let seconds = run.last_scan.seconds().max(1e-3);
    let percent = |voxels: u64| voxels as f64 * 100.0 / agreement.compared.known.max(1) as f64;
    Ok(MethodRow {
        name: RACER_CODE.to_owned(),
        about: format!(
            "RACER as its code does it, over a perfect radio: chunks of 200 voxels with 52 bytes of fields each, announcements every 0.1 s, a voxel published \
             once and never again, states frozen when first sent. At the end {:.2} % of the voxels are stale and {:.2} % were never sent.",
            percent(agreement.stale),
            percent(agreement.missing)
        ),
        total_bytes,
        ip_udp_bytes: run.measures.iter().map(|of| of.sent.datagrams).sum::<u64>() * IP_UDP_BYTES,
        avg_kb_s: total_bytes as f64 / KB / seconds / f64::from(robots.max(1)),
        max_kb_s: largest_second as f64 / KB,
        agreement: agreement.compared.share(),
        is_as_promised: true,
        ..MethodRow::default()
    })
}
