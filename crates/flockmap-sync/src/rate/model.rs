//! A robot of the tests: its rate, and what goes by with it, on a clock of its own.

use super::{Arrival, Heard, QueueingDelays, Rate};
use flockmap_grid::Stamp;
use std::collections::BTreeMap;

pub(super) struct Robot {
    pub(super) rate: Rate,
    pub(super) sent: u64,
    pub(super) clock: i64,
    /// From and to each other robot, and what that said last.
    queueing: BTreeMap<usize, (QueueingDelays, Option<Arrival>)>,
    /// Of each other robot the last datagram: when it was sent, and when it came, to the microsecond.
    last: BTreeMap<usize, (Stamp, Stamp)>,
    /// What it has not told yet of each other robot.
    pub(super) untold: BTreeMap<usize, Arrival>,
}

impl Robot {
    pub(super) fn new(number: usize) -> Self {
        Self {
            rate: Rate::new(),
            sent: 0,
            clock: (number as i64 - 2) * 77_000_000,
            queueing: BTreeMap::new(),
            last: BTreeMap::new(),
            untold: BTreeMap::new(),
        }
    }

    pub(super) fn now(&self, time: i64) -> Stamp {
        Stamp(time + self.clock)
    }

    /// A datagram came at a time, and is taken in now.
    pub(super) fn hear(&mut self, (now, at): (i64, i64), from: usize, sent: Stamp, bytes: usize) {
        let (now, at) = (self.now(now), self.now(at));
        let (queueing, _) = self.queueing.entry(from).or_default();
        let queued = queueing.sample_from(now, now.micros_since(sent));
        self.untold.insert(from, Arrival { sent, arrived: now });
        let before = self.last.insert(from, (sent, at));
        self.rate.note_heard(at, Heard { bytes, sent, before, queued });
    }

    /// Another robot tells which of its datagrams came last, and when.
    pub(super) fn be_told(&mut self, now: i64, by: usize, arrival: Arrival) {
        let now = self.now(now);
        let (queueing, before) = self.queueing.entry(by).or_default();
        let queued = queueing.sample_to(now, arrival.arrived.micros_since(arrival.sent));
        self.rate.note_arrival(now, arrival, before.replace(arrival), queued);
    }
}
