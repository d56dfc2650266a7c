//! A robot of the swarm with its clock, what its checkers remember, and what is counted of it.

use super::check::{Budget, Paths, Quiet, Still, Twice, Work};
use super::clock::Clock;
use super::moves::Moves;
use super::purpose;
use super::report::{RobotFigures, Seen, median_and_99};
use super::seen;
use super::settings::{MemberSettings, Settings};
use super::sim_disk::{Found, SimDisk};
use super::trouble::Boot;
use super::world::{Course, SmallWorld};
use crate::{Addressees, Datagram, Delivery, Node};
use flockmap::sync::wire::Salt;
use flockmap::{Cast, Destination, Path, Pose, Robot, RobotId, Stamp, Stream, Transmit};
use flockmap_mutation::{self as mutation, Mutation};
use flockmap_store::next_epoch;
use flockmap_worlds::IN_THE_WORLD;
use flockmap_worlds::random::Random;
use std::collections::BTreeMap;
use std::sync::Arc;

/// No robot wants anything at this time.
pub(super) const NEVER: i64 = i64::MAX;

/// What is decided of a run before it begins.
pub(super) struct Run {
    pub(super) stream: Stream,
    pub(super) salt: Salt,
    found: Option<Found>,
}

pub(super) struct Member {
    pub(super) settings: MemberSettings,
    has_paths: bool,
    pub(super) robot: Option<Robot>,
    /// When it wants to be called.
    pub(super) wake: i64,
    /// When it scans next.
    pub(super) next_scan: i64,
    course: Course,
    random: Random,
    pub(super) twice: Twice,
    pub(super) budget: Budget,
    pub(super) quiet: Quiet,
    pub(super) still: Still,
    pub(super) paths: Paths,
    pub(super) work: Work,
    figures: RobotFigures,
    pub(super) ages: Vec<i64>,
    /// Runs that this run has forgotten; whether it wants none before them either.
    pub(super) forgotten: BTreeMap<Stream, bool>,
    /// The run that flies, and the one that it replaced while flying.
    pub(super) run: Option<Stream>,
    pub(super) replaced: Option<Stream>,
    pub(super) disk: Option<SimDisk>,
    runs: Random,
    boot: Boot,
    /// Where submaps are begun and moved.
    pub(super) moves: Option<Moves>,
    /// Epochs are counted, where a run does not take its own from a clock.
    epoch: Option<u64>,
    /// Microseconds by which the clock that shows the date is behind.
    behind: i64,
    /// The datagram that it was called with, until the checkers have looked at it.
    pub(super) input: Option<Input>,
    /// To whom it sent last (`None`: to everyone), and on which path.
    pub(super) sent: (Option<RobotId>, Option<Path>),
}

/// A datagram that a robot was called with.
pub(super) struct Input {
    pub(super) bytes: Arc<[u8]>,
    /// A robot sent it, as it is.
    pub(super) is_genuine: bool,
    /// The robot took it for sound.
    pub(super) is_taken: bool,
}

/// What a clock with the date shows when a flight begins, in seconds since 1970; and what one without a
/// battery shows at each start.
const DATE_S: u64 = 1_795_000_000;
const NO_DATE_S: u64 = 12;
const HOUR: u64 = 3_600_000_000;

impl Member {
    pub(super) fn new(number: usize, settings: &Settings, world: &SmallWorld) -> Self {
        let own = settings.members[number].clone();
        let trouble = &settings.trouble;
        let seed = settings.options.seed;
        let mut random = purpose::of_robot(seed, purpose::SCANS, number);
        let course = world.course(&mut random);
        let next_scan = random.below(own.scan_period as u64) as i64;
        let disk = own.has_disk.then(|| SimDisk::new(seed, number, trouble.has_faulty_disks));
        Self {
            figures: RobotFigures { id: own.config.id.0, ..RobotFigures::default() },
            settings: own,
            has_paths: settings.has_paths,
            robot: None,
            wake: NEVER,
            next_scan,
            course,
            random,
            twice: Twice::default(),
            budget: Budget::default(),
            quiet: Quiet::default(),
            still: Still::default(),
            paths: Paths::default(),
            work: Work::default(),
            ages: Vec::new(),
            forgotten: BTreeMap::new(),
            run: None,
            replaced: None,
            disk,
            runs: purpose::of_robot(seed, purpose::RUNS, number),
            boot: trouble.boot,
            moves: trouble
                .has_submaps
                .then(|| Moves::new(purpose::of_robot(seed, purpose::SUBMAPS, number + 1))),
            epoch: (!trouble.has_epochs_of_clocks()).then_some(0),
            behind: 0,
            input: None,
            sent: (None, None),
        }
    }

    /// Takes in a datagram, on a path if addresses count.
    pub(super) fn receive(&mut self, now: Stamp, bytes: Arc<[u8]>, path: Option<Path>, is_genuine: bool) {
        let now = self.settings.clock.shows(now.0);
        let is_taken = match (&mut self.robot, path) {
            (Some(robot), Some(path)) => robot.handle_datagram_from(now, path, &bytes).is_ok(),
            (Some(robot), None) => robot.handle_datagram(now, &bytes).is_ok(),
            (None, _) => false,
        };
        self.input = Some(Input { bytes, is_genuine, is_taken });
    }

    /// Decides of a run before it begins: its epoch and its salt, as a node does.
    ///
    /// # Errors
    /// What is wrong with its disk, other than that it fails.
    pub(super) fn boot(&mut self, now: i64) -> Result<Run, String> {
        // One number for each start, whatever it is for.
        let steps = 1 + self.random.below(3);
        let _ = self.random.below(4);
        self.set_clock(now);
        let config = &self.settings.config;
        let found = self.disk.as_mut().map(|disk| disk.open(config)).transpose()?;
        let last = found.as_ref().and_then(Found::last_epoch);
        let epoch = match &mut self.epoch {
            Some(epoch) => {
                *epoch += steps;
                *epoch
            }
            None => {
                let random = self.runs.next_u64() as u32;
                next_epoch(last, self.date_s(now), random).map_err(|error| error.to_string())?
            }
        };
        let mut salt = Salt::default();
        for part in salt.chunks_exact_mut(8) {
            part.copy_from_slice(&self.runs.next_u64().to_le_bytes());
        }
        if mutation::is(Mutation::SaltRepeated) {
            salt = [0x5a; 16];
        }
        Ok(Run { stream: Stream { origin: config.id, epoch }, salt, found })
    }

    /// Begins a run: with what is on its disk, or with nothing.
    ///
    /// # Errors
    /// What a robot or its store cannot work with.
    pub(super) fn start(&mut self, now: i64, run: Run, clocks: &[(RobotId, Clock)]) -> Result<(), String> {
        let stamp = self.settings.clock.shows(now);
        let mut config = self.settings.config.clone();
        config.epoch = run.stream.epoch;
        config.session.salt = run.salt;
        let mut robot = Robot::new(config, stamp).map_err(|error| error.to_string())?;
        for (id, clock) in clocks {
            robot.set_clock_offset(*id, Some(clock.offset - self.settings.clock.offset));
        }
        if let (Some(disk), Some(found)) = (&mut self.disk, run.found) {
            disk.begin(found, &mut robot, stamp)?;
        }
        (self.robot, self.wake) = (Some(robot), now);
        (self.twice, self.budget) = (Twice::default(), Budget::default());
        (self.paths, self.work) = (Paths::default(), Work::default());
        self.forgotten.clear();
        (self.run, self.replaced) = (Some(run.stream), None);
        self.moves.iter_mut().for_each(Moves::begin_run);
        self.figures.runs += 1;
        Ok(())
    }

    /// What the clock shows from this start on.
    fn set_clock(&mut self, now: i64) {
        let clock = &mut self.settings.clock;
        let is_first = self.figures.runs == 0;
        match self.boot {
            Boot::Repeats if !is_first => *clock = clock.showing(now, clock.shows(0)),
            Boot::Rewinds if !is_first => {
                let back = self.runs.below(HOUR) as i64;
                self.behind += back;
                *clock = clock.showing(now, clock.shows(now).plus_micros(-back));
            }
            _ => {}
        }
    }

    /// The seconds since 1970, as the robot believes at a start.
    fn date_s(&self, now: i64) -> u64 {
        match self.boot {
            Boot::Repeats => NO_DATE_S,
            _ => DATE_S.saturating_add_signed((now - self.behind).div_euclid(1_000_000)),
        }
    }

    /// Notes when it wants to be called next.
    pub(super) fn note_wake(&mut self, now: i64) {
        let due = self.robot.as_ref().and_then(Robot::poll_timeout);
        self.wake = due.map_or(NEVER, |at| self.settings.clock.when(at).max(now));
    }

    /// Ends the run. What it counted is kept.
    pub(super) fn crash(&mut self, seen: &mut Seen) {
        if let Some(robot) = self.robot.take() {
            seen::add_counters(seen, &robot);
            let (session, counters) = (robot.session().counters(), robot.counters());
            self.figures.datagrams += session.out().datagrams;
            self.figures.bytes += session.out().bytes;
            self.figures.requests += session.requests_out.datagrams;
            self.figures.request_bytes += session.requests_out.bytes;
            self.figures.packages += counters.packages;
            self.figures.package_bytes += counters.package_bytes;
            self.figures.merged += counters.merged;
        }
        if let Some(disk) = &mut self.disk {
            disk.crash();
        }
        self.wake = NEVER;
    }

    /// Takes a scan.
    pub(super) fn scan(&mut self, world: &SmallWorld, now: i64) {
        let seconds = now as f64 / 1e6;
        let stamp = self.settings.clock.shows(now);
        let place = world.place(&self.course, seconds);
        let range_m = self.settings.config.mapper.range_m;
        let mut scan = world.scan(&mut self.random, place, seconds, stamp, self.settings.rays, range_m);
        let steps = self.settings.clock_steps.iter().filter(|(at, _)| *at <= now);
        scan.stamp = stamp.plus_micros(steps.map(|(_, by)| by).sum());
        if !self.settings.has_no_returns {
            scan.no_returns.clear();
        }
        if let Some(robot) = &mut self.robot {
            if let Some(moves) = &mut self.moves {
                moves.act(robot, stamp);
            }
            robot.insert_scan(stamp, &scan, &Pose::from_translation(place)).expect(IN_THE_WORLD);
        }
        self.next_scan = now + self.settings.scan_period;
    }

    pub(super) fn take_figures(&mut self, airtime_micros: u64, seen: &mut Seen) -> RobotFigures {
        self.figures.is_alive = self.robot.is_some();
        self.crash(seen);
        (self.figures.age_median_s, self.figures.age_99_s) = median_and_99(&mut self.ages);
        self.figures.airtime_s = airtime_micros as f64 / 1e6;
        self.figures.clone()
    }
}

impl Node for Member {
    fn id(&self) -> RobotId {
        self.settings.config.id
    }

    fn handle_datagram(&mut self, now: Stamp, delivery: &Delivery) {
        let path = self.has_paths.then_some(Path(delivery.from.0.into()));
        self.receive(now, Arc::clone(&delivery.bytes), path, true);
    }

    fn handle_timeout(&mut self, now: Stamp) {
        if let Some(robot) = &mut self.robot {
            robot.handle_timeout(self.settings.clock.shows(now.0));
        }
    }

    fn poll_timeout(&self) -> Option<Stamp> {
        (self.wake != NEVER).then_some(Stamp(self.wake))
    }

    fn poll_transmit(&mut self, now: Stamp) -> Option<Datagram> {
        let robot = self.robot.as_mut()?;
        let Transmit { to, path, bytes } = robot.poll_transmit(self.settings.clock.shows(now.0))?;
        let peer = match to {
            Destination::Peer(peer) => Some(peer),
            Destination::Everyone => None,
        };
        self.sent = (peer, path);
        // What goes to a path arrives there, whoever it is meant for.
        let there = path.map(|path| RobotId(u16::try_from(path.0).unwrap_or(u16::MAX)));
        let to = match (peer, self.settings.config.session.cast) {
            (Some(peer), _) => Addressees::One(there.unwrap_or(peer)),
            (None, Cast::Broadcast) => Addressees::All,
            (None, Cast::Unicast) => Addressees::Each,
        };
        Some(Datagram { to, bytes })
    }
}
