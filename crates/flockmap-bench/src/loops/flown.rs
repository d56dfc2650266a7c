//! A robot that maps while its poses drift, and those that get its map.

use std::path::Path;
use std::time::Duration;

use anyhow::{Context, ensure};
use flockmap::{Pose, Robot, RobotConfig, RobotId, Stamp, SubmapId};
use flockmap_cli::flight::Flight;
use flockmap_cli::options::SourceArgs;
use flockmap_cli::sources::{self, Frame, Frames, Source};
use flockmap_cli::{stop, swarm};
use flockmap_netsim::{Datagram, Delivery, IP_UDP_BYTES, RadioConfig, Watch};

use super::drift::Drift;
use crate::processor::processor_time;

/// What is flown.
pub(super) struct Plan<'a> {
    pub(super) record: &'a Path,
    pub(super) source: &'a SourceArgs,
    pub(super) range_m: f64,
    pub(super) config: RobotConfig,
    pub(super) listeners: u16,
    pub(super) radio: RadioConfig,
}

/// When submaps begin, and are put right.
#[derive(Clone, Copy)]
pub(super) struct Closures {
    pub(super) length_m: f64,
    /// So many, so far apart; the last one at the end, in steps.
    pub(super) closures: u32,
    pub(super) every_m: f64,
    pub(super) steps: u32,
}

/// Virtual time that may pass until everything has arrived, or is put right.
const SETTLE_MICROS_MAX: i64 = 600_000_000;

/// A flight, up to its last closure.
pub(super) struct Flown {
    flight: Flight<Robot>,
    watch: Calls,
    drift: Drift,
    closures: Option<Closures>,
    pub(super) way_m: f64,
    place: Option<[f64; 3]>,
    /// How far the robot had come when each submap began.
    begun: Vec<f64>,
    /// Closures so far, and how far it had come at the last one.
    closed: u32,
    closed_at: f64,
    /// When the last one began, until all robots show it.
    putting_right: Option<Stamp>,
    step_micros_max: i64,
    longest_scan: Duration,
}

/// What a closure took.
pub(super) struct Closed {
    pub(super) package_bytes: u64,
    pub(super) wire_bytes: u64,
}

/// How long calls take of a processor.
#[derive(Default)]
struct Calls {
    is_watched: bool,
    started: Option<Duration>,
    longest: Duration,
    wire_bytes: u64,
}

impl Watch<Robot> for Calls {
    fn begins(&mut self, _: Stamp, _: usize, _: &mut Robot, _: Option<&Delivery>) {
        self.started = Some(processor_time());
    }

    fn called(&mut self, _: Stamp, _: usize, robot: &mut Robot) {
        let took =
            self.started.take().map_or(Duration::ZERO, |started| processor_time().saturating_sub(started));
        if self.is_watched {
            self.longest = self.longest.max(took);
        }
        while robot.poll_event().is_some() {}
    }

    fn sent(&mut self, _: Stamp, _: usize, _: &mut Robot, datagram: &mut Datagram, _: usize) {
        self.wire_bytes += (datagram.bytes.len() + IP_UDP_BYTES) as u64;
    }
}

impl Flown {
    /// Flies to the end, and until everything has arrived. Closures come at their distances, but for the last one.
    pub(super) fn fly(plan: &Plan<'_>, drift: Drift, closures: Option<Closures>) -> anyhow::Result<Self> {
        let records = [plan.record.to_owned()];
        let mut robots = sources::open(&records, plan.source, plan.range_m, false)?.robots;
        robots.truncate(1);
        robots.extend((0..plan.listeners).map(|number| Source {
            name: format!("listener {}", number + 1),
            frames_expected: 0,
            seconds_expected: 0.0,
            frames: Frames::new(std::iter::empty()),
        }));
        let robot = |id: RobotId| Ok(Robot::new(RobotConfig { id, ..plan.config.clone() }, Stamp(0))?);
        let mut flown = Self {
            flight: Flight::new(robots, plan.radio, "scans", robot)?,
            watch: Calls::default(),
            drift,
            closures,
            way_m: 0.0,
            place: None,
            begun: vec![0.0],
            closed: 0,
            closed_at: 0.0,
            putting_right: None,
            step_micros_max: 0,
            longest_scan: Duration::ZERO,
        };
        while let Some(next) = flown.flight.next_scan() {
            flown.flight.network.step(Some(next), &mut flown.watch);
            flown.scan()?;
            flown.note_shown();
        }
        for number in 0..flown.flight.network.nodes().len() {
            flown.flight.network.call(number, &mut flown.watch, Robot::flush);
        }
        flown.settle(|robots| swarm::has_everything(robots) && is_shown(robots))?;
        flown.note_shown();
        Ok(flown)
    }

    /// The robot that maps.
    pub(super) fn first(&self) -> &Robot {
        &self.flight.network.nodes()[0]
    }

    /// One that gets its map.
    pub(super) fn listener(&self) -> &Robot {
        &self.flight.network.nodes()[1]
    }

    pub(super) fn submaps(&self) -> usize {
        self.begun.len()
    }

    pub(super) fn step_s_max(&self) -> f64 {
        self.step_micros_max as f64 / 1e6
    }

    pub(super) fn longest_call_s(&self) -> f64 {
        self.watch.longest.as_secs_f64()
    }

    pub(super) fn longest_scan_s(&self) -> f64 {
        self.longest_scan.as_secs_f64()
    }

    /// Whether every robot has all submaps of the first one where that has put them.
    pub(super) fn is_right(&self) -> bool {
        same_poses(self.flight.network.nodes())
    }

    /// Puts right all of the way, a step after the other, each when the one before is shown on every robot.
    pub(super) fn close_last(&mut self) -> anyhow::Result<Closed> {
        let (packages, wire) = (self.first().counters().package_bytes, self.watch.wire_bytes);
        let steps = self.closures.map_or(1, |closures| closures.steps);
        for step in 1..=steps {
            self.put_right(f64::from(step) / f64::from(steps))?;
            self.flight.network.call(0, &mut self.watch, Robot::handle_timeout);
            self.settle(is_shown)?;
            self.note_shown();
        }
        Ok(Closed {
            package_bytes: self.first().counters().package_bytes - packages,
            wire_bytes: self.watch.wire_bytes - wire,
        })
    }

    /// Maps what is due; begins submaps, and closes loops.
    fn scan(&mut self) -> anyhow::Result<()> {
        let mut frames: Vec<(Stamp, Frame)> = Vec::new();
        self.flight.scan_due(|_, _, now, frame| {
            frames.push((now, frame));
            Ok(())
        })?;
        for (now, frame) in frames {
            let at = frame.pose.translation();
            let before = self.place.replace(at).unwrap_or(at);
            self.way_m += before.iter().zip(at).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
            if let Some(Closures { length_m, every_m, closures, .. }) = self.closures {
                if self.begun.last().is_some_and(|begun| self.way_m - begun >= length_m) {
                    self.flight.network.nodes_mut()[0].begin_submap(now)?;
                    self.begun.push(self.way_m);
                }
                // That at the end is the last one.
                let next = self.closed + 1;
                if next < closures && self.way_m >= every_m * f64::from(next) {
                    self.put_right(1.0)?;
                    (self.closed, self.closed_at) = (next, self.way_m);
                }
            }
            let robot = &mut self.flight.network.nodes_mut()[0];
            let corrected = robot.submap_pose(robot.submap()).compose(&self.drift.at(self.way_m));
            for mate in &frame.team_mates {
                let id = RobotId(mate.number as u16 + 1);
                robot.set_teammate(id, corrected.transform(mate.position), now)?;
            }
            let started = processor_time();
            robot.insert_scan(now, &frame.scan, &corrected.compose(&frame.pose))?;
            if self.watch.is_watched {
                self.longest_scan = self.longest_scan.max(processor_time().saturating_sub(started));
            }
        }
        Ok(())
    }

    /// Takes this share of the drift back that the submaps since the last closure have.
    fn put_right(&mut self, share: f64) -> anyhow::Result<()> {
        let now = self.flight.network.now();
        let ends = self.begun.iter().skip(1).copied().chain([self.way_m]);
        let spans: Vec<(f64, f64)> = self.begun.iter().copied().zip(ends).collect();
        for (number, (begun, end)) in
            spans.into_iter().enumerate().filter(|(_, (_, end))| *end > self.closed_at)
        {
            let submap = u16::try_from(number).ok().and_then(SubmapId::new).context("too many submaps")?;
            let pose = self.drift.part(share).at((begun + end) / 2.0).inverse();
            self.flight.network.nodes_mut()[0].set_submap_pose(now, submap, &pose)?;
        }
        self.putting_right.get_or_insert(now);
        self.watch.is_watched = true;
        Ok(())
    }

    /// The step is over when all robots show it.
    fn note_shown(&mut self) {
        if let Some(began) = self.putting_right.filter(|_| is_shown(self.flight.network.nodes())) {
            self.step_micros_max = self.step_micros_max.max(self.flight.network.now().micros_since(began));
            self.putting_right = None;
            self.watch.is_watched = false;
        }
    }

    fn settle(&mut self, is_done: impl Fn(&[Robot]) -> bool) -> anyhow::Result<()> {
        let until = self.flight.network.now().plus_micros(SETTLE_MICROS_MAX);
        let arrived = self.flight.settle(until, &mut self.watch, is_done);
        ensure!(!stop::requested(), "interrupted");
        arrived.context("not everything had arrived ten minutes later").map(drop)
    }
}

/// Whether all robots show the submaps of the first one where it has put them.
fn is_shown(robots: &[Robot]) -> bool {
    same_poses(robots) && robots.iter().all(|robot| !robot.is_rebuilding())
}

fn same_poses(robots: &[Robot]) -> bool {
    let Some(first) = robots.first() else { return true };
    let stream = first.own_stream();
    let submaps = || (0..=first.submap().number()).filter_map(SubmapId::new);
    let pose = |robot: &Robot, submap| -> Pose { robot.fusion().submap_pose(stream, submap) };
    robots.iter().all(|robot| submaps().all(|submap| pose(robot, submap) == first.submap_pose(submap)))
}
