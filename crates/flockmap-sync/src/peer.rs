//! What a session knows of one peer.

mod stream;

pub(crate) use stream::{PEER_INTERVALS_MAX, PeerStream, Sending, SentPackage, brings_rest};

use crate::config::ms;
use crate::counters::Traffic;
use crate::inbox::ABANDONED;
use crate::item::Item;
use crate::link::{ClockFilter, Loss, RoundTrip};
use crate::pacer::Pacer;
use crate::path::PeerPath;
use crate::rate::{Arrival, QueueingDelays};
use crate::wire::OriginRange;
use crate::{IntervalSet, SessionConfig};
use core::time::Duration;
use flockmap_grid::{RobotId, Stamp, Stream};
use flockmap_mutation::{self as mutation, Mutation};
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// Intervals kept of the origins that a peer has covered.
const ORIGIN_INTERVALS_MAX: usize = 256;
/// Runs noted that a peer holds and that have no place here.
pub(crate) const UNPLACED_MAX: usize = 128;

/// Datagrams that follow each other within this time are one burst.
const BURST_MICROS: i64 = 100_000;
/// A peer is silent after so many of its usual pauses. Of a radio that loses every second datagram, one pause
/// in thousands is that long.
const SILENT_PAUSES: i64 = 8;
/// And not before this time.
const SILENT_MIN_MICROS: i64 = 1_500_000;

/// Of the pauses that a peer announces so many may pass in silence before it is forgotten …
const PAUSES_MISSED: u32 = 3;
/// … and none counts for longer.
const NEXT_WITHIN_MAX: Duration = Duration::from_secs(600);
/// A robot has heard those in reach, and said so, after this time.
const ACQUAINTANCE: Duration = Duration::from_secs(1);

/// Whether there is a sign of life of a robot: it is heard here, or by a peer.
pub(crate) fn is_heard(peers: &BTreeMap<RobotId, Peer>, robot: RobotId) -> bool {
    peers.contains_key(&robot) || peers.values().any(|peer| peer.lists(robot))
}

/// Whether its robot flies in another run, or is not heard at all. That run may have no packages yet, and so
/// no place in any store.
pub(crate) fn has_no_robot(peers: &BTreeMap<RobotId, Peer>, run: Stream) -> bool {
    match peers.get(&run.origin) {
        Some(peer) => peer.stream != run,
        None => !peers.values().any(|peer| peer.hears.get(&run.origin) == Some(&(run.epoch as u16))),
    }
}

#[derive(Debug)]
pub(crate) struct Peer {
    pub(crate) stream: Stream,
    pub(crate) last_heard: Stamp,
    first_heard: Stamp,
    /// Smoothed pause between its datagrams, each burst taken as one.
    pause_micros: i64,
    /// Newest send stamp of any of its datagrams, and when that one was received.
    pub(crate) newest_stamp: Stamp,
    pub(crate) newest_stamp_at: Stamp,
    /// Send stamp and time of receipt of its last request, once there was one.
    pub(crate) request: Option<(Stamp, Stamp)>,
    /// Within which it said that it will be heard again; zero: as usual.
    pub(crate) next_within: Duration,
    /// Whom it hears, with the low bits of the run's epoch, by its last request; whether that list was whole.
    pub(crate) hears: BTreeMap<RobotId, u16>,
    pub(crate) hears_all_listed: bool,
    /// It has met others since it said last whom it hears.
    pub(crate) is_meeting: bool,
    /// It was told that it is heard.
    pub(crate) is_greeted: bool,
    /// Number + 1 of the origins that its requests have covered so far: of these it holds no run that it has
    /// not named.
    origins: IntervalSet,
    /// Runs that it named and that had no place here then, until their origin is covered again: of these it
    /// holds something. At most [`UNPLACED_MAX`].
    unplaced: BTreeSet<Stream>,
    /// It has room for streams that it does not name.
    pub(crate) takes_new_streams: bool,
    /// The epochs below which it wants no run, of robots of which something is known here.
    pub(crate) oldest_wanted: BTreeMap<RobotId, u64>,
    pub(crate) clocks: Vec<crate::wire::ClockReport>,
    pub(crate) streams: BTreeMap<Stream, PeerStream>,
    /// The ledger: what is in flight to it. Also of streams of which it takes nothing now: it may have room
    /// when that arrives.
    pub(crate) in_flight: VecDeque<SentPackage>,
    /// Of what was in flight, what goes out again before anything is known of it. At most 64.
    pub(crate) repeating: BTreeSet<Item>,
    /// Not before this a chunk is offered to it of a snapshot that it does not take.
    pub(crate) offer_at: Stamp,
    /// What to send next, best first, if nothing changes.
    pub(crate) queue: VecDeque<Item>,
    /// The queue has to be made anew: something changed, or it was cut to its bound.
    pub(crate) queue_stale: bool,
    /// The streams of which this robot may have to send it something, as long as it says nothing new: in a crowd few.
    pub(crate) planned: Vec<Stream>,
    /// Those have to be found anew.
    pub(crate) planned_stale: bool,
    /// Of robots that it hears, and this robot too, so many have a lower id.
    pub(crate) relays_before: u32,
    pub(crate) round_trip: RoundTrip,
    pub(crate) clock: ClockFilter,
    pub(crate) loss: Loss,
    /// Queueing delay of datagrams to it and from it.
    pub(crate) queueing: QueueingDelays,
    /// How long its last datagram queued.
    pub(crate) queued_in: Duration,
    pub(crate) arrival: Option<Arrival>,
    pub(crate) pacer: Option<Pacer>,
    /// A datagram of packages for it waits for its link's budget; and how many requests to everyone went out
    /// meanwhile.
    pub(crate) superseded: Option<u8>,
    pub(crate) path: PeerPath,
    pub(crate) traffic_in: Traffic,
    pub(crate) traffic_out: Traffic,
}

impl Peer {
    pub(crate) fn new(stream: Stream, now: Stamp, config: &SessionConfig) -> Self {
        Self {
            stream,
            last_heard: now,
            first_heard: now,
            pause_micros: 1_000_000,
            newest_stamp: Stamp(i64::MIN),
            newest_stamp_at: now,
            request: None,
            next_within: Duration::ZERO,
            hears: BTreeMap::new(),
            hears_all_listed: false,
            is_meeting: false,
            is_greeted: false,
            origins: IntervalSet::new(ORIGIN_INTERVALS_MAX),
            unplaced: BTreeSet::new(),
            takes_new_streams: false,
            oldest_wanted: BTreeMap::new(),
            clocks: Vec::new(),
            streams: BTreeMap::new(),
            in_flight: VecDeque::new(),
            repeating: BTreeSet::new(),
            offer_at: now,
            queue: VecDeque::new(),
            queue_stale: true,
            planned: Vec::new(),
            planned_stale: true,
            relays_before: 0,
            round_trip: RoundTrip::new(ms(config.round_trip_initial_ms)),
            clock: ClockFilter::default(),
            loss: Loss::default(),
            queueing: QueueingDelays::default(),
            queued_in: Duration::ZERO,
            arrival: None,
            pacer: config
                .link_bytes_per_s
                .map(|rate| Pacer::new(rate, crate::pacer::burst_bytes(rate, config.burst_ms))),
            superseded: None,
            path: PeerPath::default(),
            traffic_in: Traffic::default(),
            traffic_out: Traffic::default(),
        }
    }

    /// Notes that something of it was heard.
    pub(crate) fn note_heard(&mut self, now: Stamp) {
        let pause = now.micros_since(self.last_heard);
        if pause >= BURST_MICROS {
            self.pause_micros += (pause - self.pause_micros) / 8;
        }
        self.last_heard = now;
    }

    /// Not heard for so long it is forgotten.
    pub(crate) fn timeout(&self, config: &SessionConfig) -> Duration {
        ms(config.peer_timeout_ms).max(self.announced_pauses())
    }

    /// A snapshot to or from it of which nothing comes for so long is given up.
    pub(crate) fn transfer_patience(&self) -> Duration {
        ABANDONED.max(self.announced_pauses())
    }

    /// So many of the pauses that it announced may pass.
    fn announced_pauses(&self) -> Duration {
        PAUSES_MISSED * self.next_within.min(NEXT_WITHIN_MAX)
    }

    /// When it is forgotten if nothing is heard of it until then.
    pub(crate) fn lost_at(&self, config: &SessionConfig) -> Stamp {
        self.last_heard.plus(self.timeout(config))
    }

    /// Whether it may not have said yet whom it hears.
    pub(crate) fn is_new(&self, now: Stamp, peers: usize) -> bool {
        // The more there are, the longer it takes.
        now.since(self.first_heard) < ACQUAINTANCE * (1 + peers as u32 / 4)
    }

    /// Whether it has said nothing for far longer than usual: then most of what is sent to it is sent in vain.
    pub(crate) fn is_silent(&self, now: Stamp) -> bool {
        now.micros_since(self.last_heard) > (SILENT_PAUSES * self.pause_micros).max(SILENT_MIN_MICROS)
    }

    /// Whether the peer hears this robot; assumed if its list was cut.
    pub(crate) fn hears(&self, robot: RobotId) -> bool {
        self.request.is_some() && (!self.hears_all_listed || self.lists(robot))
    }

    /// Whether it hears what this robot hears of another one, by broadcast.
    pub(crate) fn hears_too(&self, robot: RobotId) -> bool {
        self.stream.origin != robot && self.hears_all_listed && self.hears(robot)
    }

    /// Whether its last request names this robot among those that it hears.
    fn lists(&self, robot: RobotId) -> bool {
        self.hears.contains_key(&robot)
    }

    /// What it says of streams is another now.
    pub(crate) const fn plan_anew(&mut self) {
        (self.queue_stale, self.planned_stale) = (true, true);
    }

    /// Whether something may be for it.
    pub(crate) fn has_to_do(&self) -> bool {
        self.queue_stale || !self.queue.is_empty() || self.superseded.is_some()
    }

    /// Whether this robot may have to send it something of a stream.
    pub(crate) fn is_planned(&self, stream: Stream) -> bool {
        self.planned_stale || self.planned.contains(&stream)
    }

    /// Whether the peer wants packages of this stream at all.
    pub(crate) fn wants(&self, stream: Stream) -> bool {
        stream != self.stream
            && self.oldest_wanted.get(&stream.origin).is_none_or(|oldest| stream.epoch >= *oldest)
    }

    /// Notes that a request named every run of these origins that the peer holds something of.
    pub(crate) fn note_origins(&mut self, origins: OriginRange) {
        let (first, last) = (u32::from(origins.first.0) + 1, u32::from(origins.last.0) + 1);
        let parts =
            if first <= last { [(first, last), (first, last)] } else { [(first, 1 << 16), (1, last)] };
        for (low, high) in parts {
            // A peer that covers single origins all over the range is covered again later.
            let _ = self.origins.insert_range(low, high);
        }
        self.unplaced.retain(|run| !origins.contains(run.origin));
    }

    /// Notes that it holds something of a run that has no place here. Beyond the limit it may be sent what it
    /// holds, should there be one.
    pub(crate) fn note_unplaced(&mut self, run: Stream) {
        if self.unplaced.len() < UNPLACED_MAX {
            self.unplaced.insert(run);
        }
    }

    /// Whether of a stream that it has not named it holds nothing, and may be sent it.
    pub(crate) fn takes_unnamed(&self, stream: Stream) -> bool {
        self.takes_new_streams
            && self.origins.contains(u32::from(stream.origin.0) + 1)
            && !self.unplaced.contains(&stream)
    }

    /// What is known of the peer's holdings of a stream. A stream that it did not name, where it names all, is
    /// one of which it holds nothing.
    pub(crate) fn theirs(&mut self, stream: Stream, now: Stamp) -> Option<&mut PeerStream> {
        if !self.streams.contains_key(&stream) && self.takes_unnamed(stream) {
            let mut theirs = PeerStream::new(1, now);
            // What went out while it took nothing of the stream may find room now.
            self.in_flight.iter().filter(|sent| sent.item.stream() == stream).for_each(|sent| {
                theirs.cover(sent.item);
            });
            self.streams.insert(stream, theirs);
        }
        self.streams.get_mut(&stream)
    }
}

impl Peer {
    /// Notes that an item goes out and is in flight to the peer: also one that it states to hold or has no
    /// place for, since it may take back either before the item arrives. One that is in flight already counts
    /// from now. Of more than `in_flight_max` the oldest is forgotten if it would count as lost by now; else
    /// the new one is not noted, and only kept back until the next request.
    pub(crate) fn cover(&mut self, item: Item, now: Stamp, in_flight_max: usize) {
        let stream = item.stream();
        if stream == self.stream || mutation::is(Mutation::LedgerIgnored) {
            return;
        }
        let theirs = self.theirs(stream, now);
        if let Item::Chunk { snapshot_id, .. } = item
            && theirs
                .as_ref()
                .and_then(|theirs| theirs.sending.as_ref())
                .is_none_or(|sending| sending.snapshot_id != snapshot_id)
        {
            // It is not sent this set.
            return;
        }
        let is_held = theirs.as_ref().is_some_and(|theirs| theirs.holds(item));
        let is_new = theirs.is_some_and(|theirs| theirs.cover(item));
        let mut is_repeated = self.repeating.remove(&item) || is_held;
        if let Some(at) = self.in_flight.iter().rposition(|sent| !is_new && sent.item == item) {
            self.in_flight.remove(at);
            is_repeated = true;
        }
        let timeout = self.round_trip.timeout();
        if self.in_flight.len() >= in_flight_max
            && self.in_flight.front().is_some_and(|oldest| now.since(oldest.at) >= timeout)
        {
            self.in_flight.pop_front();
        }
        if self.in_flight.len() < in_flight_max || mutation::is(Mutation::WindowIgnored) {
            self.in_flight.push_back(SentPackage {
                item,
                at: now,
                is_repeated,
                is_heard: false,
                requests: 0,
            });
        }
    }

    /// Something is not in flight any more: finds anew what it holds or has in flight.
    pub(crate) fn cover_anew(&mut self, in_flight_max: usize) {
        for theirs in self.streams.values_mut() {
            if theirs.received_or_in_flight.intervals() != theirs.received.intervals() {
                theirs.received_or_in_flight =
                    theirs.received.with_room(PEER_INTERVALS_MAX + 2 * in_flight_max);
            }
            if let Some(sending) = &mut theirs.sending {
                sending.received_or_in_flight = sending.accepted.clone();
            }
        }
        for sent in &self.in_flight {
            if let Some(theirs) = self.streams.get_mut(&sent.item.stream()) {
                theirs.cover(sent.item);
            }
        }
    }

    /// Notes that the peer hears an item from another robot, if there is room; whether it was missing.
    pub(crate) fn cover_heard(&mut self, item: Item, now: Stamp, in_flight_max: usize) -> bool {
        if self.in_flight.len() >= in_flight_max
            || !self.wants(item.stream())
            || self.theirs(item.stream(), now).is_none()
        {
            return false;
        }
        let is_news = self.lacks(item);
        self.cover(item, now, in_flight_max);
        if let Some(sent) = self.in_flight.back_mut().filter(|sent| sent.item == item) {
            sent.is_heard = true;
        }
        is_news
    }

    /// When the newest was sent of what it has confirmed by now: of what this robot sent, and of what others did.
    pub(crate) fn newest_that_came(&self) -> [Option<Stamp>; 2] {
        let has_come = |item: Item| self.streams.get(&item.stream()).is_some_and(|theirs| theirs.holds(item));
        [false, true].map(|is_heard| {
            let sent = self.in_flight.iter().filter(|sent| sent.is_heard == is_heard && !sent.is_repeated);
            sent.filter(|sent| has_come(sent.item)).map(|sent| sent.at).max()
        })
    }

    /// Whether an item is still missing and not in flight, and can be noted as being in flight.
    pub(crate) fn lacks(&self, item: Item) -> bool {
        let (received_or_in_flight, number) = match (self.streams.get(&item.stream()), item) {
            (Some(theirs), Item::Package { index, .. }) => (&theirs.received_or_in_flight, index),
            (Some(PeerStream { sending: Some(sending), .. }), Item::Chunk { snapshot_id, chunk, .. })
                if sending.snapshot_id == snapshot_id =>
            {
                (&sending.received_or_in_flight, chunk + 1)
            }
            _ => return false,
        };
        !received_or_in_flight.contains(number) && received_or_in_flight.has_room_for(number)
    }
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
        let all = OriginRange::all_from(RobotId(0));
        peer.note_origins(all);
        peer.note_unplaced(run(8));
        assert!(peer.theirs(run(8), now).is_none());
        assert!(peer.theirs(run(7), now).is_some());
        // What covers others says nothing of it.
        peer.note_origins(OriginRange { first: RobotId(9), last: RobotId(7) });
        assert!(peer.theirs(run(8), now).is_none());
        peer.note_origins(all);
        assert!(peer.theirs(run(8), now).is_some(), "not named any more");
        (0..2 * UNPLACED_MAX as u16).for_each(|id| peer.note_unplaced(run(id)));
        assert_eq!(peer.unplaced.len(), UNPLACED_MAX);
    }

    #[test]
    fn what_is_heard_from_others_pushes_nothing_that_was_sent_out_of_the_ledger() {
        let robot = |id| Stream { origin: RobotId(id), epoch: 1 };
        let item = |id, index| Item::Package { stream: robot(id), index };
        let mut peer = Peer::new(robot(2), Stamp(0), &SessionConfig::default());
        peer.takes_new_streams = true;
        peer.note_origins(OriginRange::all_from(RobotId(0)));
        peer.cover(item(1, 1), Stamp(0), 6);
        for index in 1..=20 {
            let is_noted = peer.cover_heard(item(3, index), Stamp(1), 6);
            assert_eq!(is_noted, index <= 5, "the ledger has room for six");
        }
        assert_eq!((peer.in_flight.len(), peer.in_flight[0].item), (6, item(1, 1)));
        // What goes out itself takes the place of what would count as lost by now, and no other.
        peer.cover(item(1, 2), Stamp(2), 6);
        assert_eq!((peer.in_flight.len(), peer.in_flight[0].item), (6, item(1, 1)));
        assert!(!peer.lacks(item(1, 2)), "it is kept back until the next request");
        peer.cover(item(1, 2), Stamp(0).plus(peer.round_trip.timeout()), 6);
        assert_eq!((peer.in_flight.len(), peer.in_flight[5].item), (6, item(1, 2)));
    }
}
