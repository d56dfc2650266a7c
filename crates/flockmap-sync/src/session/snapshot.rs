//! Snapshots: the map as it is, sent in place of the packages that made it.

use super::Session;
use crate::event::Event;
use crate::item::Item;
use crate::outbox::{Coming, Outgoing};
use crate::peer::{Peer, Sending, has_no_robot};
use crate::store::Missing;
use crate::wire::CONTENTS_BYTES_MAX;
use crate::{Cast, IntervalSet};
use core::time::Duration;
use flockmap_codec::{ContentKind, Package};
use flockmap_grid::{RobotId, Stamp, Stream};
use flockmap_mutation::{self as mutation, Mutation};

/// Of snapshots that a peer ignores single chunks are offered, with this pause: who has no place for a
/// snapshot is not to be sent it over and over.
pub(super) const OFFER_PAUSE: Duration = Duration::from_secs(5);

/// Of a run that has ended, a gap is taken for one that nobody fills when nothing new has come for so long.
const GAP_STANDS: Duration = Duration::from_secs(10);
/// Longest chunk of a state of a history with gaps: what it contains goes with every chunk.
const PARTS_CHUNK_BYTES_MAX: usize = flockmap_codec::PACKAGE_BYTES_MAX - CONTENTS_BYTES_MAX;

/// The driver is asked again for the state of a stream after so long; where there was no room for it, and
/// after it declined, later.
const ASK_AGAIN: Duration = Duration::from_secs(2);
const ASK_AGAIN_NO_ROOM: Duration = Duration::from_secs(5);
const ASK_AGAIN_DECLINED: Duration = Duration::from_secs(30);

impl Session {
    /// The answer to [`Event::SnapshotWanted`]: the layer of the stream, or what of it is newer, as chunks,
    /// all of one snapshot, all with `since` and the index `upto` of the event. No chunks: there is none to
    /// give now; it is asked for again later. Chunks that cannot be used are counted and dropped.
    ///
    /// It may come some calls later ([`Self::snapshot_is_coming`]): what it says is the layer as it was when the event
    /// was taken, or at some time since. Of each stream only one can be on its way.
    pub fn provide_snapshot(&mut self, now: Stamp, stream: Stream, chunks: Vec<Package>) {
        let now = self.advance(now);
        let held = self.outbox.held_when_asked.remove(&stream);
        if self.outbox.coming.remove(&stream).is_some_and(|coming| coming.until.is_some()) {
            self.mark_queues_stale();
        }
        let Some(outgoing) = self.check_chunks(now, stream, chunks, held) else {
            self.outbox.asked.insert(stream, now.plus(ASK_AGAIN_DECLINED));
            return;
        };
        self.outbox
            .snapshots
            .retain(|other| other.stream != stream || other.snapshot_id != outgoing.snapshot_id);
        if !self.make_room_for_chunks(outgoing.bytes) {
            self.outbox.asked.insert(stream, now.plus(ASK_AGAIN_NO_ROOM));
            return;
        }
        self.outbox.snapshots.push(outgoing);
        let ids: Vec<RobotId> = self.peers.keys().copied().collect();
        for id in ids {
            self.review_snapshot(now, id, stream);
        }
    }

    /// The snapshot of a stream that was asked for is being made: for the next 2 s it is not asked for again, and who
    /// needs it is not sent the packages that it contains.
    pub fn snapshot_is_coming(&mut self, now: Stamp, stream: Stream) {
        let now = self.advance(now);
        let Some(coming) = self.outbox.coming.get_mut(&stream) else { return };
        let until = now.plus(ASK_AGAIN);
        if coming.until.replace(until).is_none() {
            self.mark_queues_stale();
        }
        self.outbox.asked.insert(stream, until);
    }

    /// Drops snapshots that nobody is sent, those first that were not used for longest. What is in flight to
    /// a peer that speaks of it stays: snapshots that push each other out are never complete anywhere.
    fn make_room_for_chunks(&mut self, bytes: usize) -> bool {
        loop {
            let received: usize = self.outbox.snapshots.iter().map(|outgoing| outgoing.bytes).sum();
            if received + bytes <= self.config.snapshot_bytes_max {
                return true;
            }
            let is_idle = |at: &usize| {
                let Outgoing { stream, snapshot_id, .. } = self.outbox.snapshots[*at];
                let streams = self.peers.values().filter_map(|peer| peer.streams.get(&stream));
                let mut sendings = streams.filter_map(|theirs| theirs.sending.as_ref());
                !sendings.any(|sending| sending.snapshot_id == snapshot_id && !sending.is_ignored())
            };
            let idle = (0..self.outbox.snapshots.len()).filter(is_idle);
            let Some(oldest) = idle.min_by_key(|&at| self.outbox.snapshots[at].used_at) else { return false };
            self.outbox.snapshots.remove(oldest);
        }
    }

    /// `held`: where the history has gaps, what was held of it when the snapshot was asked for.
    fn check_chunks(
        &mut self,
        now: Stamp,
        stream: Stream,
        chunks: Vec<Package>,
        held: Option<IntervalSet>,
    ) -> Option<Outgoing> {
        let first = chunks.first()?.header();
        let (is_in_part, changed_upto) = (first.lost_upto.is_some(), first.changed_upto);
        let newest_of = first.newest_of();
        let (upto, count) = (first.index, chunks.len() as u32);
        let ContentKind::Snapshot { since, id: snapshot_id, .. } = first.content else {
            self.report.counters.snapshots_unusable += 1;
            return None;
        };
        let bytes = chunks.iter().map(|chunk| chunk.bytes().len()).sum();
        let longest = self.package_bytes_max();
        let received = self.store.received(stream)?;
        // One of a history with gaps says by itself no more than its newest package.
        let is_whole = received.contains_range(1, upto);
        let held = if is_whole { None } else { held };
        let contents = held.map(|held| held.within(1, upto));
        let is_sound = contents.as_ref().is_some_and(|held| since + 1 == upto && held.contains(upto));
        let usable = bytes <= self.config.snapshot_bytes_max
            && (is_whole || is_sound)
            && (0..).zip(&chunks).all(|(number, chunk)| {
                chunk.header().stream == stream
                    && chunk.header().index == upto
                    && chunk.bytes().len() <= longest
                    && chunk.header().content
                        == ContentKind::Snapshot { since, id: snapshot_id, chunk: number, chunks: count }
            });
        if !usable {
            self.report.counters.snapshots_unusable += 1;
            return None;
        }
        Some(Outgoing {
            stream,
            snapshot_id,
            since,
            upto,
            contents,
            is_in_part,
            changed_upto,
            newest_of,
            chunks,
            bytes,
            used_at: now,
        })
    }

    /// Decides whether a peer gets the snapshot of a stream, or of a part of its history, instead of packages.
    pub(super) fn review_snapshot(&mut self, now: Stamp, id: RobotId, stream: Stream) {
        let Some(theirs) = self.peers.get_mut(&id).and_then(|peer| peer.theirs(stream, now)) else { return };
        // A snapshot that had to go for others is sent to nobody any more.
        theirs.sending.take_if(|sending| self.outbox.snapshot(stream, sending.snapshot_id).is_none());
        if self.goes_on_with_parts(now, id, stream) {
            return;
        }
        // Who asks this robot is answered, whatever its place in the line of relays.
        let relay_rank = self.peers.get(&id).and_then(|peer| self.relay_rank(peer, stream));
        self.review_rest(now, id, stream, relay_rank.is_some());
        if let Some(relay_rank) = relay_rank {
            self.review_whole(now, id, stream, relay_rank);
            self.review_parts(now, id, stream, relay_rank);
        }
    }

    /// Whether a state of a history with gaps is in flight to a peer that still lacks some of it.
    fn goes_on_with_parts(&mut self, now: Stamp, id: RobotId, stream: Stream) -> bool {
        let patience = self.transfer_patience(id);
        let Some(theirs) = self.peers.get_mut(&id).and_then(|peer| peer.theirs(stream, now)) else {
            return false;
        };
        let Some(sending) = &theirs.sending else { return false };
        let of_set = self.outbox.snapshot(stream, sending.snapshot_id);
        let Some(contents) = of_set.and_then(|outgoing| outgoing.contents.as_ref()) else { return false };
        let wanted = theirs.snapshot_request().map(|wanted| wanted.undecodable.intersection(contents));
        let goes_on =
            !contents.difference(&theirs.received).is_empty() || wanted.is_some_and(|w| !w.is_empty());
        theirs.sending.take_if(|_| !goes_on);
        theirs.sending.iter_mut().for_each(|sending| sending.note_silence(now, patience));
        goes_on
    }

    /// What is held beyond a gap that nobody fills comes as a state of all that is held, if it is not stored:
    /// of runs that have ended.
    fn review_parts(&mut self, now: Stamp, id: RobotId, stream: Stream, relay_rank: u32) {
        let Some(received) = self.store.received(stream) else { return };
        let beyond = received.within(received.prefix().saturating_add(2), u32::MAX);
        // Where what was dropped may be of packages beyond the gap, it goes for those before it too.
        let beyond = if self.can_give(stream, received.prefix()) { beyond } else { received.clone() };
        let (Some(upto), Some(touched)) = (beyond.last(), self.store.touched(stream)) else { return };
        if !self.can_give(stream, upto) {
            return;
        }
        let is_withheld = mutation::is(Mutation::GapStatesWithheld);
        if !self.has_ended(stream) || now.since(touched) < GAP_STANDS || is_withheld {
            return;
        }
        let delay = self.config.relay_delay(relay_rank);
        let Some(theirs) = self.peers.get(&id).and_then(|peer| peer.streams.get(&stream)) else { return };
        if theirs.sending.is_some() {
            return;
        }
        let mut lacks = beyond.difference(&theirs.received);
        if relay_rank > 0 {
            lacks = lacks.intersection(&theirs.overdue);
        }
        let request = theirs.snapshot_request().filter(|request| now.since(request.stated_since) >= delay);
        let request = request.map(|request| request.undecodable.intersection(&beyond));
        if self.store.first_unstored(stream, &lacks).is_none()
            && request.is_none_or(|request| request.is_empty())
        {
            return;
        }
        let has_it = |o: &Outgoing| {
            let rest = o.contents.as_ref().map(|contents| beyond.difference(contents));
            o.stream == stream && rest.is_some_and(|rest| rest.is_empty())
        };
        if let Some(at) = self.outbox.snapshots.iter().rposition(has_it) {
            self.begin_to_send(now, id, at);
        } else {
            let (since, bytes_max) = (upto - 1, PARTS_CHUNK_BYTES_MAX);
            let (newer_than, in_pieces) = (None, false);
            let wanted =
                Event::SnapshotWanted { stream, since, newer_than, upto, bytes_max, in_pieces, peer: id };
            let held = Some(received.clone());
            self.request_snapshot(now, stream, wanted, held);
        }
    }

    /// Whether its robot has begun a later run, or nobody here hears it in this one.
    fn has_ended(&self, stream: Stream) -> bool {
        stream != self.identity.own && (self.store.is_superseded(stream) || has_no_robot(&self.peers, stream))
    }

    /// Asks the driver for a state of a stream, unless that was done a moment ago. `held`: what is held of a history
    /// with gaps.
    pub(super) fn request_snapshot(
        &mut self,
        now: Stamp,
        stream: Stream,
        wanted: Event,
        held: Option<IntervalSet>,
    ) {
        let Event::SnapshotWanted { since, upto, peer, .. } = wanted else { return };
        let coming = self.outbox.coming.get_mut(&stream);
        let is_coming = coming.is_some_and(|coming| {
            let is_coming = coming.until.is_some_and(|until| until > now);
            if is_coming && coming.since <= since {
                coming.peers.insert(peer);
            }
            is_coming
        });
        if !is_coming && self.outbox.asked.get(&stream).is_none_or(|&again| again <= now) {
            let peers = [peer].into();
            self.outbox.coming.insert(stream, Coming { since, upto, until: None, peers });
            // Of several events the driver may answer the first: what was held then, the layer holds in any case.
            if let Some(held) = held {
                self.outbox.held_when_asked.entry(stream).or_insert(held);
            }
            self.outbox.asked.insert(stream, now.plus(ASK_AGAIN));
            self.report.counters.snapshots_wanted += 1;
            self.push_event(wanted);
        }
    }

    /// What is held without a gap from the first package on.
    fn review_whole(&mut self, now: Stamp, id: RobotId, stream: Stream, relay_rank: u32) {
        let Some(received) = self.store.received(stream) else { return };
        let prefix = received.prefix();
        if prefix == 0 {
            return;
        }
        let (can_give, patience) = (self.can_give(stream, prefix), self.transfer_patience(id));
        let Some(peer) = self.peers.get_mut(&id) else { return };
        let Some(theirs) = peer.theirs(stream, now) else { return };
        // What of a request lies beyond what is held here is somebody else's to fulfil.
        let request = theirs.snapshot_request().and_then(|request| {
            Some((request.since, request.undecodable.within(1, prefix).last()?, request.stated_since))
        });
        let wanted = request.map(|(_, upto, _)| upto);
        let lacks = received.within(theirs.from.max(1), prefix).difference(&theirs.received);
        // All packages up to this one it has, or can get as they are.
        let mut since_max = self.store.first_unstored(stream, &lacks).map_or(u32::MAX, |first| first - 1);
        if let Some((since, ..)) = request {
            since_max = since_max.min(since);
        }
        if let Some(sending) = &mut theirs.sending {
            let is_piece = sending.pieces_upto > sending.upto;
            // What it cannot decode it states as held.
            let is_wanted = wanted.is_some_and(|upto| upto <= sending.upto)
                || request.is_some_and(|(since, ..)| is_piece && since < sending.upto)
                || theirs.rest_wanted.is_some_and(|rest| sending.brings_rest(&rest));
            // Of what lies above it the next one may be short.
            let is_sound = sending.since <= since_max;
            if is_sound && (is_wanted || !theirs.received.contains_range(1, sending.upto)) {
                sending.note_silence(now, patience);
                return;
            }
            theirs.sending = None;
        }
        // Packages would be of no use to who has a piece.
        let is_begun = theirs.received.prefix() < theirs.pieces_upto.min(prefix);
        let mut missing = lacks;
        if relay_rank > 0 {
            missing = missing.intersection(&theirs.overdue);
        }
        // Those further down the line wait whether others give it.
        let delay = self.config.relay_delay(relay_rank);
        let wanted = request.filter(|(.., at)| now.since(*at) >= delay).map(|(_, upto, _)| upto);
        let Some(first) = missing.first().into_iter().chain(wanted).min() else { return };
        // Where packages are stored and cost less than the state, it is the part that they cannot bring that
        // is wanted.
        since_max = if since_max == u32::MAX { first.saturating_sub(1) } else { since_max };
        let newer_than = self.store.newer_than(stream, since_max);
        let since = if newer_than.is_some() { since_max } else { 0 };
        let all = self.store.weigh(stream, &missing, prefix);
        let is_in_part =
            self.lost_upto(stream).is_some_and(|lost| newer_than.is_none_or(|limit| lost > limit));
        // The newest state at hand that will do, if any, shows what one costs.
        let at_hand = self.outbox.at_hand(stream, since_max, is_in_part);
        let estimate = at_hand.map_or(0, |at| self.outbox.snapshots[at].cost(since, prefix));
        // A snapshot that lacks something is no good where packages bring all.
        let is_worth =
            all.unstored || is_begun || (!is_in_part && self.config.snapshot_is_worth(&all, estimate));
        if !can_give || (wanted.is_none() && !is_worth) {
            return;
        }
        let at_hand = at_hand.filter(|&at| {
            // One that is on the air already costs nothing more; any other should not say much that is known.
            self.outbox.snapshots[at].is_near(since)
                || self.is_on_air(stream, self.outbox.snapshots[at].snapshot_id, id)
        });
        if let Some(at) = at_hand {
            if self.outbox.snapshots[at].changed_upto.is_some() {
                // One that is made now would be another piece.
                self.begin_to_send(now, id, at);
                return;
            }
            let (upto, cost) = (self.outbox.snapshots[at].upto, self.outbox.snapshots[at].bytes as u64);
            let received_or_in_flight = self.store.weigh(stream, &missing, upto);
            let rest = all.bytes - received_or_in_flight.bytes;
            let is_enough = match wanted {
                Some(wanted) => upto >= wanted,
                None => self.config.snapshot_is_worth(&received_or_in_flight, cost),
            };
            if received_or_in_flight.unstored == all.unstored
                && is_enough
                && rest <= (cost / 2).max(u64::from(self.config.snapshot_bytes_min.unwrap_or(0)))
            {
                self.begin_to_send(now, id, at);
                return;
            }
        }
        let bytes_max = self.package_bytes_max();
        let (upto, in_pieces) = (prefix, true);
        let wanted =
            Event::SnapshotWanted { stream, since, newer_than, upto, bytes_max, in_pieces, peer: id };
        self.request_snapshot(now, stream, wanted, None);
    }

    pub(super) fn begin_to_send(&mut self, now: Stamp, id: RobotId, at: usize) {
        let (Some(peer), Some(outgoing)) = (self.peers.get_mut(&id), self.outbox.snapshots.get_mut(at))
        else {
            return;
        };
        outgoing.used_at = now;
        if let Some(theirs) = peer.streams.get_mut(&outgoing.stream) {
            theirs.begin(outgoing.sending(now));
        }
        peer.plan_anew();
    }

    /// By broadcast: whether a snapshot is in flight to somebody else, so that everyone hears it.
    fn is_on_air(&self, stream: Stream, snapshot_id: u32, except: RobotId) -> bool {
        let gets_it = |peer: &Peer| {
            let sending = peer.streams.get(&stream).and_then(|theirs| theirs.sending.as_ref());
            peer.stream.origin != except && sending.is_some_and(|sending| sending.snapshot_id == snapshot_id)
        };
        self.config.cast == Cast::Broadcast && self.peers.values().any(gets_it)
    }

    /// Chunks of the snapshot in flight to the peer that are neither accepted nor in flight.
    pub(super) fn chunks_to_send(&self, stream: Stream, sending: &Sending) -> impl Iterator<Item = Item> {
        let snapshot_id = sending.snapshot_id;
        let count =
            self.outbox.snapshot(stream, snapshot_id).map_or(0, |outgoing| outgoing.chunks.len() as u32);
        sending
            .received_or_in_flight
            .missing(1, count)
            .flat_map(|(low, high)| low..=high)
            .map(move |number| Item::Chunk { stream, snapshot_id, chunk: number - 1 })
    }

    /// The chunks that a peer is sent: first those of snapshots that it speaks of. Of all snapshots that it
    /// ignores one chunk is in flight at a time.
    pub(super) fn plan_chunks(&self, now: Stamp, peer: &Peer, most: usize) -> Vec<Item> {
        let streams = peer.streams.iter().filter(|(stream, _)| peer.wants(**stream));
        let sendings = streams.filter_map(|(stream, theirs)| Some((*stream, theirs.sending.as_ref()?)));
        let (mut ignored, mut taken): (Vec<_>, Vec<_>) = sendings.partition(|(_, s)| s.is_ignored());
        taken.sort_by_key(|(_, sending)| sending.unheeded);
        ignored.sort_by_key(|(_, sending)| sending.lost_at);
        let is_ignored = |item| match item {
            Item::Chunk { stream, snapshot_id, .. } => {
                ignored.iter().any(|(of, s)| (*of, s.snapshot_id) == (stream, snapshot_id))
            }
            Item::Package { .. } => false,
        };
        let is_due = peer.offer_at <= now
            && !ignored.is_empty()
            && !peer.in_flight.iter().any(|sent| is_ignored(sent.item));
        let mut offers = ignored.iter().filter_map(|(stream, s)| self.chunks_to_send(*stream, s).next());
        let offer = if is_due { offers.next() } else { None };
        let chunks = taken.into_iter().flat_map(|(stream, sending)| self.chunks_to_send(stream, sending));
        chunks.take(most).chain(offer).collect()
    }
}

impl crate::SessionConfig {
    fn snapshot_is_worth(&self, missing: &Missing, cost: u64) -> bool {
        missing.unstored
            || self.snapshot_bytes_min.is_some_and(|min| missing.bytes > cost.max(u64::from(min)))
            || self.snapshot_range_max.is_some_and(|max| missing.range > max)
    }
}
