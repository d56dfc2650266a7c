//! Requests that come in: what the peer holds, what of the packages sent to it is lost, whose turn it is to
//! answer.

use super::Session;
use super::snapshot::OFFER_PAUSE;
use crate::config::ms;
use crate::crowd::SMALL_SWARM;
use crate::item::Item;
use crate::link::TIMEOUT_MAX;
use crate::outbox::Outbox;
use crate::peer::{PEER_INTERVALS_MAX, Peer, PeerStream, Sending, SentPackage};
use crate::rate::{Arrival, Rate};
use crate::timers::Timer;
use crate::wire::{DatagramHeader, Request, TransferProgress};
use crate::{Cast, InFlight, IntervalSet, Relay};
use core::time::Duration;
use flockmap_grid::{RobotId, Stamp, Stream};
use flockmap_mutation::{self as mutation, Mutation};
use std::collections::BTreeSet;

/// A stamp below an earlier one means that a later datagram came first, since the clock of a run never goes
/// back. But the earlier one may be false where there is no key: then it counts for so long.
const UNSEALED_STAMP_COUNTS: Duration = Duration::from_secs(5);

/// Of those whom a peer hears so many are kept.
const HEARS_MAX: usize = 256;

/// A peer that got one package in so many of those that it missed one relay delay ago is being served.
const SERVED_SHARE: u64 = 16;

impl Session {
    pub(super) fn handle_request(&mut self, now: Stamp, header: &DatagramHeader, request: &Request) {
        let id = header.sender.origin;
        let Some(peer) = self.peers.get(&id) else { return };
        let superseded =
            |(newest, at): (Stamp, Stamp)| header.stamp <= newest && self.stamp_counts(now.since(at));
        if peer.request.is_some_and(superseded) {
            self.report.counters.stale_requests += 1;
            return;
        }
        let was_unheard = self.is_unheard();
        let echo = self.take_echoes(now, header, request);
        if was_unheard && !self.is_unheard() {
            self.greet(now);
        }
        self.count_relays(Some(id));
        self.take_holdings(now, header, request);
        self.settle_in_flight(now, id, request, echo);
        let streams: Vec<Stream> = self.store.streams().collect();
        for stream in streams {
            if self.has_all(id, stream) {
                continue;
            }
            // What it says nothing of may have come long ago.
            if request.covers(stream.origin) || request.received.iter().any(|named| named.stream == stream) {
                self.note_overdue(now, id, stream, request);
            }
            if !self.is_left_to_others(id, stream) {
                self.review_snapshot(now, id, stream);
            }
        }
    }

    /// Whether a peer holds all of a stream that this robot holds, and wants no more: of most streams, most of the time.
    fn has_all(&self, id: RobotId, stream: Stream) -> bool {
        let theirs = self.peers.get(&id).and_then(|peer| peer.streams.get(&stream));
        let (Some(theirs), Some(received)) = (theirs, self.store.received(stream)) else { return false };
        let lacks = |&(low, high): &(u32, u32)| {
            let low = low.max(theirs.from).max(1);
            low <= high && !theirs.received.contains_range(low, high)
        };
        theirs.asks_for_nothing()
            && theirs.missing_then.1.is_empty()
            && !received.intervals().iter().any(lacks)
    }

    /// Whether others come first where a peer lacks something of a stream, and nothing of it is overdue.
    fn is_left_to_others(&self, id: RobotId, stream: Stream) -> bool {
        let Some(peer) = self.peers.get(&id) else { return false };
        let theirs = peer.streams.get(&stream);
        theirs.is_some_and(PeerStream::asks_for_nothing)
            && self.relay_rank(peer, stream).is_some_and(|rank| rank > 0)
    }

    /// Whether a stamp that came so long ago still shows which datagrams are older.
    pub(super) fn stamp_counts(&self, age: Duration) -> bool {
        self.config.swarm_key.is_some() || age < UNSEALED_STAMP_COUNTS
    }

    /// Takes in whom the peer hears. If it hears this robot: the stamp that came back and how long the peer
    /// had it.
    fn take_echoes(
        &mut self,
        now: Stamp,
        header: &DatagramHeader,
        request: &Request,
    ) -> Option<(Stamp, Duration)> {
        // A crowd echoes few stamps. Where a queue stood, the robots share a medium, and its queue is the same for all.
        let is_queue_shared = self.peers.len() > SMALL_SWARM
            && self.config.cast == Cast::Broadcast
            && self.outbox.rate.as_ref().is_some_and(|rate| !rate.in_slow_start());
        let peer = self.peers.get_mut(&header.sender.origin)?;
        peer.request = Some((header.stamp, now));
        peer.plan_anew();
        peer.next_within = ms(request.next_within_ms);
        self.schedule.timers.set_sooner(Timer::Silence, peer.lost_at(&self.config));
        let hears = request.echoes.iter().map(|echo| (echo.robot, echo.epoch_low));
        let hears = hears.chain(request.hears.iter().map(|run| (run.origin, run.epoch as u16)));
        if request.is_short {
            for (robot, epoch_low) in hears {
                peer.is_meeting |= peer.hears.insert(robot, epoch_low).is_none();
            }
            while peer.hears.len() > HEARS_MAX {
                peer.hears.pop_first();
            }
        } else {
            peer.hears = hears.collect();
            (peer.hears_all_listed, peer.is_meeting) = (request.all_echoes, false);
            peer.clocks.clone_from(&request.clocks);
        }
        let own = |echo: &&crate::wire::Echo| {
            echo.robot == self.identity.own.origin && echo.epoch_low == self.identity.own.epoch as u16
        };
        let echo = request.echoes.iter().find(own)?;
        let (sent, age) = (echo.stamp(now), Duration::from_micros(echo.age_micros.into()));
        if let Some(round_trip) = now.since(sent).checked_sub(age) {
            let sampled = |id: &RobotId| is_queue_shared || *id == header.sender.origin;
            for (_, peer) in self.peers.iter_mut().filter(|(id, _)| sampled(id)) {
                peer.round_trip.sample(round_trip);
            }
        }
        let peer = self.peers.get_mut(&header.sender.origin)?;
        let arrival = Arrival { sent, arrived: header.stamp.plus_micros(-i64::from(echo.age_micros)) };
        let queued = peer.queueing.sample_to(now, arrival.arrived.micros_since(sent));
        let before = peer.arrival.replace(arrival);
        if let Some(rate) = &mut self.outbox.rate {
            rate.note_arrival(now, arrival, before, queued);
        }
        peer.clock.sample(sent, header.stamp.plus_micros(-i64::from(echo.age_micros)), header.stamp, now);
        if let Some(offset) = peer.clock.offset()
            && self.store.received(peer.stream).is_some()
        {
            self.clocks.note_measured(peer.stream, offset);
        }
        Some((sent, age))
    }

    /// Takes in what the peer holds of each stream.
    fn take_holdings(&mut self, now: Stamp, header: &DatagramHeader, request: &Request) {
        let id = header.sender.origin;
        let Some(peer) = self.peers.get_mut(&id) else { return };
        let is_superseded = header.stamp < peer.newest_stamp;
        let is_named = |stream| request.received.iter().any(|received| received.stream == stream);
        if let Some(origins) = request.origins.filter(|_| !is_superseded) {
            let has_nothing_of = |stream: Stream| origins.contains(stream.origin) && !is_named(stream);
            self.report.counters.transfers_dropped += self.inbox.drop_forgotten(id, has_nothing_of);
        }
        peer.takes_new_streams = !request.no_new_streams;
        peer.oldest_wanted.retain(|&origin, _| !request.covers(origin) && self.store.has_runs(origin));
        if let Some(origins) = request.origins {
            peer.note_origins(origins);
            peer.streams.retain(|stream, theirs| {
                let is_named = is_named(*stream);
                // Not named: nothing is held any more, as after a lost store. But what came in later
                // datagrams of the peer it did not hold yet when it made this request.
                if !is_named && origins.contains(stream.origin) && !is_superseded {
                    theirs.received = IntervalSet::new(PEER_INTERVALS_MAX);
                    theirs.from = 1;
                    (theirs.in_part, theirs.rest_wanted) = (None, None);
                }
                is_named || peer.takes_new_streams || !origins.contains(stream.origin)
            });
        }
        let own = self.identity.own.origin;
        for stated in &request.received {
            self.note_own_id(now, stated.stream);
            let Some(peer) = self.peers.get_mut(&id) else { return };
            // Also where there is no place for it here.
            if stated.is_oldest_wanted && self.store.has_runs(stated.stream.origin) {
                peer.oldest_wanted.insert(stated.stream.origin, stated.stream.epoch);
            }
            if stated.stream == self.identity.own {
                // Nobody but this robot can say which own packages there are.
                if stated.received.last() > Some(self.store.newest_known(self.identity.own)) {
                    self.note_own_run_used(now);
                }
            } else if !self.open_stream(stated.stream) {
                if let Some(peer) = self.peers.get_mut(&id) {
                    peer.note_unplaced(stated.stream);
                }
                continue;
            } else if let Some(newest) = stated.received.last()
                && self.store.note_newest(stated.stream, newest, now)
            {
                match request.is_probe(id) && self.peers.len() <= SMALL_SWARM {
                    true => self.note_probed(now),
                    false => self.note_gap_told_by(now, id),
                }
            }
            let Some(peer) = self.peers.get_mut(&id) else { return };
            let theirs =
                peer.streams.entry(stated.stream).or_insert_with(|| PeerStream::new(stated.from, now));
            theirs.stated_at = now;
            theirs.in_part = stated.in_part.map(|in_part| in_part.wants_independent);
            let rest = stated.in_part.and_then(|in_part| in_part.rest);
            theirs.rest_wanted = rest.filter(|rest| rest.holder == own);
            // Of what lies below the list, the last request still holds.
            let below = theirs.received.within(0, stated.from.saturating_sub(1));
            if mutation::is(Mutation::HoldingsIgnored) {
                continue;
            }
            theirs.received = if is_superseded {
                // What came in later datagrams of the peer it did not hold yet when it made this request.
                theirs.received.union(&stated.received)
            } else if stated.from > 1 {
                below.union(&stated.received)
            } else {
                stated.received.clone()
            };
            theirs.from = theirs.from.min(stated.from).max(theirs.received.keep_newest(PEER_INTERVALS_MAX));
        }
        let Some(peer) = self.peers.get_mut(&id) else { return };
        for (&stream, theirs) in &mut peer.streams {
            let wanted = request.snapshot_requests.iter().find(|wanted| wanted.stream == stream);
            match wanted {
                Some(wanted) => theirs.note_snapshot_request(now, wanted),
                None if request.covers(stream.origin) => theirs.withdraw_snapshot_request(),
                // A request that found no room this time stands on until its origin is covered.
                None => {}
            }
        }
        let is_ours = |progress: &&TransferProgress| progress.source == self.identity.own.origin;
        for progress in request.transfers.iter().filter(is_ours) {
            let Some(theirs) = peer.streams.get_mut(&progress.stream) else { continue };
            if self.config.cast == Cast::Broadcast {
                send_what_has_a_place(now, theirs, progress, request, &self.outbox);
            }
            if let Some(sending) = theirs.sending.as_mut().filter(|s| s.snapshot_id == progress.snapshot_id) {
                sending.named_at = now;
                sending.unheeded = 0;
                sending.accepted = progress.accepted.clone();
                if progress.from > 1 {
                    // What the cut list does not name, it does not ask for either.
                    let below = IntervalSet::from_intervals(1, vec![(1, progress.from - 1)]);
                    sending.accepted = sending.accepted.union(&below);
                }
            }
        }
    }

    /// Goes through all that is in flight to the peer: confirmed, lost or still in flight.
    fn settle_in_flight(
        &mut self,
        now: Stamp,
        id: RobotId,
        request: &Request,
        echo: Option<(Stamp, Duration)>,
    ) {
        let timeout = self.round_trip_timeout(id);
        let is_crowd = self.peers.len() > SMALL_SWARM;
        let is_without_stamp = echo.is_none() && is_crowd;
        let others = self.peers.values().filter(|_| is_crowd);
        let farthest = others.map(|peer| peer.round_trip.timeout()).max().unwrap_or_default();
        let queue = self.outbox.rate.as_ref().filter(|_| is_crowd).map(Rate::queue);
        let (arrived_upto, queued_in) = queue.unwrap_or_default();
        let Some(peer) = self.peers.get_mut(&id) else { return };
        let patience = self.config.patience(peer.round_trip.variation());
        // What it says is as old as its request queued, and what was sent before that queued about as long.
        let timeout = timeout + 2 * peer.queued_in.max(queued_in);
        let newest_that_came = if is_without_stamp { peer.newest_that_came() } else { [None; 2] };
        let is_lost = |sent: &SentPackage| match self.config.in_flight {
            InFlight::PreviousRequest => sent.requests >= 2,
            // Nobody of a crowd has said that something sent later has come: it may be in the queue.
            InFlight::RoundTrip if arrived_upto.is_some_and(|upto| sent.at > upto) => {
                now.since(sent.at) >= timeout.max(farthest)
            }
            // What has come shows what was lost before it (as in RACK, RFC 8985).
            InFlight::RoundTrip if is_without_stamp => {
                let newest = newest_that_came[usize::from(sent.is_heard)];
                newest.is_some_and(|newest| newest.since(sent.at) >= patience)
                    || now.since(sent.at) >= timeout.max(farthest)
            }
            InFlight::RoundTrip => match echo.filter(|(stamp, _)| *stamp >= sent.at) {
                // The peer has heard something sent with it or later: how long has it waited since?
                Some((stamp, age)) => stamp.since(sent.at) + age >= patience,
                None => now.since(sent.at) >= timeout,
            },
        };
        let (mut confirmed, mut lost) = (0, 0);
        let rate = &mut self.outbox.rate;
        let mut note =
            |sent: Stamp, is_lost| rate.iter_mut().for_each(|rate| rate.note_outcome(now, sent, is_lost));
        let own = self.identity.own.origin;
        let is_named = |stream: Stream, snapshot_id: u32| {
            request
                .transfers
                .iter()
                .any(|t| (t.source, t.stream, t.snapshot_id) == (own, stream, snapshot_id))
        };
        let mut unheeded = BTreeSet::new();
        let mut in_flight = std::mem::take(&mut peer.in_flight);
        in_flight.retain_mut(|sent| {
            let stream = sent.item.stream();
            let Some(theirs) = peer.streams.get(&stream).filter(|_| peer.wants(stream)) else {
                // It takes nothing of that stream: whether it arrived it does not say.
                sent.requests = sent.requests.saturating_add(1);
                return !is_lost(sent);
            };
            let (received, stated) = match sent.item {
                Item::Package { stream, index } => {
                    let named = request.received.iter().find(|received| received.stream == stream);
                    (
                        theirs.received.contains(index),
                        named
                            .map_or_else(|| request.covers(stream.origin), |received| index >= received.from),
                    )
                }
                Item::Chunk { snapshot_id, chunk, .. } => match &theirs.sending {
                    Some(sending) if sending.snapshot_id == snapshot_id => {
                        (sending.accepted.contains(chunk + 1), true)
                    }
                    _ => (true, true),
                },
            };
            if received {
                confirmed += 1;
                note(sent.at, false);
                return false;
            }
            sent.requests = sent.requests.saturating_add(u8::from(stated));
            let gone = stated && is_lost(sent);
            lost += u64::from(gone);
            if gone {
                note(sent.at, true);
            }
            if let Item::Chunk { snapshot_id, .. } = sent.item
                && gone
                && !is_named(stream, snapshot_id)
            {
                unheeded.insert((stream, snapshot_id));
            }
            !gone
        });
        peer.in_flight = in_flight;
        for (stream, snapshot_id) in unheeded {
            let sending = peer.streams.get_mut(&stream).and_then(|theirs| theirs.sending.as_mut());
            if let Some(sending) = sending.filter(|sending| sending.snapshot_id == snapshot_id) {
                sending.note_unheeded(now);
                if sending.is_ignored() {
                    peer.offer_at = now.plus(OFFER_PAUSE);
                }
            }
        }
        self.report.counters.confirmed += confirmed;
        self.report.counters.lost += lost;
        if lost > 0 {
            let rate = self.radio_bytes_per_s();
            self.outbox.broadcasts.note_loss(now, self.peers.len(), rate);
        }
        let Some(peer) = self.peers.get_mut(&id) else { return };
        peer.loss.sample(confirmed, lost);

        peer.cover_anew(self.config.in_flight_max);
    }

    /// After this time without a sign of a peer, what was sent to it counts as lost. One that has not said yet when
    /// something came is taken to be as far as the farthest.
    fn round_trip_timeout(&self, id: RobotId) -> Duration {
        let measured = |peer: &Peer| peer.round_trip.mean().map(|_| peer.round_trip.timeout());
        let own = self.peers.get(&id).and_then(measured);
        let farthest = || self.peers.values().filter_map(measured).max();
        let unknown = || match self.peers.len() {
            0..=SMALL_SWARM => ms(self.config.round_trip_initial_ms),
            // Of many some would have said what has come if nothing queued.
            _ => TIMEOUT_MAX,
        };
        own.or_else(farthest).unwrap_or_else(unknown)
    }

    /// For a relay that is not first in line: what was missing at a request some relay delays ago, and still is.
    fn note_overdue(&mut self, now: Stamp, id: RobotId, stream: Stream, request: &Request) {
        let Some(relay_rank) = self.peers.get(&id).and_then(|peer| self.relay_rank(peer, stream)) else {
            return;
        };
        let patience = self.round_trip_timeout(id);
        let Some(received) = self.store.received(stream) else { return };
        let Some(theirs) = self.peers.get_mut(&id).and_then(|peer| peer.theirs(stream, now)) else { return };
        if relay_rank == 0 {
            return;
        }
        let mut missing = received.within(theirs.from.max(1), u32::MAX).difference(&theirs.received);
        missing.keep_newest(PEER_INTERVALS_MAX);
        let waits_for = self.holders_before(id, stream, &missing).unwrap_or(relay_rank);
        // Where answers take long, they are waited for as long.
        let delay = self.config.relay_delay(waits_for).max(waits_for.max(1) * 2 * patience);
        let Some(theirs) = self.peers.get_mut(&id).and_then(|peer| peer.streams.get_mut(&stream)) else {
            return;
        };
        if now.since(theirs.missing_then.0) >= delay {
            let then = &theirs.missing_then.1;
            let still = then.intersection(&missing);
            // Where much of it has come meanwhile, or is coming as a snapshot, somebody is at it. One that is
            // complete brings no more: it waits for packages before it.
            let own = self.identity.own.origin;
            let is_coming = |t: &TransferProgress| t.stream == stream && t.source != own && !t.is_complete();
            let is_served = request.transfers.iter().any(is_coming)
                || (then.count() - still.count()) * SERVED_SHARE > then.count();
            theirs.overdue = if is_served { IntervalSet::new(PEER_INTERVALS_MAX) } else { still };
            theirs.missing_then = (now, missing);
        } else {
            theirs.overdue = theirs.overdue.intersection(&missing);
        }
    }

    /// This robot's place in the line of those who answer a peer for a stream: 0 answers at once, the next ones
    /// each a relay delay later. `None`: it does not answer at all.
    pub(super) fn relay_rank(&self, peer: &Peer, stream: Stream) -> Option<u32> {
        if !peer.wants(stream) {
            return None;
        }
        if stream.origin == self.identity.own.origin {
            return Some(0);
        }
        match self.config.relay {
            Relay::Never => None,
            Relay::Always => Some(0),
            Relay::Ranked => {
                let others =
                    peer.relays_before.saturating_sub(u32::from(self.is_relay_before(peer, stream.origin)));
                Some(u32::from(self.is_origin_heard_by(peer, stream.origin)) + others)
            }
        }
    }

    /// Whether a peer hears another robot, which answers for its own streams before all relays. A new peer has not said yet
    /// whom it hears: probably the same robots as this one.
    fn is_origin_heard_by(&self, peer: &Peer, origin: RobotId) -> bool {
        let is_meeting = || peer.is_meeting || peer.is_new(self.clocks.now(), self.peers.len());
        origin != peer.stream.origin
            && (peer.hears(origin) || (self.peers.contains_key(&origin) && is_meeting()))
    }

    /// In a small swarm: how many of those who come before this robot may hold something of what a peer lacks: the origin,
    /// and whoever has said so. An origin that flies in a later run holds no more of a former one than it has said. O(peers).
    fn holders_before(&self, id: RobotId, stream: Stream, missing: &IntervalSet) -> Option<u32> {
        let peer = self.peers.get(&id).filter(|_| self.peers.len() <= SMALL_SWARM)?;
        let holds = |other: &Peer| {
            let theirs = other.streams.get(&stream);
            theirs.is_some_and(|theirs| !theirs.received.intersection(missing).is_empty())
        };
        let may_hold = |origin: &Peer| origin.stream == stream || holds(origin);
        let is_origin_before = self.is_origin_heard_by(peer, stream.origin)
            && self.peers.get(&stream.origin).is_none_or(may_hold);
        let relays = self.peers.iter().filter(|(robot, other)| {
            **robot != stream.origin && self.is_relay_before(peer, **robot) && holds(other)
        });
        Some(u32::from(is_origin_before) + relays.count() as u32)
    }

    /// Whether another robot comes before this one where a peer lacks what both have. Whom this robot does not hear stands
    /// elsewhere in the swarm, and rarely holds the same. Of whom a peer hears more than fit into its request it is not
    /// known.
    fn is_relay_before(&self, peer: &Peer, robot: RobotId) -> bool {
        robot < self.identity.own.origin
            && self.peers.contains_key(&robot)
            && (!peer.hears_all_listed || peer.hears.contains_key(&robot))
    }

    /// Counts for each peer, or for one, who comes before this robot. O(peers) for each.
    pub(super) fn count_relays(&mut self, of: Option<RobotId>) {
        let ids: Vec<RobotId> = of.map_or_else(|| self.peers.keys().copied().collect(), |id| vec![id]);
        for id in ids {
            let Some(peer) = self.peers.get(&id) else { continue };
            let count = self.peers.keys().filter(|robot| self.is_relay_before(peer, **robot)).count();
            if let Some(peer) = self.peers.get_mut(&id) {
                peer.relays_before = count as u32;
            }
        }
    }
}

/// By broadcast a peer may have given its place to a snapshot that another peer is sent, and ignores the one
/// for itself. If that helps it as well, it is sent that one: else both would wait for ever. A snapshot of
/// which it has all chunks, or that begins after what it needs, would not help.
fn send_what_has_a_place(
    now: Stamp,
    theirs: &mut PeerStream,
    progress: &TransferProgress,
    request: &Request,
    outbox: &Outbox,
) {
    let is_named = |sending: &Sending| {
        let id = (progress.source, progress.stream, sending.snapshot_id);
        request.transfers.iter().any(|t| (t.source, t.stream, t.snapshot_id) == id)
    };
    let since_max = theirs.snapshot_request().map_or(u32::MAX, |wanted| wanted.since);
    if !progress.is_complete()
        && theirs.sending.as_ref().is_some_and(|sending| !is_named(sending))
        && let Some(outgoing) = outbox.snapshot(progress.stream, progress.snapshot_id)
        && outgoing.since <= since_max
        && outgoing.helps(&theirs.received)
    {
        theirs.begin(outgoing.sending(now));
    }
}
