//! Robots beside cross traffic that knows nothing of them, in one queue for all.

use super::*;
use model::Robot;
use std::collections::VecDeque;

const STEP: i64 = 5_000;
const BYTES: usize = 600;
const DELAY: i64 = 20_000;

/// What else goes through the same queue.
#[derive(Clone, Copy, PartialEq, Debug)]
enum CrossTraffic {
    Nothing,
    /// So many bytes a second, whatever becomes of them.
    Constant(i64),
    /// As much as is not lost: halves its window (or takes seven tenths of it) once per round trip with a loss.
    Tcp {
        left: f64,
    },
}

#[derive(Clone, Copy, PartialEq)]
enum From {
    Robot { from: usize, to: usize },
    CrossTraffic(u64),
}

/// A window of packets, of which one arrives after the other or is lost.
#[derive(Debug)]
struct Tcp {
    window: f64,
    threshold: f64,
    next: u64,
    /// Number, when sent.
    out: Vec<(u64, i64)>,
    recovers_at: u64,
    round_trip: i64,
    backoff: u32,
}

const PACKET: usize = 1_500;

impl Tcp {
    fn new() -> Self {
        Self {
            window: 10.0,
            threshold: 1e9,
            next: 0,
            out: vec![],
            recovers_at: 0,
            round_trip: 500_000,
            backoff: 0,
        }
    }

    fn acked(&mut self, now: i64, number: u64, left: f64) {
        if let Some(&(_, sent)) = self.out.iter().find(|(out, _)| *out == number) {
            self.round_trip = (7 * self.round_trip + (now - sent)) / 8;
            self.backoff = 0;
        }
        let before = self.out.len();
        self.out.retain(|(out, _)| *out > number);
        // The queue keeps the order: what was sent before and did not come is lost.
        if before > self.out.len() + 1 {
            self.lose(number, left);
        }
        self.window += if self.window < self.threshold { 1.0 } else { 1.0 / self.window };
        self.window = self.window.min(200.0);
    }

    fn lose(&mut self, number: u64, left: f64) {
        if number >= self.recovers_at {
            self.window = (self.window * left).max(2.0);
            (self.threshold, self.recovers_at) = (self.window, self.next);
        }
    }

    /// How many packets go out now.
    fn poll(&mut self, now: i64) -> u64 {
        let timeout = (2 * self.round_trip).max(200_000) << self.backoff.min(6);
        if self.out.first().is_some_and(|(_, sent)| now - sent > timeout) {
            self.out.clear();
            (self.threshold, self.window) = ((self.window / 2.0).max(2.0), 1.0);
            (self.backoff, self.recovers_at) = (self.backoff + 1, self.next);
        }
        (self.window as u64).saturating_sub(self.out.len() as u64)
    }
}

struct Link {
    is_broadcast: bool,
    bytes_per_s: i64,
    queue_bytes: i64,
    busy_until: i64,
    in_flight: VecDeque<(From, usize, Stamp, i64)>,
    cross_traffic: CrossTraffic,
    tcp: Tcp,
    cross_sent: i64,
    robots: Vec<Robot>,
    /// Whom each sends to next, by unicast.
    receivers: Vec<usize>,
    /// Own datagrams of each, and whether they were lost, as far as it does not know yet.
    outcomes: Vec<Vec<(Stamp, bool)>>,
    now: i64,
    /// Bytes that arrived of the robots, and of cross traffic.
    ours: u64,
    theirs: u64,
}

impl Link {
    fn new(robots: usize, is_broadcast: bool, bytes_per_s: i64, queue_bytes: i64) -> Self {
        Self {
            is_broadcast,
            bytes_per_s,
            queue_bytes,
            busy_until: 0,
            in_flight: VecDeque::new(),
            cross_traffic: CrossTraffic::Nothing,
            tcp: Tcp::new(),
            cross_sent: 0,
            robots: (0..robots).map(Robot::new).collect(),
            receivers: (0..robots).collect(),
            outcomes: vec![vec![]; robots],
            now: 0,
            ours: 0,
            theirs: 0,
        }
    }

    fn run(&mut self, seconds: i64) {
        (self.ours, self.theirs) = (0, 0);
        for _ in 0..seconds * SECOND / STEP {
            self.now += STEP;
            self.step();
        }
    }

    /// Whether there was place in the queue.
    fn enqueue(&mut self, from: From, bytes: usize, sent: Stamp) -> bool {
        let waiting = (self.busy_until - self.now).max(0) * self.bytes_per_s / SECOND;
        if waiting + bytes as i64 > self.queue_bytes {
            return false;
        }
        self.busy_until = self.busy_until.max(self.now) + bytes as i64 * SECOND / self.bytes_per_s;
        self.in_flight.push_back((from, bytes, sent, self.busy_until + DELAY));
        true
    }

    fn step(&mut self) {
        match self.cross_traffic {
            CrossTraffic::Nothing => {}
            CrossTraffic::Constant(rate) => {
                self.cross_sent += rate * STEP / SECOND;
                while self.cross_sent >= PACKET as i64 {
                    self.cross_sent -= PACKET as i64;
                    self.enqueue(From::CrossTraffic(0), PACKET, Stamp(self.now));
                }
            }
            CrossTraffic::Tcp { .. } => {
                for _ in 0..self.tcp.poll(self.now) {
                    let number = self.tcp.next;
                    self.tcp.next += 1;
                    self.tcp.out.push((number, self.now));
                    self.enqueue(From::CrossTraffic(number), PACKET, Stamp(self.now));
                }
            }
        }
        let count = self.robots.len();
        let first = (self.now / STEP) as usize;
        for number in (0..count).map(|k| (k + first) % count) {
            let now = self.robots[number].now(self.now);
            while self.robots[number].rate.wait(now, BYTES).is_none()
                && self.robots[number].rate.wait_for_echo(now, BYTES, 1).is_none()
            {
                let robot = &mut self.robots[number];
                // Before anything else each says hello.
                let is_hello = self.now < 5 * SECOND;
                let hellos = self.now / (SECOND / 2) * 100;
                if is_hello && robot.sent as i64 > hellos
                    || robot.sent as i64 > self.now / SECOND * 4 * self.bytes_per_s + (1 << 20)
                {
                    break;
                }
                let bytes = if is_hello { 100 } else { BYTES };
                robot.rate.spend(now, bytes);
                robot.sent += bytes as u64;
                let next = (self.receivers[number] + 1) % count;
                let to = if next == number { (next + 1) % count } else { next };
                self.receivers[number] = to;
                if !self.enqueue(From::Robot { from: number, to }, bytes, now) {
                    self.outcomes[number].push((now, true));
                }
            }
        }
        while let Some((from, bytes, sent, at)) = self.in_flight.pop_front_if(|(.., at)| *at <= self.now) {
            match from {
                From::CrossTraffic(number) => {
                    self.theirs += bytes as u64;
                    if let CrossTraffic::Tcp { left } = self.cross_traffic {
                        self.tcp.acked(self.now, number, left);
                    }
                }
                From::Robot { from, to } => {
                    self.ours += bytes as u64;
                    self.outcomes[from].push((sent, false));
                    for to in (0..count).filter(|&k| k != from && (self.is_broadcast || k == to)) {
                        let robot = &mut self.robots[to];
                        robot.hear((self.now, at), from, sent, bytes);
                        let now = robot.now(self.now);
                        robot.rate.review(now, count - 1, self.is_broadcast);
                    }
                }
            }
        }
        // Each tells one other what came, in turn.
        if self.now % (SECOND / 5) == 0 {
            let teller = (self.now / (SECOND / 5)) as usize % count;
            for (about, arrival) in core::mem::take(&mut self.robots[teller].untold) {
                let robot = &mut self.robots[about];
                robot.be_told(self.now, teller, arrival);
                let now = robot.now(self.now);
                // That something is lost shows when something later has arrived.
                let is_known = |(sent, _): &mut (Stamp, bool)| *sent <= arrival.sent;
                for (sent, is_lost) in self.outcomes[about].extract_if(.., is_known).collect::<Vec<_>>() {
                    robot.rate.note_outcome(now, sent, is_lost);
                }
                robot.rate.review(now, count - 1, self.is_broadcast);
            }
        }
    }
}

/// Asserts the shares of the link in two minutes: of the robots, and of cross traffic that begins so many seconds after
/// them.
fn assert_shares(
    robots: usize,
    is_broadcast: bool,
    (bytes_per_s, queue_ms): (i64, i64),
    cross_traffic: CrossTraffic,
    after: i64,
) {
    let mut link = Link::new(robots, is_broadcast, bytes_per_s, bytes_per_s * queue_ms / 1_000);
    link.run(after);
    link.cross_traffic = cross_traffic;
    link.run(120);
    let all = (bytes_per_s * 120) as f64;
    let (ours, theirs) = (link.ours as f64 / all, link.theirs as f64 / all);
    let cast = if is_broadcast { "broadcast" } else { "unicast" };
    let case = format!(
        "{robots} robots, {cast}, {bytes_per_s} bytes/s, a queue of {queue_ms} ms, {cross_traffic:?} after {after} s: \
         robots {ours:.2}, cross traffic {theirs:.2} of the link"
    );
    println!("{case}");
    assert!(ours >= 0.25 && theirs >= 0.4, "{case}");
}

const SWARMS: [(usize, bool); 4] = [(2, false), (5, false), (2, true), (5, true)];

#[test]
fn cross_traffic_that_comes_later_gets_two_fifths_of_the_link_and_leaves_a_quarter() {
    for (robots, is_broadcast) in SWARMS {
        for link in [(6_250, 2_000), (6_250, 2_500), (62_500, 300), (62_500, 2_500)] {
            let tcp = [0.7, 0.5].map(|left| CrossTraffic::Tcp { left });
            let constant = [7, 10].map(|tenths| CrossTraffic::Constant(link.0 * tenths / 10));
            for cross_traffic in tcp.into_iter().chain(constant) {
                assert_shares(robots, is_broadcast, link, cross_traffic, 30);
            }
        }
    }
}

#[test]
fn cross_traffic_that_was_there_before_gets_two_fifths_of_the_link_and_leaves_a_quarter() {
    for (robots, is_broadcast) in SWARMS {
        assert_shares(robots, is_broadcast, (62_500, 300), CrossTraffic::Constant(62_500 * 7 / 10), 0);
        assert_shares(robots, is_broadcast, (62_500, 2_500), CrossTraffic::Constant(62_500 / 2), 0);
        // The base delays never showed an empty queue: it is in the round trips.
        assert_shares(robots, is_broadcast, (6_250, 2_000), CrossTraffic::Tcp { left: 0.7 }, 0);
    }
    assert_shares(5, true, (62_500, 2_500), CrossTraffic::Tcp { left: 0.7 }, 0);
}
