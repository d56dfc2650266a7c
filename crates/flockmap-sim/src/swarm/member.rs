//! A robot of the swarm with its clock, what its checkers remember, and what is counted of it.

use super::check::{Budget, Quiet, Still, Twice};
use super::datagram::salt_of;
use super::report::{RobotFigures, median_and_99};
use super::settings::{MemberSettings, Settings, purpose};
use super::world::{Course, SmallWorld};
use crate::IN_THE_WORLD;
use crate::random::Random;
use flockmap::sync::Counters;
use flockmap::{Package, Pose, Robot, RobotCounters, RobotError, RobotId, Stream};

/// No robot wants anything at this time.
pub(super) const NEVER: i64 = i64::MAX;

pub(super) struct Member {
    pub(super) settings: MemberSettings,
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
    pub(super) figures: RobotFigures,
    pub(super) ages: Vec<i64>,
    epoch: u64,
    /// What it stored, where robots have a disk.
    disk: Vec<Package>,
}

impl Member {
    pub(super) fn new(number: usize, settings: &Settings, world: &SmallWorld) -> Self {
        let own = settings.members[number].clone();
        let seed = settings.options.seed;
        let mut random = Random::new(seed, purpose::SCANS + ((number as u64) << 32));
        let course = world.course(&mut random);
        let next_scan = random.below(own.scan_period as u64) as i64;
        Self {
            figures: RobotFigures { id: own.config.id.0, ..RobotFigures::default() },
            settings: own,
            robot: None,
            wake: NEVER,
            next_scan,
            course,
            random,
            twice: Twice::default(),
            budget: Budget::default(),
            quiet: Quiet::default(),
            still: Still::default(),
            ages: Vec::new(),
            epoch: 0,
            disk: Vec::new(),
        }
    }

    pub(super) fn id(&self) -> RobotId {
        self.settings.config.id
    }

    /// Begins a run: with what is on its disk, or with nothing.
    pub(super) fn start(
        &mut self,
        now: i64,
        others: &[(RobotId, super::clock::Clock)],
    ) -> Result<(), RobotError> {
        self.epoch += 1 + self.random.below(3);
        let mut config = self.settings.config.clone();
        config.epoch = self.epoch;
        config.session.salt = salt_of(Stream { origin: config.id, epoch: config.epoch });
        let mut robot = Robot::new(config, self.settings.clock.shows(now))?;
        for (other, clock) in others {
            let offset = clock.offset - self.settings.clock.offset;
            robot.set_clock_offset(*other, Some(offset));
        }
        // The last cycle may not have come to the disk.
        let torn = self.random.below(4) as usize;
        self.disk.truncate(self.disk.len().saturating_sub(torn));
        for package in &self.disk {
            // For some there may be no room.
            let _ = robot.restore(self.settings.clock.shows(now), package.clone());
        }
        (self.robot, self.wake) = (Some(robot), now);
        (self.twice, self.budget) = (Twice::default(), Budget::default());
        self.figures.runs += 1;
        Ok(())
    }

    /// Stores packages, if it has a disk.
    pub(super) fn keep(&mut self, packages: &[Package]) {
        if self.settings.has_disk {
            self.disk.extend_from_slice(packages);
        }
    }

    /// Ends the run. What it counted is kept.
    pub(super) fn crash(&mut self, counts: &mut impl FnMut(&Robot)) {
        if let Some(robot) = self.robot.take() {
            counts(&robot);
            self.note_counters(robot.session().counters(), robot.counters());
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
        if !self.settings.has_no_returns {
            scan.no_returns.clear();
        }
        if let Some(robot) = &mut self.robot {
            robot.insert_scan(stamp, &scan, &Pose::from_translation(place)).expect(IN_THE_WORLD);
        }
        self.next_scan = now + self.settings.scan_period;
    }

    fn note_counters(&mut self, session: &Counters, robot: &RobotCounters) {
        self.figures.datagrams += session.out().datagrams;
        self.figures.bytes += session.out().bytes;
        self.figures.requests += session.requests_out.datagrams;
        self.figures.request_bytes += session.requests_out.bytes;
        self.figures.packages += robot.packages;
        self.figures.package_bytes += robot.package_bytes;
        self.figures.merged += robot.merged;
    }

    pub(super) fn take_figures(
        &mut self,
        airtime_micros: u64,
        counts: &mut impl FnMut(&Robot),
    ) -> RobotFigures {
        self.figures.is_alive = self.robot.is_some();
        self.crash(counts);
        (self.figures.age_median_s, self.figures.age_99_s) = median_and_99(&mut self.ages);
        self.figures.airtime_s = airtime_micros as f64 / 1e6;
        self.figures.clone()
    }
}
