//! The own clock, and how far those of others are off.

use crate::peer::Peer;
use flockmap_grid::{RobotId, Stamp, Stream};
use std::collections::BTreeMap;

/// What is known of time.
#[derive(Debug)]
pub(crate) struct Clocks {
    /// The newest time that came with an input.
    now: Stamp,
    given: BTreeMap<RobotId, i64>,
    /// Last measured offsets of streams whose robot may be gone; only of streams in the store.
    measured: BTreeMap<Stream, i64>,
}

impl Clocks {
    pub(crate) const fn new() -> Self {
        Self { now: Stamp(i64::MIN), given: BTreeMap::new(), measured: BTreeMap::new() }
    }

    pub(crate) const fn now(&self) -> Stamp {
        self.now
    }

    /// The time of an input; where it runs backwards it stands still.
    pub(crate) fn advance(&mut self, now: Stamp) -> Stamp {
        self.now = self.now.max(now);
        self.now
    }

    /// Sets a robot's clock minus the own clock, in microseconds; `None`: as measured.
    pub(crate) fn set_given(&mut self, robot: RobotId, micros: Option<i64>) {
        match micros {
            Some(micros) => self.given.insert(robot, micros),
            None => self.given.remove(&robot),
        };
    }

    pub(crate) fn note_measured(&mut self, stream: Stream, micros: i64) {
        self.measured.insert(stream, micros);
    }

    pub(crate) fn forget(&mut self, stream: Stream) {
        self.measured.remove(&stream);
    }

    /// A peer's clock minus the own clock: as given, else as measured.
    pub(crate) fn of_peer(&self, peer: &Peer) -> Option<i64> {
        self.given.get(&peer.stream.origin).copied().or_else(|| peer.clock.offset())
    }

    /// A run's clock minus the own clock: as given, else as measured with its robot, else through a peer that
    /// hears it, else as last measured.
    pub(crate) fn of_run(&self, run: Stream, peers: &BTreeMap<RobotId, Peer>) -> Option<i64> {
        if let Some(&given) = self.given.get(&run.origin) {
            return Some(given);
        }
        let direct = peers.get(&run.origin).filter(|peer| peer.stream == run);
        if let Some(offset) = direct.and_then(|peer| peer.clock.offset()) {
            return Some(offset);
        }
        let by_path = peers.values().filter_map(|peer| {
            let is_it =
                |r: &&crate::wire::ClockReport| r.robot == run.origin && r.epoch_low == run.epoch as u16;
            let report = peer.clocks.iter().find(is_it)?;
            Some((peer.round_trip.mean()?, peer.clock.offset()?.checked_add(report.offset_micros)?))
        });
        by_path.min().map(|(_, offset)| offset).or_else(|| self.measured.get(&run).copied())
    }
}
