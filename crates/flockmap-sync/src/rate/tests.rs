//! Robots that share a medium, each with a rate of its own.

use super::*;
use crate::rate::sent_log::{LOG_GRAIN, LOG_MAX};
use model::Robot;
use std::collections::VecDeque;

const STEP: i64 = 10_000;
const BYTES: usize = 600;

/// Of each robot so many bytes wait at the most; what comes on top is lost.
const QUEUE_BYTES: usize = 16 << 10;

/// A medium that carries so many bytes a second, one datagram after the other.
struct Medium {
    bytes_per_s: i64,
    busy_until: i64,
    /// Who sent, when, when it arrives.
    in_flight: VecDeque<(usize, Stamp, i64)>,
}

struct Swarm {
    medium: Medium,
    robots: Vec<Robot>,
    /// Bytes a second that each would send.
    wants: Vec<u64>,
    now: i64,
    arrived: Vec<u64>,
    waited_most: i64,
}

impl Swarm {
    fn new(robots: usize, bytes_per_s: i64, wants: u64) -> Self {
        Self {
            medium: Medium { bytes_per_s, busy_until: 0, in_flight: VecDeque::new() },
            robots: (0..robots).map(Robot::new).collect(),
            wants: vec![wants; robots],
            now: 0,
            arrived: vec![0; robots],
            waited_most: 0,
        }
    }

    fn run(&mut self, seconds: i64) {
        self.arrived.fill(0);
        self.waited_most = 0;
        for _ in 0..seconds * SECOND / STEP {
            self.now += STEP;
            self.step();
        }
    }

    fn step(&mut self) {
        let count = self.robots.len();
        for number in (0..count).map(|k| (k + (self.now / STEP) as usize) % count) {
            let robot = &mut self.robots[number];
            let now = robot.now(self.now);
            while robot.sent < self.wants[number] * self.now as u64 / SECOND as u64
                && robot.rate.wait(now, BYTES).is_none()
            {
                robot.rate.spend(now, BYTES);
                robot.sent += BYTES as u64;
                let waiting = self.medium.in_flight.iter().filter(|(from, ..)| *from == number).count();
                if waiting * BYTES > QUEUE_BYTES {
                    continue;
                }
                let takes = BYTES as i64 * SECOND / self.medium.bytes_per_s;
                self.medium.busy_until = self.medium.busy_until.max(self.now) + takes;
                self.medium.in_flight.push_back((number, now, self.medium.busy_until + 20_000));
            }
        }
        while let Some((from, sent, at)) = self.medium.in_flight.pop_front_if(|(.., at)| *at <= self.now) {
            self.arrived[from] += BYTES as u64;
            self.waited_most = self.waited_most.max(at - (sent.0 - self.robots[from].clock));
            for to in (0..count).filter(|to| *to != from) {
                let robot = &mut self.robots[to];
                robot.hear((self.now, at), from, sent, BYTES);
                let now = robot.now(self.now);
                robot.rate.review(now, count - 1, true);
            }
        }
        // Each tells one other what came, in turn.
        if self.now % (SECOND / 10) == 0 {
            let teller = (self.now / (SECOND / 10)) as usize % count;
            for (about, arrival) in core::mem::take(&mut self.robots[teller].untold) {
                let robot = &mut self.robots[about];
                robot.be_told(self.now, teller, arrival);
                let now = robot.now(self.now);
                robot.rate.review(now, count - 1, true);
            }
        }
    }
}

#[test]
fn robots_that_share_a_thin_radio_find_what_it_carries_and_share_it() {
    for (robots, bytes_per_s) in [(2, 6_250), (5, 6_250), (20, 6_250), (5, 125_000), (20, 125_000)] {
        let mut swarm = Swarm::new(robots, bytes_per_s, 1_000_000);
        swarm.run(120);
        swarm.run(60);
        let arrived: u64 = swarm.arrived.iter().sum();
        let used = arrived as f64 / 60.0 / bytes_per_s as f64;
        let [least, most] = [swarm.arrived.iter().min(), swarm.arrived.iter().max()].map(|all| *all.unwrap());
        let case = format!("{robots} robots, {bytes_per_s} bytes/s");
        println!("{case}: {used:.2} used, {least} to {most} bytes, {} ms waited", swarm.waited_most / 1_000);
        assert!(used > 0.7, "{case}: {used:.2} of it used");
        assert!(swarm.waited_most < 10 * SECOND, "{case}: {} ms waited", swarm.waited_most / 1_000);
        assert!(least > 0 && most < 6 * least, "{case}: {least} to {most} bytes");
    }
}

#[test]
fn a_radio_that_carries_more_than_is_sent_slows_nobody_down() {
    for wants in [1_000, 20_000, 100_000] {
        let mut swarm = Swarm::new(4, 1_000_000, wants);
        swarm.run(60);
        assert!(swarm.robots.iter().all(|robot| robot.rate.in_slow_start()), "{wants}");
        assert!(swarm.waited_most < SECOND / 10, "{wants}: {} ms", swarm.waited_most / 1_000);
    }
}

#[test]
fn who_sends_more_and_more_is_let() {
    let mut swarm = Swarm::new(2, 20_000_000, 4_000_000);
    swarm.run(20);
    assert!(swarm.robots.iter().all(|robot| robot.rate.bytes_per_s() > 3_000_000));
}

#[test]
fn a_rate_goes_up_again_when_others_fall_silent() {
    let mut swarm = Swarm::new(10, 20_000, 1_000_000);
    swarm.run(60);
    let before = swarm.robots[0].rate.bytes_per_s();
    assert!(before < 12_000, "{before}");
    swarm.wants[1..].fill(0);
    swarm.run(60);
    let after = swarm.robots[0].rate.bytes_per_s();
    assert!(after > 2 * before || after > 15_000, "{before}, then {after} bytes/s");
}

#[test]
fn stamps_that_make_no_sense_do_no_harm() {
    let ends = [Stamp(i64::MIN), Stamp(-1), Stamp(0), Stamp(1), Stamp(i64::MAX)];
    let mut rate = Rate::new();
    let (mut waiting, mut before) = (QueueingDelays::default(), None);
    for now in ends {
        for sent in ends {
            for arrived in ends {
                waiting.sample_from(now, sent.micros_since(arrived));
                let waited = waiting.sample_to(now, arrived.micros_since(sent));
                let arrival = Arrival { sent, arrived };
                let before_it = Some((sent, arrived));
                rate.note_heard(now, Heard { bytes: 1_228, sent: now, before: before_it, queued: waited });
                rate.note_outcome(now, sent, true);
                rate.note_arrival(now, arrival, before.replace(arrival), waited);
                rate.review(now, usize::MAX >> 2, true);
                rate.review(now, usize::MAX >> 2, false);
                assert!((BYTES_PER_S_MIN..=BYTES_PER_S_MAX).contains(&rate.bytes_per_s()));
            }
        }
    }
}

fn arrival(sent: i64, now: i64) -> Arrival {
    Arrival { sent: Stamp(sent), arrived: Stamp(now) }
}

/// Sends full datagrams until the rate says wait for an echo; how many.
fn send_all(rate: &mut Rate, now: Stamp) -> u64 {
    let mut sent = 0;
    while rate.wait_for_echo(now, 1_000, 1).is_none() {
        rate.spend(now, 1_000);
        sent += 1;
    }
    sent
}

#[test]
fn what_is_out_without_an_echo_is_little_at_first_and_grows_by_what_has_arrived() {
    let mut rate = Rate::new();
    assert_eq!(send_all(&mut rate, Stamp(0)), 8);
    assert!(rate.is_echo_wanted(1_000));
    for round in 0..5 {
        let at = round * 100_000;
        rate.note_arrival(Stamp(at + 50_000), arrival(at, at + 20_000), None, None);
        assert_eq!(send_all(&mut rate, Stamp(at + 100_000)), 16 << round);
    }
}

#[test]
fn of_a_crowd_each_has_little_out_without_an_echo_unless_others_hardly_queue() {
    let out_max = |rate: &Rate, peers| {
        (1..).map(|n| n * 100).find(|bytes| rate.wait_for_echo(Stamp(0), *bytes, peers).is_some()).unwrap()
            - 100
    };
    let mut rate = Rate::new();
    assert_eq!([8, 10, 49].map(|peers| out_max(&rate, peers)), [8_000, 3_200, 1_300]);
    let heard = |queued| Heard {
        bytes: 100,
        sent: Stamp(0),
        before: None,
        queued: Some(Queued { beyond_base: queued, all: queued }),
    };
    rate.note_heard(Stamp(0), heard(20_000));
    assert_eq!(out_max(&rate, 49), 8_000);
    (0..8).for_each(|_| rate.note_heard(Stamp(0), heard(SECOND)));
    assert_eq!(out_max(&rate, 49), 1_300);
}

#[test]
fn where_nobody_says_what_has_arrived_a_datagram_a_second_goes_on() {
    let mut rate = Rate::new();
    send_all(&mut rate, Stamp(0));
    let sent: u64 = (1..=60).map(|second| send_all(&mut rate, Stamp(second * SECOND))).sum();
    assert!((60..=80).contains(&sent), "{sent}");
    // What is said of long ago is as good as nothing new.
    rate.note_arrival(Stamp(61 * SECOND), arrival(0, 0), None, None);
    assert!(send_all(&mut rate, Stamp(62 * SECOND)) > 0);
    assert!(send_all(&mut rate, Stamp(64 * SECOND)) > 0);
}

#[test]
fn the_log_of_what_was_sent_reaches_back_for_hours_in_little_memory() {
    let mut log = SentLog::default();
    for tick in 0..200_000 {
        log.add(Stamp(tick * LOG_GRAIN), 10);
        assert!(log.points.len() <= LOG_MAX);
    }
    let now = 199_999 * LOG_GRAIN;
    for (age, off) in [(SECOND, 20), (10 * SECOND, 140), (600 * SECOND, 8_000), (3_600 * SECOND, 48_000)] {
        let bytes = log.upto(Stamp(now - age)).unwrap() as i64;
        let exact = (now - age) / LOG_GRAIN * 10 + 10;
        assert!((exact - off..=exact).contains(&bytes), "{age}: {bytes} of {exact}");
    }
}

#[test]
fn a_radio_seems_full_where_nothing_sent_lately_is_known_to_have_arrived() {
    let seconds = |s: i64| Stamp(s * SECOND);
    let mut rate = Rate::new();
    rate.spend(seconds(0), 1_000);
    assert!(rate.seems_free(seconds(9)), "some requests without an echo");
    rate.spend(seconds(9), 3_000);
    assert!(!rate.seems_free(seconds(9)));
    rate.note_arrival(seconds(10), arrival(8_500_000, 8_700_000), None, None);
    assert!(rate.seems_free(seconds(10)), "something was sent 1.5 s ago, and has arrived");
    assert!(!rate.seems_free(seconds(11)));
    let heard = |all| Heard {
        bytes: 100,
        sent: seconds(0),
        before: None,
        queued: Some(Queued { beyond_base: 0, all }),
    };
    rate.note_heard(seconds(11), heard(3 * SECOND));
    assert!(!rate.seems_free(seconds(11)));
    rate.note_heard(seconds(12), heard(50_000));
    assert!(rate.seems_free(seconds(12)), "a datagram hardly queued");
    assert!(!rate.seems_free(seconds(15)));
}
