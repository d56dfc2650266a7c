//! Requests that come in: what the peer holds, what of the packages sent to it is lost, whose turn it is to answer.

use super::Session;
use super::peer::{Item, Peer, PeerWish, Sent, VIEW_INTERVALS_MAX, View};
use super::present::OFFER_PAUSE;
use crate::wire::{DatagramHeader, Request, TransferProgress};
use crate::{Cast, InFlight, IntervalSet, Relay};
use flockmap_grid::mutation::{self, Mutation};
use flockmap_grid::{Stamp, Stream};
use std::collections::BTreeSet;

/// A stamp below an earlier one means that the datagram was overtaken on the way, since the clock of a run never goes back. But the earlier
/// one may be false where there is no key: then it counts for so long.
const UNSEALED_STAMP_COUNTS: i64 = 5_000_000;

/// A peer that got one package in so many of those that it missed one relay delay ago is being served.
const SERVED_SHARE: u64 = 16;

impl Session {
    pub(super) fn handle_request(&mut self, now: Stamp, header: &DatagramHeader, request: &Request) {
        let id = header.sender.origin;
        let Some(mut peer) = self.peers.remove(&id) else { return };
        let overtaken =
            |(newest, at): (Stamp, Stamp)| header.stamp <= newest && self.stamp_counts(now.micros_since(at));
        if peer.request.is_some_and(overtaken) {
            self.counters.stale_requests += 1;
        } else {
            peer.request = Some((header.stamp, now));
            let echo = self.take_echoes(now, &mut peer, header, request);
            self.take_holdings(now, &mut peer, header, request);
            // A run that it names may have displaced another one. That was forgotten of the peers in the table, where this one is not just now.
            let gone = |stream: &&Stream| self.store.held(**stream).is_none();
            let gone: Vec<Stream> = peer.views.keys().filter(gone).copied().collect();
            for stream in gone {
                peer.forget(stream);
            }
            self.settle_in_flight(now, &mut peer, request, echo);
            let streams: Vec<Stream> = self.store.streams().collect();
            for stream in streams {
                self.note_overdue(now, &mut peer, stream, request);
                self.review_present_state(now, &mut peer, stream);
            }
            peer.queue_stale = true;
        }
        self.peers.insert(id, peer);
    }

    /// Whether a stamp that came so many microseconds ago still tells which datagrams are older.
    pub(super) const fn stamp_counts(&self, age: i64) -> bool {
        self.config.swarm_key.is_some() || age < UNSEALED_STAMP_COUNTS
    }

    /// Takes in whom the peer hears. If it hears this robot: the stamp that came back and how long the peer had it.
    fn take_echoes(
        &mut self,
        now: Stamp,
        peer: &mut Peer,
        header: &DatagramHeader,
        request: &Request,
    ) -> Option<(Stamp, i64)> {
        peer.hears = request.echoes.iter().map(|echo| (echo.robot, echo.epoch_low)).collect();
        peer.hears_all_listed = request.all_echoes;
        peer.clocks.clone_from(&request.clocks);
        let own = |echo: &&crate::wire::Echo| {
            echo.robot == self.own.origin && echo.epoch_low == self.own.epoch as u16
        };
        let echo = request.echoes.iter().find(own)?;
        let (sent, age) = (echo.stamp(now), i64::from(echo.age_micros));
        peer.round_trip.sample(now.micros_since(sent) - age);
        peer.clock.sample(sent, header.stamp.plus_micros(-age), header.stamp, now);
        if let Some(offset) = peer.clock.offset()
            && self.store.held(peer.stream).is_some()
        {
            self.measured_offsets.insert(peer.stream, offset);
        }
        Some((sent, age))
    }

    /// By broadcast a peer may have given its place to a set that another peer is sent, and ignores the one for itself. If that helps it as well, it
    /// is sent that one: else both would wait for ever. A set of which it has all tiles, or that begins after what it needs, would not help.
    fn send_what_has_a_place(
        &self,
        now: Stamp,
        view: &mut View,
        progress: &TransferProgress,
        request: &Request,
    ) {
        let (stream, set) = (progress.stream, progress.set);
        let named = |set: u32| {
            let is_it = |t: &TransferProgress| (t.source, t.stream, t.set) == (self.own.origin, stream, set);
            request.transfers.iter().any(is_it)
        };
        let since_max = view.state_wanted.as_ref().map_or(u32::MAX, |wanted| wanted.since);
        if self.config.cast == Cast::Broadcast
            && !progress.is_complete()
            && view.sending.as_ref().is_some_and(|sending| !named(sending.set))
            && let Some(outgoing) = self.outgoing.iter().find(|o| o.stream == stream && o.set == set)
            && outgoing.since <= since_max
            && outgoing.helps(&view.held)
        {
            view.sending = Some(outgoing.sending(now));
        }
    }

    /// Takes in what the peer holds of each stream.
    fn take_holdings(&mut self, now: Stamp, peer: &mut Peer, header: &DatagramHeader, request: &Request) {
        let is_overtaken = header.stamp < peer.newest_stamp;
        peer.takes_new_streams = !request.no_new_streams;
        peer.oldest_wanted.retain(|&origin, _| !request.covers(origin) && self.store.has_runs(origin));
        if let Some(covered) = request.covered {
            peer.note_covered(covered);
            peer.views.retain(|stream, view| {
                let is_named = request.held.iter().any(|held| held.stream == *stream);
                // Not named: nothing is held any more, as after a lost store. But what came in later datagrams of the peer it did not
                // hold yet when it made this request.
                if !is_named && covered.contains(stream.origin) && !is_overtaken {
                    view.held = IntervalSet::new(VIEW_INTERVALS_MAX);
                    view.from = 1;
                }
                is_named || peer.takes_new_streams || !covered.contains(stream.origin)
            });
        }
        for stated in &request.held {
            self.note_own_id(now, stated.stream);
            // Also where there is no place for it here.
            if stated.is_oldest_wanted && self.store.has_runs(stated.stream.origin) {
                peer.oldest_wanted.insert(stated.stream.origin, stated.stream.epoch);
            }
            if stated.stream == self.own {
                // Nobody but this robot can say which own packages there are.
                if stated.held.last() > Some(self.store.newest_known(self.own)) {
                    self.note_own_run_used(now);
                }
            } else if !self.open_stream(stated.stream) {
                peer.note_unplaced(stated.stream);
                continue;
            } else if let Some(newest) = stated.held.last()
                && self.store.note_newest(stated.stream, newest, now)
            {
                self.note_gap(now, false);
            }
            let view = peer.views.entry(stated.stream).or_insert_with(|| View::new(stated.from, now));
            // Of what lies below the list, the last word still holds.
            let below = view.held.within(0, stated.from.saturating_sub(1));
            if mutation::is(Mutation::HoldingsIgnored) {
                continue;
            }
            view.held = if is_overtaken {
                // What came in later datagrams of the peer it did not hold yet when it made this request.
                view.held.union(&stated.held)
            } else if stated.from > 1 {
                below.union(&stated.held)
            } else {
                stated.held.clone()
            };
            view.from = view.from.min(stated.from).max(view.held.keep_newest(VIEW_INTERVALS_MAX));
        }
        for (&stream, view) in &mut peer.views {
            let wanted = request.states_wanted.iter().find(|wanted| wanted.stream == stream);
            let since = view.state_wanted.as_ref().map_or(now, |wanted| wanted.stated_since);
            // A wish that found no room this time stands on until its origin is covered.
            if wanted.is_some() || request.covers(stream.origin) {
                view.state_wanted = wanted.map(|wanted| PeerWish {
                    since: wanted.since,
                    undecodable: wanted.undecodable.clone(),
                    stated_since: since,
                });
            }
        }
        let own = self.own.origin;
        for progress in request.transfers.iter().filter(|progress| progress.source == own) {
            let Some(view) = peer.views.get_mut(&progress.stream) else { continue };
            self.send_what_has_a_place(now, view, progress, request);
            if let Some(sending) = view.sending.as_mut().filter(|sending| sending.set == progress.set) {
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

    /// Goes through all that is in flight to the peer: confirmed, lost or still under way.
    fn settle_in_flight(
        &mut self,
        now: Stamp,
        peer: &mut Peer,
        request: &Request,
        echo: Option<(Stamp, i64)>,
    ) {
        let patience = self.config.patience(peer.round_trip.variation());
        let timeout = peer.round_trip.timeout();
        let is_lost = |sent: &Sent| match self.config.in_flight {
            InFlight::PreviousRequest => sent.requests >= 2,
            InFlight::RoundTrip => match echo.filter(|(stamp, _)| *stamp >= sent.at) {
                // The peer has heard something sent with it or later: how long has it waited since?
                Some((stamp, age)) => stamp.micros_since(sent.at) + age >= patience,
                None => now.micros_since(sent.at) >= timeout,
            },
        };
        let (mut confirmed, mut lost) = (0, 0);
        let own = self.own.origin;
        let is_named = |stream: Stream, set: u32| {
            request.transfers.iter().any(|t| (t.source, t.stream, t.set) == (own, stream, set))
        };
        let mut unheeded = BTreeSet::new();
        let mut in_flight = std::mem::take(&mut peer.in_flight);
        in_flight.retain_mut(|sent| {
            let stream = sent.item.stream();
            let Some(view) = peer.views.get(&stream).filter(|_| peer.wants(stream)) else {
                // It takes nothing of that stream: whether it arrived it does not say.
                sent.requests = sent.requests.saturating_add(1);
                return !is_lost(sent);
            };
            let (held, stated) = match sent.item {
                Item::Package { stream, index } => {
                    let named = request.held.iter().find(|held| held.stream == stream);
                    (
                        view.held.contains(index),
                        named.map_or_else(|| request.covers(stream.origin), |held| index >= held.from),
                    )
                }
                Item::Tile { set, tile, .. } => match &view.sending {
                    Some(sending) if sending.set == set => (sending.accepted.contains(tile + 1), true),
                    _ => (true, true),
                },
            };
            if held {
                confirmed += 1;
                return false;
            }
            sent.requests = sent.requests.saturating_add(u8::from(stated));
            let gone = stated && is_lost(sent);
            lost += u64::from(gone);
            if let Item::Tile { set, .. } = sent.item
                && gone
                && !is_named(stream, set)
            {
                unheeded.insert((stream, set));
            }
            !gone
        });
        peer.in_flight = in_flight;
        for (stream, set) in unheeded {
            let sending = peer.views.get_mut(&stream).and_then(|view| view.sending.as_mut());
            if let Some(sending) = sending.filter(|sending| sending.set == set) {
                sending.note_unheeded(now);
                if sending.is_ignored() {
                    peer.offer_at = now.plus_micros(OFFER_PAUSE);
                }
            }
        }
        self.counters.confirmed += confirmed;
        self.counters.lost += lost;
        peer.loss.sample(confirmed, lost);

        for view in peer.views.values_mut() {
            view.covered = view.held.with_room(VIEW_INTERVALS_MAX + 2 * self.config.in_flight_max);
            if let Some(sending) = &mut view.sending {
                sending.covered = sending.accepted.clone();
            }
        }
        for sent in &peer.in_flight {
            if let Some(view) = peer.views.get_mut(&sent.item.stream()) {
                view.cover(sent.item);
            }
        }
    }

    /// For a relay that is not first in line: what was missing at a request one relay delay ago, and still is.
    fn note_overdue(&mut self, now: Stamp, peer: &mut Peer, stream: Stream, request: &Request) {
        let Some(turn) = self.turn(peer, stream) else { return };
        let Some(held) = self.store.held(stream) else { return };
        let delay = i64::from(turn) * i64::from(self.config.relay_delay_ms) * 1_000;
        let Some(view) = peer.view(stream, now) else { return };
        if turn == 0 {
            return;
        }
        let mut missing = held.within(view.from.max(1), u32::MAX).difference(&view.held);
        missing.keep_newest(VIEW_INTERVALS_MAX);
        if now.micros_since(view.missing_then.0) >= delay {
            let then = &view.missing_then.1;
            let still = then.intersection(&missing);
            // Where much of it has come meanwhile, or is coming as a present state, somebody is at it. One that is complete brings no more:
            // it waits for packages before it.
            let own = self.own.origin;
            let is_coming = |t: &TransferProgress| t.stream == stream && t.source != own && !t.is_complete();
            let is_served = request.transfers.iter().any(is_coming)
                || (then.count() - still.count()) * SERVED_SHARE > then.count();
            view.overdue = if is_served { IntervalSet::new(VIEW_INTERVALS_MAX) } else { still };
            view.missing_then = (now, missing);
        } else {
            view.overdue = view.overdue.intersection(&missing);
        }
    }

    /// This robot's place in the line of those who answer a peer for a stream: 0 answers at once, the next ones
    /// each a relay delay later. `None`: it does not answer at all.
    pub(super) fn turn(&self, peer: &Peer, stream: Stream) -> Option<u32> {
        if !peer.wants(stream) {
            return None;
        }
        if stream.origin == self.own.origin {
            return Some(0);
        }
        match self.config.relay {
            Relay::Never => None,
            Relay::Always => Some(0),
            Relay::Ranked => {
                // A new peer has not said yet whom it hears: probably the same robots as this one.
                let hears =
                    |robot| peer.hears(robot) || (peer.is_new(self.now) && self.peers.contains_key(&robot));
                let hears_origin = stream.origin != peer.stream.origin && hears(stream.origin);
                // Whom this robot does not hear stands elsewhere in the swarm, and rarely holds the same.
                let before = |robot| {
                    robot < self.own.origin && robot != stream.origin && self.peers.contains_key(&robot)
                };
                let others = peer.hears.iter().filter(|(robot, _)| before(*robot)).count() as u32;
                Some(u32::from(hears_origin) + others)
            }
        }
    }
}
