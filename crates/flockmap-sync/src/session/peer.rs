//! What a session knows of one peer.

use super::path::PeerPath;
use crate::counters::Traffic;
use crate::link::{ClockFilter, Loss, RoundTrip};
use crate::pacer::Pacer;
use crate::wire::Covered;
use crate::{IntervalSet, SessionConfig};
use flockmap_grid::{RobotId, Stamp, Stream};
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// Intervals kept of what a peer states to hold of one stream; of more, the newest.
pub(super) const VIEW_INTERVALS_MAX: usize = 256;

/// Intervals kept of the origins that a peer has covered.
const COVERED_INTERVALS_MAX: usize = 256;
/// Runs noted that a peer holds and that have no place here.
pub(crate) const UNPLACED_MAX: usize = 128;

/// Datagrams that follow each other within this time are one burst.
const BURST: i64 = 100_000;
/// A peer is silent after so many of its usual pauses. Of a radio that loses every second datagram, one pause in thousands is that long.
const SILENT_PAUSES: i64 = 8;
/// And not before this time.
const SILENT_MIN: i64 = 1_500_000;

/// A robot has heard those in reach, and said so, after this time.
const ACQUAINTANCE: i64 = 1_000_000;

/// One package, or one tile of a present state.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub(super) enum Item {
    Package { stream: Stream, index: u32 },
    Tile { stream: Stream, set: u32, tile: u32 },
}

impl Item {
    pub(super) const fn stream(self) -> Stream {
        match self {
            Self::Package { stream, .. } | Self::Tile { stream, .. } => stream,
        }
    }
}

/// Something sent and not yet confirmed.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sent {
    pub(super) item: Item,
    pub(super) at: Stamp,
    /// Requests of the peer since then in which it was still missing.
    pub(super) requests: u8,
}

/// A present state on its way to the peer.
#[derive(Clone, Debug)]
pub(super) struct Sending {
    pub(super) set: u32,
    pub(super) since: u32,
    pub(super) upto: u32,
    /// When the peer last spoke of the set, or it was begun.
    pub(super) named_at: Stamp,
    /// 0: the peer spoke of the set. Else how often tiles got lost since then, or since it was begun, and one more.
    pub(super) unheeded: u8,
    /// When tiles of it got lost last.
    pub(super) lost_at: Stamp,
    /// Number + 1 of the tiles that the peer accepted.
    pub(super) accepted: IntervalSet,
    /// Those and the ones in flight.
    pub(super) covered: IntervalSet,
}

/// What the peer holds of one stream, as far as it is known.
#[derive(Clone, Debug)]
pub(super) struct View {
    /// Nothing is known below this index.
    pub(super) from: u32,
    /// What the peer stated to hold, or sent itself.
    pub(super) held: IntervalSet,
    /// Those and the ones in flight: what need not be sent now. It has room for both; and those that a full ledger forgot since the last request.
    pub(super) covered: IntervalSet,
    /// For a relay that is not first in line: what stayed missing for the whole relay delay.
    pub(super) overdue: IntervalSet,
    /// What was missing at some earlier request, and when that was.
    pub(super) missing_then: (Stamp, IntervalSet),
    pub(super) sending: Option<Sending>,
    pub(super) state_wanted: Option<PeerWish>,
}

/// A present state that the peer wants.
#[derive(Clone, Debug)]
pub(super) struct PeerWish {
    /// Since this package, or an earlier one.
    pub(super) since: u32,
    /// It should contain some of these.
    pub(super) undecodable: IntervalSet,
    /// How long it has said so.
    pub(super) stated_since: Stamp,
}

impl View {
    pub(super) const fn new(from: u32, now: Stamp) -> Self {
        Self {
            from,
            held: IntervalSet::new(VIEW_INTERVALS_MAX),
            covered: IntervalSet::new(VIEW_INTERVALS_MAX),
            overdue: IntervalSet::new(VIEW_INTERVALS_MAX),
            missing_then: (now, IntervalSet::new(VIEW_INTERVALS_MAX)),
            sending: None,
            state_wanted: None,
        }
    }

    /// The peer proved to hold this package. A view that is too fragmented to note it learns it from the next request.
    pub(super) fn note_held(&mut self, index: u32) {
        let _ = self.held.insert(index);
        let _ = self.covered.insert(index);
    }
}

/// Whether there is a sign of life of a robot: it is heard here, or by a peer.
pub(super) fn is_heard(peers: &BTreeMap<RobotId, Peer>, robot: RobotId) -> bool {
    peers.contains_key(&robot) || peers.values().any(|peer| peer.lists(robot))
}

/// Whether its robot flies in another run, or is not heard at all. That run may have no packages yet, and so no place in any store.
pub(super) fn has_no_robot(peers: &BTreeMap<RobotId, Peer>, run: Stream) -> bool {
    match peers.get(&run.origin) {
        Some(peer) => peer.stream != run,
        None => !peers.values().any(|peer| peer.hears.contains(&(run.origin, run.epoch as u16))),
    }
}

#[derive(Debug)]
pub(super) struct Peer {
    pub(super) stream: Stream,
    pub(super) last_heard: Stamp,
    first_heard: Stamp,
    /// Smoothed pause between its datagrams in microseconds, each burst taken as one.
    pause: i64,
    /// Newest send stamp of any of its datagrams, and when that one was received.
    pub(super) newest_stamp: Stamp,
    pub(super) newest_stamp_at: Stamp,
    /// Send stamp and time of receipt of its last request, once there was one.
    pub(super) request: Option<(Stamp, Stamp)>,
    /// Whom it hears, with the low bits of the run's epoch, by its last request; whether that list was whole.
    pub(super) hears: Vec<(RobotId, u16)>,
    pub(super) hears_all_listed: bool,
    /// Number + 1 of the origins that its requests have covered so far: of these it holds no run that it has not named.
    covered: IntervalSet,
    /// Runs that it named and that had no place here then, until their origin is covered again: of these it holds something. At most
    /// [`UNPLACED_MAX`].
    unplaced: BTreeSet<Stream>,
    /// It has room for streams that it does not name.
    pub(super) takes_new_streams: bool,
    /// The epochs below which it wants no run, of robots of which something is known here.
    pub(super) oldest_wanted: BTreeMap<RobotId, u64>,
    pub(super) clocks: Vec<crate::wire::ClockReport>,
    pub(super) views: BTreeMap<Stream, View>,
    /// The ledger: what is on its way to it. Also of streams of which it takes nothing now: it may have room when that arrives.
    pub(super) in_flight: VecDeque<Sent>,
    /// Not before this a tile is offered to it of a set that it does not take.
    pub(super) offer_at: Stamp,
    /// What to send next, best first, if nothing changes.
    pub(super) queue: VecDeque<Item>,
    /// The queue has to be made anew: something changed, or it was cut to its bound.
    pub(super) queue_stale: bool,
    pub(super) round_trip: RoundTrip,
    pub(super) clock: ClockFilter,
    pub(super) loss: Loss,
    pub(super) pacer: Option<Pacer>,
    /// A datagram of packages for it waits for its link's budget; and how many requests to everyone went out meanwhile.
    pub(super) overtaken: Option<u8>,
    pub(super) path: PeerPath,
    pub(super) traffic_in: Traffic,
    pub(super) traffic_out: Traffic,
}

impl Peer {
    pub(super) fn new(stream: Stream, now: Stamp, config: &SessionConfig) -> Self {
        Self {
            stream,
            last_heard: now,
            first_heard: now,
            pause: 1_000_000,
            newest_stamp: Stamp(i64::MIN),
            newest_stamp_at: now,
            request: None,
            hears: Vec::new(),
            hears_all_listed: false,
            covered: IntervalSet::new(COVERED_INTERVALS_MAX),
            unplaced: BTreeSet::new(),
            takes_new_streams: false,
            oldest_wanted: BTreeMap::new(),
            clocks: Vec::new(),
            views: BTreeMap::new(),
            in_flight: VecDeque::new(),
            offer_at: now,
            queue: VecDeque::new(),
            queue_stale: false,
            round_trip: RoundTrip::new(i64::from(config.round_trip_initial_ms) * 1_000),
            clock: ClockFilter::default(),
            loss: Loss::default(),
            pacer: config
                .link_bytes_per_s
                .map(|rate| Pacer::new(rate, super::burst_bytes(rate, config.burst_ms))),
            overtaken: None,
            path: PeerPath::default(),
            traffic_in: Traffic::default(),
            traffic_out: Traffic::default(),
        }
    }

    /// Notes that something of it was heard.
    pub(super) fn note_heard(&mut self, now: Stamp) {
        let pause = now.micros_since(self.last_heard);
        if pause >= BURST {
            self.pause += (pause - self.pause) / 8;
        }
        self.last_heard = now;
    }

    /// Whether it may not have said yet whom it hears.
    pub(super) const fn is_new(&self, now: Stamp) -> bool {
        now.micros_since(self.first_heard) < ACQUAINTANCE
    }

    /// Whether it has said nothing for far longer than usual: then most of what is sent to it is sent in vain.
    pub(super) fn is_silent(&self, now: Stamp) -> bool {
        now.micros_since(self.last_heard) > (SILENT_PAUSES * self.pause).max(SILENT_MIN)
    }

    /// Whether the peer hears this robot; assumed if its list was cut.
    pub(super) fn hears(&self, robot: RobotId) -> bool {
        self.request.is_some() && (!self.hears_all_listed || self.lists(robot))
    }

    /// Whether its last request names this robot among those that it hears.
    fn lists(&self, robot: RobotId) -> bool {
        self.hears.iter().any(|(heard, _)| *heard == robot)
    }

    /// Whether the peer wants packages of this stream at all.
    pub(super) fn wants(&self, stream: Stream) -> bool {
        stream != self.stream
            && self.oldest_wanted.get(&stream.origin).is_none_or(|oldest| stream.epoch >= *oldest)
    }

    /// Notes that a request named every run of these origins that the peer holds something of.
    pub(super) fn note_covered(&mut self, covered: Covered) {
        let (first, last) = (u32::from(covered.first.0) + 1, u32::from(covered.last.0) + 1);
        let parts =
            if first <= last { [(first, last), (first, last)] } else { [(first, 1 << 16), (1, last)] };
        for (low, high) in parts {
            // A peer that covers single origins all over the range is covered again later.
            let _ = self.covered.insert_range(low, high);
        }
        self.unplaced.retain(|run| !covered.contains(run.origin));
    }

    /// Forgets what it holds and is sent of a stream that has no place here any more.
    pub(super) fn forget(&mut self, stream: Stream) {
        if self.views.remove(&stream).is_some_and(|view| !view.held.is_empty()) {
            self.note_unplaced(stream);
        }
        self.in_flight.retain(|sent| sent.item.stream() != stream);
    }

    /// Notes that it holds something of a run that has no place here. Beyond the limit it may be sent what it holds, should there be one.
    pub(super) fn note_unplaced(&mut self, run: Stream) {
        if self.unplaced.len() < UNPLACED_MAX {
            self.unplaced.insert(run);
        }
    }

    /// Whether of a stream that it has not named it holds nothing, and may be sent it.
    pub(super) fn takes_unnamed(&self, stream: Stream) -> bool {
        self.takes_new_streams
            && self.covered.contains(u32::from(stream.origin.0) + 1)
            && !self.unplaced.contains(&stream)
    }

    /// What is known of the peer's holdings of a stream. A stream that it did not name, where it names all, is
    /// one of which it holds nothing.
    pub(super) fn view(&mut self, stream: Stream, now: Stamp) -> Option<&mut View> {
        if self.takes_unnamed(stream) && !self.views.contains_key(&stream) {
            let mut view = View::new(1, now);
            // What went out while it took nothing of the stream may find room now.
            self.in_flight.iter().filter(|sent| sent.item.stream() == stream).for_each(|sent| {
                view.cover(sent.item);
            });
            self.views.insert(stream, view);
        }
        self.views.get_mut(&stream)
    }
}

/// What [`Session::peers`](crate::Session::peers) tells of a peer.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[non_exhaustive]
pub struct PeerInfo {
    /// The peer and its run.
    pub stream: Stream,
    /// When it was last heard, on the own clock.
    pub last_heard: Stamp,
    /// Whether it hears this robot, as far as its last request tells.
    pub hears_us: bool,
    /// Smoothed round trip in microseconds, once measured.
    pub round_trip_micros: Option<i64>,
    /// Its clock minus the own clock in microseconds: as given, else as measured.
    pub clock_offset_micros: Option<i64>,
    /// Packages sent to it and not yet confirmed.
    pub in_flight: usize,
    /// Heard from it.
    pub traffic_in: Traffic,
    /// Sent to it alone.
    pub traffic_out: Traffic,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_that_was_named_before_it_had_a_place_is_not_one_of_which_nothing_is_held() {
        let run = |id| Stream { origin: RobotId(id), epoch: 1 };
        let now = Stamp(0);
        let mut peer = Peer::new(run(2), now, &SessionConfig::default());
        peer.takes_new_streams = true;
        let all = Covered::all_from(RobotId(0));
        peer.note_covered(all);
        peer.note_unplaced(run(8));
        assert!(peer.view(run(8), now).is_none());
        assert!(peer.view(run(7), now).is_some());
        // What covers others says nothing of it.
        peer.note_covered(Covered { first: RobotId(9), last: RobotId(7) });
        assert!(peer.view(run(8), now).is_none());
        peer.note_covered(all);
        assert!(peer.view(run(8), now).is_some(), "not named any more");
        (0..2 * UNPLACED_MAX as u16).for_each(|id| peer.note_unplaced(run(id)));
        assert_eq!(peer.unplaced.len(), UNPLACED_MAX);
    }
}
