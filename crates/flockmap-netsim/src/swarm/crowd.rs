//! A thin radio with cross traffic, which carries less than the robots would send. Nobody tells them what it carries, or
//! they have tiny budgets. It is measured how much of it brings something new.

use super::preset::BUDGET_MIN;
use super::purpose;
use crate::{IP_UDP_BYTES, RadioConfig};
use flockmap::{Cast, RobotId, SessionConfig};
use flockmap_worlds::random::Random;
use std::collections::BTreeSet;

/// Bytes of a datagram of cross traffic.
const CROSS_TRAFFIC_BYTES: usize = 1_400;
/// Least share of a robot, for each copy that it sends.
const SHARE_MIN: u32 = 100;
/// Share of what the radio carries for the robots that new bytes are to take, in per cent.
const NEW_MIN: u64 = 60;

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

    /// Whether each robot's share is what a session is known to do with: by unicast its requests go to each of the others.
    pub(super) fn is_enough(&self, robots: usize, cast: Cast) -> bool {
        let copies = if cast == Cast::Unicast { robots as u32 - 1 } else { 1 };
        let share = self.for_robots() / robots as u32;
        self.budget_bytes_per_s.unwrap_or(share).min(share) >= SHARE_MIN * copies
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

/// How much of what the radio carries brings something new, while anything is missing.
#[derive(Clone, Debug, Default)]
pub(super) struct NewBytes {
    /// Datagrams that brought something, by sender, receiver if there is one, and check.
    counted: BTreeSet<(RobotId, Option<RobotId>, u32)>,
    new: u64,
    /// What could have gone out meanwhile.
    could: u64,
}

impl NewBytes {
    /// A datagram brought something new to somebody.
    pub(super) fn brought(&mut self, from: RobotId, to: Option<RobotId>, bytes: &[u8]) {
        if self.counted.insert((from, to, crc32fast::hash(bytes))) {
            self.new += (bytes.len() + IP_UDP_BYTES) as u64;
        }
    }

    /// Something was missing for so many microseconds.
    pub(super) fn missed(&mut self, micros: i64, bytes_per_s: u32) {
        self.could += micros.max(0) as u64 * u64::from(bytes_per_s) / 1_000_000;
    }

    /// New bytes, what could have gone out, and whether they are 60 % of it.
    pub(super) fn sum(&self) -> (u64, u64, bool) {
        (self.new, self.could, 100 * self.new >= NEW_MIN * self.could)
    }
}
