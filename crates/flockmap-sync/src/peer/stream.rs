//! What a peer holds of one stream, as far as it is known, and what of it is in flight there.

use crate::IntervalSet;
use crate::item::Item;
use crate::wire::{RestRequest, SnapshotRequest};
use core::time::Duration;
use flockmap_grid::Stamp;

/// Intervals kept of what a peer states to hold of one stream; of more, the newest.
pub(crate) const PEER_INTERVALS_MAX: usize = 256;

/// A snapshot counts as ignored when chunks of it got lost four times and the peer has not spoken of it.
const UNHEEDED_MAX: u8 = 5;
/// Something sent and not yet confirmed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SentPackage {
    pub(crate) item: Item,
    pub(crate) at: Stamp,
    /// It went out again before anything was known of it, or though it was known to be there.
    pub(crate) is_repeated: bool,
    /// Another robot sent it, and the peer hears that one.
    pub(crate) is_heard: bool,
    /// Requests of the peer since then in which it was still missing.
    pub(crate) requests: u8,
}

/// A snapshot in flight to the peer.
#[derive(Clone, Debug)]
pub(crate) struct Sending {
    pub(crate) snapshot_id: u32,
    pub(crate) since: u32,
    pub(crate) upto: u32,
    /// It is a piece: what it lacks, and packages up to this one that build on that, come by further ones. Else `upto`.
    pub(crate) pieces_upto: u32,
    /// [`Outgoing::newest_of`](crate::outbox::Outgoing::newest_of).
    pub(crate) newest_of: u32,
    /// When the peer last spoke of the snapshot, or it was begun.
    pub(crate) named_at: Stamp,
    /// 0: the peer spoke of the snapshot. Else how often chunks got lost since then, or since it was begun,
    /// and one more.
    pub(crate) unheeded: u8,
    /// When chunks of it got lost last.
    pub(crate) lost_at: Stamp,
    /// Number + 1 of the chunks that the peer accepted.
    pub(crate) accepted: IntervalSet,
    /// Those and the ones in flight.
    pub(crate) received_or_in_flight: IntervalSet,
}

/// What the peer holds of one stream, as far as it is known.
#[derive(Clone, Debug)]
pub(crate) struct PeerStream {
    /// Nothing is known below this index.
    pub(crate) from: u32,
    /// When a request of the peer named it last.
    pub(crate) stated_at: Stamp,
    /// What the peer stated to hold, or sent itself.
    pub(crate) received: IntervalSet,
    /// Those and the ones in flight: what need not be sent now. It has room for both; and those that a full
    /// ledger forgot since the last request.
    pub(crate) received_or_in_flight: IntervalSet,
    /// For a relay that is not first in line: what stayed missing for the whole relay delay.
    pub(crate) overdue: IntervalSet,
    /// What was missing at some earlier request, and when that was.
    pub(crate) missing_then: (Stamp, IntervalSet),
    pub(crate) sending: Option<Sending>,
    /// The last one that it made, withdrawn or not.
    snapshot_request: Option<PeerRequest>,
    /// Something of the stream is lacking there; and whether the peer can decode hardly anything that is not
    /// independent.
    pub(crate) in_part: Option<bool>,
    /// Packages up to this one that build on others it can hardly decode before it holds all of them: it was sent a piece
    /// of a state.
    pub(crate) pieces_upto: u32,
    /// It wants all that there is here.
    pub(crate) rest_wanted: Option<RestRequest>,
}

/// A snapshot that the peer wants.
#[derive(Clone, Debug)]
pub(crate) struct PeerRequest {
    /// Since this package, or an earlier one.
    pub(crate) since: u32,
    /// It should contain some of these.
    pub(crate) undecodable: IntervalSet,
    /// How long it has said so.
    pub(crate) stated_since: Stamp,
    /// It was not named any more: there may have been no room for it.
    is_withdrawn: bool,
}

impl PeerStream {
    pub(crate) const fn new(from: u32, now: Stamp) -> Self {
        Self {
            from,
            stated_at: Stamp(i64::MIN),
            received: IntervalSet::new(PEER_INTERVALS_MAX),
            received_or_in_flight: IntervalSet::new(PEER_INTERVALS_MAX),
            overdue: IntervalSet::new(PEER_INTERVALS_MAX),
            missing_then: (now, IntervalSet::new(PEER_INTERVALS_MAX)),
            sending: None,
            snapshot_request: None,
            in_part: None,
            pieces_upto: 0,
            rest_wanted: None,
        }
    }

    /// Nothing of it is under way as a snapshot, or asked of this robot, or missing for so long that a relay answers.
    pub(crate) fn asks_for_nothing(&self) -> bool {
        self.sending.is_none()
            && self.snapshot_request().is_none()
            && self.rest_wanted.is_none()
            && self.overdue.is_empty()
    }

    /// The snapshot that the peer wants.
    pub(crate) fn snapshot_request(&self) -> Option<&PeerRequest> {
        self.snapshot_request.as_ref().filter(|request| !request.is_withdrawn)
    }

    /// The peer wants a snapshot. Where a thin radio has room for one such request at a time they are named in turn: one
    /// that comes again for the same packages is as old as it was.
    pub(crate) fn note_snapshot_request(&mut self, now: Stamp, wanted: &SnapshotRequest) {
        let is_same = |before: &&PeerRequest| {
            !before.is_withdrawn || !before.undecodable.intersection(&wanted.undecodable).is_empty()
        };
        let before = self.snapshot_request.as_ref().filter(is_same);
        self.snapshot_request = Some(PeerRequest {
            since: wanted.since,
            undecodable: wanted.undecodable.clone(),
            stated_since: before.map_or(now, |before| before.stated_since),
            is_withdrawn: false,
        });
    }

    pub(crate) fn withdraw_snapshot_request(&mut self) {
        self.snapshot_request.iter_mut().for_each(|request| request.is_withdrawn = true);
    }

    /// The peer has confirmed this package. A stream that is too fragmented to note it learns it from the
    /// next request.
    pub(crate) fn note_received(&mut self, index: u32) {
        let _ = self.received.insert(index);
        let _ = self.received_or_in_flight.insert(index);
    }
}

impl PeerStream {
    /// Begins to send it a snapshot.
    pub(crate) fn begin(&mut self, sending: Sending) {
        if sending.pieces_upto > sending.upto {
            self.pieces_upto = self.pieces_upto.max(sending.pieces_upto);
        }
        self.sending = Some(sending);
    }

    /// Whether a package is stated to be held.
    pub(crate) fn holds(&self, item: Item) -> bool {
        matches!(item, Item::Package { index, .. } if self.received.contains(index))
    }

    /// Notes that an item need not be sent now; whether that was news. A view that is too torn to note it
    /// says no. Such an item is not sent either: it would be sent again and again.
    pub(crate) fn cover(&mut self, item: Item) -> bool {
        match item {
            Item::Package { index, .. } => self.received_or_in_flight.insert(index).unwrap_or(false),
            Item::Chunk { snapshot_id, chunk, .. } => match &mut self.sending {
                Some(sending) if sending.snapshot_id == snapshot_id => {
                    sending.received_or_in_flight.insert(chunk + 1).unwrap_or(false)
                }
                _ => false,
            },
        }
    }
}

impl Sending {
    /// The peer does not take it: it has no place for it, or knows better. Or all that was sent of it got lost.
    pub(crate) const fn is_ignored(&self) -> bool {
        self.unheeded >= UNHEEDED_MAX
    }

    /// Whether it brings more of the rest of a stream.
    pub(crate) const fn brings_rest(&self, wanted: &RestRequest) -> bool {
        brings_rest([self.since, self.upto, self.newest_of], wanted)
    }

    /// Chunks got lost, and the peer does not speak of the snapshot.
    pub(crate) fn note_unheeded(&mut self, now: Stamp) {
        self.unheeded = self.unheeded.saturating_add(1).min(UNHEEDED_MAX);
        self.lost_at = now;
    }

    /// A peer that does not speak of the snapshot for long has forgotten it, or has not heard of it yet.
    pub(crate) fn note_silence(&mut self, now: Stamp, patience: Duration) {
        if now.since(self.named_at) > patience {
            self.named_at = now;
            self.unheeded = UNHEEDED_MAX;
            self.accepted = IntervalSet::new(PEER_INTERVALS_MAX);
        }
    }
}

/// Whether a snapshot, since a package up to one, that says the newest up to a third, brings more of the rest of a stream.
pub(crate) const fn brings_rest([since, upto, newest_of]: [u32; 3], wanted: &RestRequest) -> bool {
    since <= wanted.since && upto > wanted.since && newest_of >= wanted.upto
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_grid::{RobotId, Stream};

    fn wanted(index: u32) -> SnapshotRequest {
        let undecodable = IntervalSet::from_intervals(0, vec![(index, index)]);
        SnapshotRequest { stream: Stream { origin: RobotId(1), epoch: 1 }, since: 1, from: 1, undecodable }
    }

    /// Once it was as new as the request that named it, and who waits for others to answer first never answered.
    #[test]
    fn a_snapshot_request_that_is_named_in_turn_with_others_is_as_old_as_when_it_was_first_named() {
        let mut theirs = PeerStream::new(1, Stamp(0));
        for now in [10, 30, 50] {
            theirs.note_snapshot_request(Stamp(now), &wanted(9));
            assert_eq!(theirs.snapshot_request().map(|request| request.stated_since), Some(Stamp(10)));
            theirs.withdraw_snapshot_request();
            assert!(theirs.snapshot_request().is_none() && theirs.asks_for_nothing());
        }
        theirs.note_snapshot_request(Stamp(70), &wanted(11));
        assert_eq!(theirs.snapshot_request().map(|request| request.stated_since), Some(Stamp(70)));
    }
}
