//! How long it takes until the others hold a batch whole, as the sender sees it.

use core::time::Duration;
use std::collections::{BTreeMap, VecDeque};

use flockmap_grid::{Stamp, Stream};

/// Batches over which the delay is judged.
const BATCHES: usize = 32;
/// Of these, the slowest that are left out: a tenth.
const SLOWEST_LEFT_OUT: usize = BATCHES / 10;

/// The delay of repair: from publishing a batch until a peer lacks nothing up to its end. So long a later
/// package that builds on the batch would wait, so this is the measure whether packages are coded against
/// earlier ones or not.
///
/// Peers say what they hold once a second or so, and at once when something is missing. So it is not the time
/// until a peer states that it holds a batch that counts, but the time until it stated last that something is
/// missing: 0 for what was never missing, whatever the period of its requests. The delay is the one that nine
/// of ten of the last 32 batches keep, of the slowest peer.
///
/// A peer counts from when it held a batch whole for the first time: one that joins late catches up first.
pub(crate) struct RepairDelay {
    /// Zero: never slow.
    limit: Duration,
    /// When batches were published and the last package of each, oldest first.
    batches: VecDeque<(Stamp, u32)>,
    peers: BTreeMap<Stream, PeerDelay>,
    calls: u64,
    is_slow: bool,
}

#[derive(Default)]
struct PeerDelay {
    /// It held all packages up to this one.
    prefix: u32,
    /// When it last said so.
    asked_at: Option<Stamp>,
    /// Delay of the newest batches that it holds, oldest first.
    delays: VecDeque<Duration>,
    /// As of its last request.
    delay: Option<Duration>,
    /// The last call in which it was live.
    seen_in: u64,
}

impl RepairDelay {
    pub(crate) fn new(limit_ms: u32) -> Self {
        Self {
            limit: Duration::from_millis(limit_ms.into()),
            batches: VecDeque::new(),
            peers: BTreeMap::new(),
            calls: 0,
            is_slow: false,
        }
    }

    /// Notes that a batch was published.
    pub(crate) fn note_batch(&mut self, now: Stamp, last_index: u32) {
        self.batches.push_back((now, last_index));
        if self.batches.len() > BATCHES {
            self.batches.pop_front();
        }
    }

    /// Takes in what the peers hold: each live peer with the time of its last request and the index up to
    /// which it lacks nothing. O(peers).
    pub(crate) fn note_received(&mut self, peers: impl Iterator<Item = (Stream, Stamp, u32)>) {
        self.calls += 1;
        for (stream, asked_at, prefix) in peers {
            let peer = self.peers.entry(stream).or_default();
            peer.seen_in = self.calls;
            if peer.asked_at.is_none_or(|last| last < asked_at) {
                peer.note_request(&self.batches, asked_at, prefix);
                peer.delay = peer.delay(&self.batches);
            }
        }
        self.peers.retain(|_, peer| peer.seen_in == self.calls);
        let slowest = self.peers.values().filter_map(|peer| peer.delay).max().unwrap_or_default();
        // Not to and fro: it has to become twice as good.
        let limit = if self.is_slow { self.limit / 2 } else { self.limit };
        self.is_slow = !self.limit.is_zero() && slowest > limit;
    }

    /// Whether packages would wait too long for those that they build on.
    pub(crate) const fn is_slow(&self) -> bool {
        self.is_slow
    }
}

impl PeerDelay {
    fn note_request(&mut self, batches: &VecDeque<(Stamp, u32)>, asked_at: Stamp, prefix: u32) {
        if prefix > self.prefix {
            let is_first = self.delays.is_empty();
            for (published, _) in batches.iter().filter(|(_, last)| (self.prefix + 1..=prefix).contains(last))
            {
                // What it held before it was known to hold anything is no measure.
                let missing_until = self.asked_at.filter(|_| !is_first).unwrap_or(*published);
                self.delays.push_back(missing_until.since(*published));
            }
            self.prefix = prefix;
        }
        self.delays.drain(..self.delays.len().saturating_sub(BATCHES));
        self.asked_at = Some(asked_at);
    }

    /// The delay that nine of ten of the newest batches keep, those counted that are missing still. `None`
    /// for a peer that has never held a batch whole.
    fn delay(&self, batches: &VecDeque<(Stamp, u32)>) -> Option<Duration> {
        let asked_at = self.asked_at.filter(|_| !self.delays.is_empty())?;
        let missing = batches.iter().filter(|(_, last)| *last > self.prefix);
        let missing = missing.map(|(published, _)| asked_at.since(*published));
        let mut newest_first: Vec<Duration> =
            missing.rev().chain(self.delays.iter().rev().copied()).take(BATCHES).collect();
        newest_first.sort_unstable_by(|a, b| b.cmp(a));
        newest_first.get(SLOWEST_LEFT_OUT.min(newest_first.len() - 1)).copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_grid::RobotId;

    const MS: i64 = 1_000;

    fn peer(id: u16) -> Stream {
        Stream { origin: RobotId(id), epoch: 1 }
    }

    /// A batch of ten packages every half second; each peer holds those that are `lag` old, and says so once
    /// a second.
    fn run(delay: &mut RepairDelay, seconds: std::ops::Range<i64>, lags_ms: &[i64]) {
        for half in seconds.start * 2..seconds.end * 2 {
            let now = Stamp(half * 500 * MS);
            delay.note_batch(now, 10 * (half as u32 + 1));
            let asked_at = now.plus_micros(123 * MS);
            if half % 2 == 0 {
                let peers = (1..).zip(lags_ms).map(|(id, lag)| {
                    let received = (asked_at.0 - lag * MS).div_euclid(500 * MS) + 1;
                    (peer(id), asked_at, 10 * received.max(0) as u32)
                });
                delay.note_received(peers);
            }
        }
    }

    #[test]
    fn a_fast_radio_is_not_slow_however_rare_requests_are() {
        let mut delay = RepairDelay::new(100);
        run(&mut delay, 0..30, &[20, 90]);
        assert!(!delay.is_slow());
    }

    #[test]
    fn one_slow_peer_counts_and_becoming_a_little_better_is_not_enough() {
        let mut delay = RepairDelay::new(2_000);
        run(&mut delay, 0..30, &[20, 20]);
        assert!(!delay.is_slow());
        run(&mut delay, 30..60, &[20, 4_000]);
        assert!(delay.is_slow());
        run(&mut delay, 60..90, &[20, 2_300]);
        assert!(delay.is_slow(), "1.6 s is below the limit, but not below half of it");
        run(&mut delay, 90..120, &[20, 500]);
        assert!(!delay.is_slow());
    }

    #[test]
    fn a_peer_that_stops_catching_up_is_noticed_while_it_still_lacks_it() {
        let mut delay = RepairDelay::new(2_000);
        run(&mut delay, 0..30, &[20]);
        let prefix = 10 * 58;
        for half in 60..72 {
            let now = Stamp(half * 500 * MS);
            delay.note_batch(now, 10 * (half as u32 + 1));
            delay.note_received([(peer(1), now, prefix)].into_iter());
        }
        assert!(delay.is_slow());
    }

    #[test]
    fn a_late_joiner_counts_when_it_has_caught_up_and_a_lost_peer_no_more() {
        let mut delay = RepairDelay::new(1_000);
        run(&mut delay, 0..30, &[20]);
        let asked_at = Stamp(31_000 * MS);
        delay.note_received([(peer(1), asked_at, 600), (peer(2), asked_at, 0)].into_iter());
        assert!(!delay.is_slow());
        run(&mut delay, 32..60, &[20, 5_000]);
        assert!(delay.is_slow());
        delay.note_received([(peer(1), Stamp(60_000 * MS), 10 * 120)].into_iter());
        assert!(!delay.is_slow());
    }

    #[test]
    fn without_a_limit_it_is_never_slow() {
        let mut delay = RepairDelay::new(0);
        run(&mut delay, 0..30, &[20]);
        run(&mut delay, 30..90, &[20_000]);
        assert!(!delay.is_slow());
    }
}
