//! What the radio carries, whoever uses it.
//!
//! Where cross traffic fills the queue, nothing that a robot does empties it. Then it goes by what the radio carried
//! before, or by pairs of datagrams: two that are sent at once stand in the queue one behind the other, and arrive as
//! far apart as the radio takes for the second (packet pairs, Keshav 1991).

use super::queueing::Least;
use core::time::Duration;
use flockmap_grid::Stamp;
use std::collections::VecDeque;

pub(super) const SECOND: i64 = 1_000_000;
pub(super) const FULL_DATAGRAM: i64 = 1_228;
pub(super) const BYTES_PER_S_MAX: u32 = 1 << 30;

/// Bytes in so many microseconds.
pub(super) fn per_second(bytes: u64, micros: i64) -> i64 {
    (bytes.min(1 << 40) as i64 * SECOND / micros.max(1)).min(BYTES_PER_S_MAX.into())
}

/// What was carried is remembered for ten to twenty minutes.
const SPAN: Duration = Duration::from_secs(600);
/// It is measured over so long, and so many bytes.
const MEASURED_OVER: i64 = 2 * SECOND;
const MEASURED_BYTES: u64 = 8 * FULL_DATAGRAM as u64;
/// The middle one of the last so many pairs counts, once there are so many.
const PAIRS_MAX: usize = 8;
const PAIRS_MIN: usize = 3;
/// Pairs nearer to each other say nothing: what reads the socket may have been late.
const APART_MIN: i64 = 1_000;
/// Nor do small datagrams.
const PAIR_BYTES_MIN: usize = 400;

/// What had arrived, and when.
#[derive(Clone, Copy, Debug)]
pub(super) struct Arrived {
    /// When the newest own datagram that arrived was sent.
    pub(super) sent: Stamp,
    /// Own bytes sent up to it.
    pub(super) own: u64,
    /// When it arrived, but for the base delay: when it was sent, and the time that it queued.
    pub(super) own_at: Stamp,
    /// Bytes of other robots heard.
    pub(super) heard: u64,
    pub(super) heard_at: Stamp,
}

#[derive(Clone, Debug)]
pub(super) struct Capacity {
    /// The most that was carried in a second, with a minus: of those the least.
    minus_most: Least,
    /// What is measured now, and what was before: of that it is known by now which datagrams were lost.
    now: Option<Measured>,
    before: Option<Measured>,
    /// Bytes a second.
    pairs: VecDeque<i64>,
}

/// What arrived since a time.
#[derive(Clone, Copy, Debug)]
struct Measured {
    since: Arrived,
    /// Own and other robots' bytes a second, once it is over.
    own: i64,
    heard: i64,
    /// Own datagrams sent since then of which it is known whether they arrived, and those of them that did.
    known: u32,
    arrived: u32,
}

impl Measured {
    const fn begin(since: Arrived) -> Self {
        Self { since, own: 0, heard: 0, known: 0, arrived: 0 }
    }

    fn bytes_per_s(&self, heard_of: i64) -> i64 {
        let own = self.own * i64::from(self.arrived) / i64::from(self.known.max(1));
        (own + self.heard * heard_of).min(BYTES_PER_S_MAX.into())
    }
}

impl Capacity {
    pub(super) const fn new() -> Self {
        Self { minus_most: Least::new(SPAN), now: None, before: None, pairs: VecDeque::new() }
    }

    /// Bytes a second; 0: not known.
    pub(super) fn bytes_per_s(&self) -> i64 {
        let most = self.minus_most.get().map_or(0, |minus| -minus);
        let by_pairs = if self.is_known_by_pairs() {
            let mut pairs: Vec<i64> = self.pairs.iter().copied().collect();
            pairs.sort_unstable();
            pairs[pairs.len() / 2]
        } else {
            0
        };
        most.max(by_pairs).min(BYTES_PER_S_MAX.into())
    }

    pub(super) fn is_known_by_pairs(&self) -> bool {
        self.pairs.len() >= PAIRS_MIN
    }

    /// Two datagrams sent at once came so many microseconds apart, the second of them so large.
    pub(super) fn note_pair(&mut self, bytes: usize, apart: i64) {
        if apart >= APART_MIN && bytes >= PAIR_BYTES_MIN {
            self.pairs.truncate(PAIRS_MAX - 1);
            self.pairs.push_front(bytes as i64 * SECOND / apart);
        }
    }

    pub(super) fn note_outcome(&mut self, sent: Stamp, is_lost: bool) {
        let of = |measured: &&mut Measured| sent >= measured.since.sent;
        if let Some(measured) = [&mut self.now, &mut self.before].into_iter().flatten().find(of) {
            measured.known = measured.known.saturating_add(1);
            measured.arrived = measured.arrived.saturating_add(u32::from(!is_lost));
        }
    }

    /// `heard_of`: this robot hears one of so many bytes that other robots send.
    pub(super) fn note_arrived(&mut self, now: Stamp, arrived: Arrived, heard_of: i64) {
        let measured = self.now.get_or_insert_with(|| Measured::begin(arrived));
        let since = measured.since;
        let (own_for, heard_for) =
            (arrived.own_at.micros_since(since.own_at), arrived.heard_at.micros_since(since.heard_at));
        let (own, heard) = (arrived.own - since.own, arrived.heard - since.heard);
        if own_for.min(heard_for) < MEASURED_OVER || own + heard < MEASURED_BYTES {
            return;
        }
        (measured.own, measured.heard) = (per_second(own, own_for), per_second(heard, heard_for));
        if let Some(before) = core::mem::replace(&mut self.before, self.now.take()) {
            self.minus_most.note(now, -before.bytes_per_s(heard_of));
        }
        self.now = Some(Measured::begin(arrived));
    }
}
