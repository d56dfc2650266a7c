//! Fast repair of obstacles where losses are high. Probes show the peers soon what was sent (as a tail loss probe does,
//! RFC 8985), gaps are asked for more often, and from a third of losses on obstacles are sent twice. A lost package then
//! costs some round trips, not some periods.

use super::Session;
use crate::config::ms;
use crate::crowd::SMALL_SWARM;
use crate::event::{Destination, Transmit};
use crate::item::Item;
use crate::link::LOSS_ONE;
use crate::peer::Peer;
use crate::store::Store;
use crate::timers::Timer;
use crate::wire::{Kind, Request};
use core::time::Duration;
use flockmap_codec::Priority;
use flockmap_grid::Stamp;

/// Least rate: on a thinner radio what is sent twice takes the place of what is not sent at all.
const RATE_MIN: u32 = 16_000;
/// Share of losses from which repair is fast …
const LOSS_MIN: u32 = LOSS_ONE / 20;
/// … and from which obstacles are sent twice.
const TWICE_LOSS_MIN: u32 = LOSS_ONE / 3;
/// At most so many to a peer at once …
const TWICE_MAX: usize = 64;
/// … the second time so much later.
const TWICE_AFTER: Duration = Duration::from_millis(20);
/// A probe takes some 64 bytes on the air. At most one goes out for every so many bytes of obstacles.
const PROBE_EVERY: usize = 448;
/// Older obstacles are repaired as everything else: who catches up lacks thousands of them.
const FRESH_FOR: Duration = Duration::from_secs(2);
/// A robot that was probed asks more often for so long.
const PROBED_FOR: Duration = Duration::from_secs(2);

impl Session {
    /// Whether repair is fast: in a small swarm, on a radio with room for it, where a peer loses much or has sent a probe.
    pub(super) fn repairs_fast(&self, now: Stamp) -> bool {
        let rate = self.radio_bytes_per_s().into_iter().chain(self.config.link_bytes_per_s).min();
        self.config.fast_repair
            && self.peers.len() <= SMALL_SWARM
            && rate.is_none_or(|rate| rate >= RATE_MIN)
            && (now.since(self.schedule.probed) < PROBED_FOR || self.loses(LOSS_MIN))
    }

    /// Requests for a gap in one round trip, since each may be lost. Those that come while the answer is in flight are not
    /// answered again.
    pub(super) fn requests_per_round_trip(&self) -> u32 {
        if self.loses(TWICE_LOSS_MIN) { 4 } else { 2 }
    }

    fn loses(&self, share: u32) -> bool {
        self.peers.values().any(|peer| peer.loss.share() >= share)
    }

    /// Packages go out: if obstacles are among them, a probe or their repetition is due.
    pub(super) fn note_obstacles_sent(&mut self, now: Stamp, items: &[Item], bytes: usize) {
        let own = self.identity.own;
        let newest = items.iter().filter_map(|item| match *item {
            Item::Package { stream, index } if stream == own => Some(index),
            _ => None,
        });
        let newest = newest.max().unwrap_or(0);
        if self.store.newest_known(own) < self.schedule.newest_sent {
            // A run begun anew.
            self.schedule.newest_sent = 0;
        }
        let is_new = newest > self.schedule.newest_sent;
        self.schedule.newest_sent = self.schedule.newest_sent.max(newest);
        if !self.repairs_fast(now) || !items.iter().any(|item| is_fresh_obstacle(&self.store, now, *item)) {
            return;
        }
        if self.loses(TWICE_LOSS_MIN) {
            self.schedule.timers.set_sooner(Timer::FastRepair, now.plus(TWICE_AFTER));
        } else if is_new {
            self.schedule.unprobed += bytes;
            if self.schedule.unprobed >= PROBE_EVERY {
                let variation = self.peers.values().map(|peer| peer.round_trip.variation()).max();
                // Late enough that the peers need not wait for reordered datagrams.
                let patience = self.config.patience(variation.unwrap_or_default()) + Duration::from_millis(1);
                self.schedule.timers.set(Timer::FastRepair, self.schedule.probe_from.max(now.plus(patience)));
            }
        }
    }

    /// Puts obstacles into the queues once more, or sends a probe: a short request that names nothing but the own run.
    pub(super) fn transmit_fast_repair(&mut self, now: Stamp) -> Option<Transmit> {
        self.schedule.timers.stop(Timer::FastRepair);
        if self.loses(TWICE_LOSS_MIN) {
            self.repeat_obstacles(now);
            return None;
        }
        let received = vec![self.list_of(self.identity.own, now)];
        let request = Request {
            is_short: true,
            no_new_streams: self.store.is_full(),
            next_within_ms: self.next_within_ms(now),
            newest_runs: vec![self.identity.own],
            received,
            ..Request::default()
        };
        let header = self.header(now, Kind::Request);
        let (bytes, _) = request.emit_in_order(header, self.plain_bytes_max(Kind::Request), 1);
        let each = bytes.len() + self.overhead(Kind::Request);
        let (to, copies) = (Destination::Everyone, self.copies(Destination::Everyone));
        if !self.spend(now, to, each, copies as usize) {
            // The budget has no room. The next packages show the gap, too.
            return None;
        }
        self.schedule.unprobed = 0;
        self.schedule.probe_from = now.plus(self.budget_pause(now, (each, copies as usize), true));
        self.report.counters.requests_out.add(copies, each);
        self.report.counters.probes += 1;
        Some(Transmit { to, path: None, bytes })
    }

    /// Obstacles in flight to peers that lose a third or more count as lost, once each.
    fn repeat_obstacles(&mut self, now: Stamp) {
        let Self { peers, store, config, .. } = self;
        let before = now.plus_micros(-(TWICE_AFTER.as_micros() as i64));
        for peer in peers.values_mut().filter(|peer| peer.loss.share() >= TWICE_LOSS_MIN) {
            let goes = |sent: &&crate::peer::SentPackage| {
                !sent.is_repeated && sent.at <= before && is_fresh_obstacle(store, now, sent.item)
            };
            peer.forget_repeated();
            let room = TWICE_MAX.saturating_sub(peer.repeating.len());
            let again = peer.in_flight.iter().filter(goes).map(|sent| sent.item);
            let again: Vec<Item> = again.take(room).collect();
            peer.send_again(&again, config.in_flight_max);
            self.report.counters.repeated += again.len() as u64;
        }
    }

    /// A probe has shown that something is missing here.
    pub(super) fn note_probed(&mut self, now: Stamp) {
        self.schedule.probed = now;
        if self.config.gap_requests {
            self.schedule.gap_tries = 0;
            let at = now.max(self.schedule.last.plus(self.short_pause(now)));
            self.schedule.timers.set_sooner(Timer::Gap, at);
        }
    }

    /// How long a gap may come of reordered datagrams, before it is asked for.
    pub(super) fn gap_patience(&self, now: Stamp, variation: Duration) -> Duration {
        if self.repairs_fast(now) {
            self.config.patience(variation).min((2 * variation).max(Duration::from_millis(5)))
        } else {
            self.config.patience(variation)
        }
    }

    /// Least pause between two requests for a gap, as far as their bytes allow it.
    pub(super) fn gap_pause_shortest(&self, now: Stamp, round_trip: Duration) -> Duration {
        let pause = ms(self.config.gap_request_pause_ms);
        if self.repairs_fast(now) {
            (round_trip / self.requests_per_round_trip()).max(pause / 10)
        } else {
            pause.max(round_trip)
        }
    }
}

fn is_fresh_obstacle(store: &Store, now: Stamp, item: Item) -> bool {
    let Item::Package { stream, index } = item else { return false };
    store.get(stream, index).is_some_and(|stored| {
        stored.package.header().priority == Priority::Obstacles && now.since(stored.fresh_at) < FRESH_FOR
    })
}

impl Peer {
    /// Drops what was to go out again and has arrived meanwhile.
    fn forget_repeated(&mut self) {
        let mut repeating = core::mem::take(&mut self.repeating);
        repeating.retain(|item| self.lacks(*item));
        self.repeating = repeating;
    }

    /// Counts items as not in flight, so that they are sent once more.
    fn send_again(&mut self, items: &[Item], in_flight_max: usize) {
        if items.is_empty() {
            return;
        }
        self.in_flight.retain(|sent| !items.contains(&sent.item));
        self.repeating.extend(items);
        self.cover_anew(in_flight_max);
        self.plan_anew();
    }
}
