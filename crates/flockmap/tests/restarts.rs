//! Nothing is lost at the limits: restarts, crowds, ended runs with gaps, epochs that were used. Whole robots
//! over a radio that loses nothing.

#[allow(dead_code, reason = "only the scans are used here")]
mod common;

use std::collections::{BTreeMap, BTreeSet};

use common::{Random, scan};
use flockmap::grid::{Layer, epoch, seconds_of_epoch};
use flockmap::sync::SwarmKey;
use flockmap::sync::wire::SealedDatagram;
use flockmap::{
    Cast, Codec, Destination, Event, Pose, Resolution, Robot, RobotConfig, RobotId, Scan, Stamp, Stream,
};

/// Robots in reach of each other, in virtual time. A datagram arrives at once.
struct Net {
    robots: Vec<Option<Robot>>,
    now: Stamp,
    events: Vec<Vec<Event>>,
    /// Datagrams from and to these are lost.
    deaf: BTreeSet<usize>,
    /// These do not hear each other.
    apart: Option<[usize; 2]>,
    sent: Vec<(usize, Destination, Vec<u8>)>,
}

impl Net {
    fn new(robots: usize) -> Self {
        Self {
            robots: (0..robots).map(|_| None).collect(),
            now: Stamp(1_000_000),
            events: vec![Vec::new(); robots],
            deaf: BTreeSet::new(),
            apart: None,
            sent: Vec::new(),
        }
    }

    fn start(&mut self, number: usize, config: RobotConfig) {
        self.robots[number] = Some(Robot::new(config, self.now).unwrap());
    }

    /// A wall in front of a robot, at a height of its own, and the batch closed.
    fn map(&mut self, number: usize, distance: f32) {
        let robot = self.robots[number].as_mut().unwrap();
        let height = number as f32 * 0.2 - 1.0;
        let points = (0..20).map(|i| [distance, 0.1 * i as f32 - 1.0, height]).collect();
        let scan = Scan { stamp: self.now, points, no_returns: Vec::new() };
        robot.insert_scan(self.now, &scan, &Pose::IDENTITY).unwrap();
        robot.flush(self.now);
    }

    fn run(&mut self, seconds: f64) {
        let end = self.now.plus_micros((seconds * 1e6) as i64);
        loop {
            let due = self.robots.iter().flatten().filter_map(Robot::poll_timeout).min().unwrap_or(end);
            self.now = due.max(self.now.plus_micros(1_000));
            if self.now >= end {
                self.now = end;
                return;
            }
            for number in 0..self.robots.len() {
                self.drive(number);
            }
        }
    }

    fn drive(&mut self, from: usize) {
        let Some(robot) = &mut self.robots[from] else { return };
        robot.handle_timeout(self.now);
        while let Some(transmit) = self.robots[from].as_mut().and_then(|robot| robot.poll_transmit(self.now))
        {
            for to in (0..self.robots.len()).filter(|to| *to != from) {
                let is_meant = match transmit.to {
                    Destination::Everyone => true,
                    Destination::Peer(id) => id == RobotId(to as u16 + 1),
                };
                if let Some(robot) = &mut self.robots[to]
                    && is_meant
                    && !self.deaf.contains(&to)
                    && !self.deaf.contains(&from)
                    && self.apart.is_none_or(|apart| !(apart.contains(&from) && apart.contains(&to)))
                {
                    // What is wrong with it is counted.
                    let _ = robot.handle_datagram(self.now, &transmit.bytes);
                }
            }
            self.sent.push((from, transmit.to, transmit.bytes));
        }
        while let Some(event) = self.robots[from].as_mut().and_then(Robot::poll_event) {
            self.events[from].push(event);
        }
    }

    fn robot(&self, number: usize) -> &Robot {
        self.robots[number].as_ref().unwrap()
    }

    /// Pairs of which the one lacks something of the other's run.
    fn lacking(&self) -> Vec<(RobotId, Stream)> {
        let mut lacking = Vec::new();
        for other in self.robots.iter().flatten() {
            let stream = other.own_stream();
            let newest = other.session().store().newest_known(stream);
            for robot in self.robots.iter().flatten() {
                let received = robot.session().received(stream);
                if newest > 0 && !received.is_some_and(|received| received.contains_range(1, newest)) {
                    lacking.push((robot.own_stream().origin, stream));
                }
            }
        }
        lacking
    }

    /// Seconds until nobody lacks anything of a run that flies.
    fn settle(&mut self, seconds: usize) -> usize {
        for second in 0..seconds {
            if self.lacking().is_empty() {
                return second;
            }
            self.run(1.0);
        }
        panic!("after {seconds} s still lacking: {:?}", self.lacking());
    }
}

fn config(number: usize, epoch: u64) -> RobotConfig {
    let resolution = Resolution::from_metres(0.2).unwrap();
    let mut config = RobotConfig::new(RobotId(number as u16 + 1), resolution, 7.0);
    config.epoch = epoch;
    config.seed = number as u64;
    config
}

fn digest(robot: &Robot, stream: Stream) -> Option<u64> {
    robot.fusion().layer(stream).map(Layer::digest)
}

/// All stamps of a layer with the voxels that have them.
fn stamps(robot: &Robot, stream: Stream) -> BTreeMap<Stamp, usize> {
    let state = robot.fusion().layer(stream).unwrap().snapshot().unwrap();
    state.parts.iter().map(|(stamp, part)| (*stamp, part.len())).collect()
}

#[test]
fn every_live_map_arrives_however_short_the_requests_are() {
    for (robots, budget, cast) in [(5, 1_500, Cast::Unicast), (12, 600, Cast::Broadcast)] {
        let mut net = Net::new(robots);
        let with = |number: usize, epoch: u64| {
            let mut config = config(number, epoch);
            config.session.cast = cast;
            config.session.radio_bytes_per_s = Some(budget);
            config
        };
        for number in 0..robots {
            net.start(number, with(number, 1_000 + number as u64));
            net.map(number, 3.0);
        }
        net.settle(120);
        for round in 1..=3 {
            for number in 0..robots {
                net.start(number, with(number, 1_000 + 100 * round + number as u64));
                net.map(number, 3.0);
                net.run(5.0);
            }
            net.settle(120);
        }
        net.start(0, with(0, 9_000));
        net.map(0, 2.0);
        let took = net.settle(60);
        println!("{robots} robots, {budget} bytes/s, {cast:?}: the last map was everywhere after {took} s");
    }
}

#[test]
fn live_runs_take_the_places_of_ended_ones() {
    let robots = 6;
    let mut net = Net::new(robots);
    let with = |number: usize, epoch: u64| {
        let mut config = config(number, epoch);
        config.session.streams_max = 8;
        config
    };
    for round in 1..=6 {
        for number in 0..robots {
            net.start(number, with(number, round));
            net.map(number, 3.0 - 0.2 * round as f32);
            net.run(1.0);
        }
        net.settle(30);
    }
    for robot in net.robots.iter().flatten() {
        assert!(robot.session().load().streams <= 8);
        // Who was there since the last round has seen some go.
        let forgotten = robot.session().counters().streams_forgotten;
        assert!(forgotten > 0 || robot.own_stream().origin.0 as usize > robots / 2, "{forgotten}");
    }
    let reported =
        net.events.iter().flatten().filter(|event| matches!(event, Event::RunForgotten(_))).count();
    assert!(reported > 0, "what is undecodable is reported");
}

#[test]
fn a_run_whose_clock_fell_back_begins_anew_and_arrives_whole() {
    for key in [None, Some(SwarmKey::from_bytes(core::array::from_fn(|at| at as u8)))] {
        let mut net = Net::new(2);
        let with = |number: usize, seconds: u32, random: u32| {
            let mut config = config(number, epoch(seconds, random));
            config.session.swarm_key.clone_from(&key);
            config.session.salt = [random as u8 | 1; 16];
            config
        };
        net.start(1, with(1, 5, 77));
        // Four runs are kept; then the clock has lost its time, twice to the same second.
        let runs =
            [(1_000, 1), (1_100, 2), (1_200, 3), (1_300, 4), (40, 5), (40, 0x8000_0006), (40, 0x0000_0007)];
        let mut epochs = BTreeSet::new();
        for (seconds, random) in runs {
            net.start(0, with(0, seconds, random));
            let mut walls = Random(u64::from(random));
            for _ in 0..4 {
                let scan = scan(&mut walls, net.now);
                let now = net.now;
                net.robots[0].as_mut().unwrap().insert_scan(now, &scan, &Pose::IDENTITY).unwrap();
                net.run(0.7);
            }
            net.map(0, 3.0);
            let before = stamps(net.robot(0), net.robot(0).own_stream());
            net.run(2.0);
            let took = net.settle(30);
            let own = net.robot(0).own_stream();
            assert!(epochs.insert(own.epoch), "no two runs have one epoch");
            assert!(seconds_of_epoch(own.epoch) >= 1_000, "epoch {:x}", own.epoch);
            assert_eq!(
                digest(net.robot(1), own),
                digest(net.robot(0), own),
                "{seconds} s, settled in {took}"
            );
            // Nothing old looks new.
            assert_eq!(stamps(net.robot(0), own), before);
        }
        let begun = net.events[0].iter().filter(|event| matches!(event, Event::RunBegun(_))).count();
        assert_eq!(begun, 3);
    }
}

#[test]
fn a_robot_begins_anew_above_a_run_of_its_own_that_only_robots_out_of_earshot_know_of() {
    let mut net = Net::new(3);
    // A row of three.
    net.apart = Some([0, 2]);
    net.start(0, config(0, 50));
    net.start(1, config(1, 1));
    net.start(2, config(2, 1));
    net.run(5.0);
    // The clock falls back. The robot in the middle says so, heard by the far one alone, and forgets it.
    net.start(0, config(0, 20));
    net.drive(0);
    net.deaf.insert(0);
    net.run(1.0);
    net.start(1, config(1, 2));
    net.run(5.0);
    net.deaf.clear();
    let used = Stream { origin: RobotId(1), epoch: 50 };
    assert!(
        net.robot(2).session().received(used).is_some_and(|received| received.is_empty()),
        "it is known by name alone"
    );
    assert_eq!(net.robot(0).own_stream().epoch, 20);
    net.run(20.0);
    assert!(net.robot(0).own_stream() > used, "{:?}", net.robot(0).own_stream());
}

#[test]
fn runs_that_begin_at_the_same_clock_reading_share_no_nonce_and_both_maps_arrive() {
    let mut net = Net::new(2);
    let with = |number: usize, random: u32, salt: u8| {
        let mut config = config(number, epoch(10, random));
        config.session.swarm_key = Some(SwarmKey::from_bytes([9; 32]));
        config.session.salt = [salt; 16];
        config
    };
    net.start(1, with(1, 3, 99));
    let mut nonces = BTreeSet::new();
    for (random, salt) in [(500, 1), (400, 2), (600, 3)] {
        net.start(0, with(0, random, salt));
        net.map(0, 3.0);
        net.settle(20);
        for (from, to, bytes) in net.sent.drain(..).filter(|(from, ..)| *from == 0) {
            let sealed = SealedDatagram::new_checked(&bytes).unwrap();
            let recipient = match to {
                Destination::Peer(id) => Some(id),
                Destination::Everyone => None,
            };
            assert!(nonces.insert((salt, recipient, sealed.counter())), "robot {from} repeats a nonce");
        }
    }
    assert!(nonces.len() > 6, "{} datagrams", nonces.len());
}

#[test]
fn two_robots_with_one_id_do_not_outdo_each_other_without_end() {
    let mut net = Net::new(3);
    let twin = |number: usize, epoch: u64| RobotConfig { id: RobotId(1), ..config(number, epoch) };
    net.start(0, twin(0, 10));
    net.start(1, twin(1, 20));
    net.start(2, config(2, 1));
    for _ in 0..100 {
        net.map(0, 3.0);
        net.map(1, 2.0);
        net.run(6.0);
    }
    let begun: Vec<u64> = (0..2).map(|number| net.robot(number).counters().runs_begun).collect();
    assert!(begun.iter().all(|begun| *begun <= 8), "{begun:?} runs in ten minutes");
    assert!(net.events.iter().flatten().any(|event| matches!(event, Event::SameIdentity)));
}

#[test]
fn what_lies_beyond_a_gap_of_an_ended_run_reaches_a_late_joiner() {
    reaches_beyond_a_gap(60.0, &[(2, 1)]);
}

/// Nobody has a place for its new run, since that has published nothing yet.
#[test]
fn what_lies_beyond_a_gap_of_an_ended_run_reaches_its_own_robot_in_a_run_without_packages() {
    reaches_beyond_a_gap(2.0, &[(0, 2), (2, 1)]);
}

/// `joiners`: number and epoch of robots that start when the run has ended for so many seconds, and hear each
/// other.
fn reaches_beyond_a_gap(seconds: f64, joiners: &[(usize, u64)]) {
    let mut net = Net::new(3);
    let with = |number: usize, epoch: u64| {
        let mut config = config(number, epoch);
        // Each package stands by itself, so that what comes after the gap is merged; and few are stored.
        config.codec = Codec::Paper;
        config.session.store_bytes_max = 2_000;
        config
    };
    net.start(0, with(0, 1));
    net.start(1, with(1, 1));
    net.run(2.0);
    let mut walls = Random(5);
    for batch in 0..30 {
        // The robot is lost before it could repair what is missing.
        if batch == 20 {
            net.deaf.insert(1);
        } else if batch == 22 {
            net.deaf.remove(&1);
        }
        let scan = scan(&mut walls, net.now);
        let now = net.now;
        let robot = net.robots[0].as_mut().unwrap();
        robot.insert_scan(now, &scan, &Pose::IDENTITY).unwrap();
        robot.flush(now);
        net.drive(0);
        net.now = net.now.plus_micros(1_000);
    }
    let ended = net.robot(0).own_stream();
    net.robots[0] = None;
    net.run(seconds);
    let received = net.robot(1).session().received(ended).unwrap().clone();
    assert!(received.intervals().len() > 1, "{received:?} has no gap");
    assert!(net.robot(1).session().store().packages() < 20, "most are not stored any more");
    for &(number, epoch) in joiners {
        net.start(number, with(number, epoch));
    }
    net.run(90.0);
    for &(number, _) in joiners {
        assert_eq!(net.robot(number).session().received(ended), Some(&received), "robot {number}");
        assert_eq!(digest(net.robot(number), ended), digest(net.robot(1), ended));
    }
    // And then it is quiet.
    let sent = net.robot(1).session().counters().packages_out;
    net.run(60.0);
    assert_eq!(net.robot(1).session().counters().packages_out, sent);
}
