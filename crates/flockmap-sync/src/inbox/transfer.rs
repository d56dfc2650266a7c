//! One snapshot that is being received.

use crate::IntervalSet;
use crate::store::RECEIVED_INTERVALS_MAX;
use core::time::Duration;
use flockmap_grid::{RobotId, Stamp, Stream};
use flockmap_mutation::{self as mutation, Mutation};

/// Silence after which a transfer is dropped, where robots are heard as often as usual.
pub(crate) const ABANDONED: Duration = Duration::from_secs(30);

/// A snapshot that is being received.
#[derive(Debug)]
pub(crate) struct Transfer {
    pub(crate) source: RobotId,
    pub(crate) stream: Stream,
    /// 0: the whole state. Else what packages 1 to this one say is needed beside it.
    pub(crate) since: u32,
    pub(crate) upto: u32,
    pub(crate) snapshot_id: u32,
    pub(crate) chunks: u32,
    /// Number + 1 of the chunks accepted.
    pub(crate) accepted: IntervalSet,
    /// What it contains, where it is a part of a history with gaps.
    pub(crate) contents: Option<IntervalSet>,
    /// It lacks something itself, nothing newer than this.
    pub(crate) lost_upto: Option<Stamp>,
    /// It is a piece of a state that says nothing newer than its packages.
    pub(crate) is_cut: bool,
    /// Of all packages up to this one, nothing newer is known of what it says.
    pub(crate) newest_of: u32,
    /// The newest stamp in its chunks so far.
    pub(crate) newest: Stamp,
    /// Its packages are all held: it brings what was dropped of them.
    pub(crate) is_rest: bool,
    /// Something of the stream was dropped since it began.
    pub(crate) is_spoiled: bool,
    pub(crate) touched: Stamp,
}

impl Transfer {
    pub(crate) const fn new(
        source: RobotId,
        stream: Stream,
        [since, upto]: [u32; 2],
        snapshot_id: u32,
        chunks: u32,
        now: Stamp,
    ) -> Self {
        Self {
            source,
            stream,
            since,
            upto,
            snapshot_id,
            chunks,
            accepted: IntervalSet::new(RECEIVED_INTERVALS_MAX),
            contents: None,
            lost_upto: None,
            is_cut: false,
            newest_of: upto,
            newest: Stamp(i64::MIN),
            is_rest: false,
            is_spoiled: false,
            touched: now,
        }
    }

    /// None of its chunks counts any more.
    pub(crate) fn restart(&mut self) {
        self.accepted = IntervalSet::new(RECEIVED_INTERVALS_MAX);
        self.is_spoiled = false;
    }

    /// Whether chunks of both belong together: cut by the same robot from the same state.
    pub(crate) fn is_same(&self, other: &Self) -> bool {
        (self.source, self.stream, self.since, self.upto, self.snapshot_id, self.chunks)
            == (other.source, other.stream, other.since, other.upto, other.snapshot_id, other.chunks)
    }

    pub(crate) fn is_complete(&self) -> bool {
        self.accepted.contains_range(1, self.chunks)
            || (!self.accepted.is_empty() && mutation::is(Mutation::SnapshotReceivedTooEarly))
    }

    /// Whether all that it brings is held already.
    pub(crate) fn is_in(&self, received: &IntervalSet) -> bool {
        if self.is_rest {
            return false;
        }
        let rest = self.contents.as_ref().map(|contents| contents.difference(received));
        received.contains_range(1, self.upto) || rest.is_some_and(|rest| rest.is_empty())
    }

    /// Nothing has come of it for long. A complete one waits longer, for the packages before it.
    pub(crate) fn is_abandoned(&self, now: Stamp, patience: Duration) -> bool {
        now.since(self.touched) > if self.is_complete() { patience.max(10 * ABANDONED) } else { patience }
    }
}
