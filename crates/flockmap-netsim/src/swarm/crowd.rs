//! A thin radio with cross traffic, which carries less than the robots would send. Nobody tells them what it carries, or
//! they have tiny budgets. It is measured how much of it brings something new.

use super::preset::BUDGET_MIN;
use super::purpose;
use super::truth::{Published, Truth};
use crate::{IP_UDP_BYTES, RadioConfig};
use flockmap::sync::IntervalSet;
use flockmap::{Cast, Robot, RobotId, SessionConfig};
use flockmap_worlds::random::Random;
use std::collections::BTreeSet;

/// Bytes of a datagram of cross traffic.
const CROSS_TRAFFIC_BYTES: usize = 1_400;
/// Share of what the radio carries for the robots that new bytes are to take, in per cent.
const NEW_MIN: u64 = 60;
/// Much is missing if the radio needs so many seconds for it.
const MUCH: u64 = 5;
/// Bytes of a datagram beside its package.
const HEADER_BYTES: u64 = 57;

/// What is drawn.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Crowd {
    /// Bytes that the radio carries in a second.
    pub(super) rate_bytes_per_s: u32,
    queue_bytes_max: usize,
    airtime_overhead_micros: i64,
    /// Share of it that cross traffic takes, 0 … 1.
    cross_traffic: f64,
    /// Bytes that each robot may send in a second.
    budget_bytes_per_s: Option<u32>,
}

impl Crowd {
    pub(super) fn draw(seed: u64, share: f64) -> Option<Self> {
        let mut random = Random::new(seed, purpose::CROWD);
        random.happens(share).then(|| Self {
            rate_bytes_per_s: (300.0 * 40_f64.powf(random.unit())) as u32,
            queue_bytes_max: (4 + random.below(28) as usize) << 10,
            airtime_overhead_micros: if random.happens(0.5) { random.below(10_000) as i64 } else { 0 },
            cross_traffic: if random.happens(0.5) { random.range(0.05, 0.5) } else { 0.0 },
            budget_bytes_per_s: random.happens(0.25).then(|| BUDGET_MIN + random.below(480) as u32),
        })
    }

    pub(super) fn radio(&self, radio: RadioConfig) -> RadioConfig {
        RadioConfig {
            rate_bytes_per_s: Some(self.rate_bytes_per_s),
            queue_bytes_max: self.queue_bytes_max,
            airtime_overhead_micros: self.airtime_overhead_micros,
            is_shared: true,
            ..radio
        }
    }

    pub(super) fn limit(&self, session: &mut SessionConfig) {
        (session.radio_bytes_per_s, session.link_bytes_per_s) = (self.budget_bytes_per_s, None);
    }

    /// Bytes a second that so many robots may send, and it carries for them.
    pub(super) fn can_send(&self, robots: usize) -> u32 {
        let budgets = self.budget_bytes_per_s.map(|budget| budget.saturating_mul(robots as u32));
        self.for_robots().min(budgets.unwrap_or(u32::MAX))
    }

    /// Bytes a second that it carries for the robots.
    pub(super) fn for_robots(&self) -> u32 {
        (f64::from(self.rate_bytes_per_s) * (1.0 - self.cross_traffic)) as u32
    }

    /// Bytes of each datagram of cross traffic, and microseconds from one to the next.
    pub(super) fn cross_traffic(&self) -> Option<(usize, i64)> {
        let rate = f64::from(self.rate_bytes_per_s) * self.cross_traffic;
        (rate > 0.0).then(|| (CROSS_TRAFFIC_BYTES, (CROSS_TRAFFIC_BYTES as f64 * 1e6 / rate) as i64))
    }

    pub(super) fn note(&self) -> String {
        let budget = self
            .budget_bytes_per_s
            .map_or_else(String::new, |budget| format!(", {budget} bytes/s for each robot"));
        format!(
            "a crowded radio: {} bytes/s, of which cross traffic takes {:.0} %{budget}",
            self.rate_bytes_per_s,
            100.0 * self.cross_traffic
        )
    }
}

/// How much of what the radio carries brings something new, while anything is missing, and while much is.
#[derive(Clone, Debug, Default)]
pub(super) struct NewBytes {
    /// Datagrams that brought something, by sender, receiver if there is one, and check.
    counted: BTreeSet<(RobotId, Option<RobotId>, u32)>,
    is_much_missing: bool,
    pub(super) all: Share,
    pub(super) while_much: Share,
}

/// Bytes of datagrams that brought something new, and bytes that could have gone out meanwhile.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Share {
    pub(super) new: u64,
    pub(super) could: u64,
}

impl Share {
    /// Whether it is as much as is asked for.
    pub(super) fn is_enough(&self) -> bool {
        100 * self.new >= NEW_MIN * self.could
    }
}

impl NewBytes {
    /// A datagram brought something new to somebody.
    pub(super) fn brought(&mut self, from: RobotId, to: Option<RobotId>, bytes: &[u8]) {
        if self.counted.insert((from, to, crc32fast::hash(bytes))) {
            let bytes = (bytes.len() + IP_UDP_BYTES) as u64;
            self.all.new += bytes;
            self.while_much.new += if self.is_much_missing { bytes } else { 0 };
        }
    }

    /// So many bytes were missing for so many microseconds.
    pub(super) fn missed(&mut self, missing: u64, micros: i64, bytes_per_s: u32) {
        let could = micros.max(0) as u64 * u64::from(bytes_per_s) / 1_000_000;
        self.is_much_missing = missing >= MUCH * u64::from(bytes_per_s);
        self.all.could += could;
        self.while_much.could += if self.is_much_missing { could } else { 0 };
    }
}

/// About the bytes that would have to go out so that each robot had all packages of those who fly.
pub(super) fn missing_bytes(truth: &Truth, robots: &[&Robot], cast: Cast) -> u64 {
    let nothing = IntervalSet::new(0);
    let flies = |stream| robots.iter().any(|robot| robot.own_stream() == stream);
    let of_stream = |(stream, published): (_, &Published)| {
        let last = truth.last(stream);
        let missing = robots.iter().map(|robot| {
            let received = robot.session().received(stream).unwrap_or(&nothing);
            received.missing(1, last).map(|(low, high)| u64::from(high - low + 1)).sum::<u64>()
        });
        // By broadcast what goes out once is for all.
        let packages = if cast == Cast::Unicast { missing.sum() } else { missing.max().unwrap_or(0) };
        packages * (published.bytes / u64::from(last.max(1)) + HEADER_BYTES)
    };
    truth.streams().filter(|(stream, _)| flies(*stream)).map(of_stream).sum()
}
