//! Obstacles where losses are high: peers are soon shown which were sent, ask sooner for what they lack, and where a third
//! is lost are sent everything twice. So one age of an obstacle in a hundred costs some round trips, not some periods.

use super::Session;
use crate::config::ms;
use crate::event::{Destination, Transmit};
use crate::item::Item;
use crate::link::LOSS_ONE;
use crate::peer::{Peer, SMALL_SWARM};
use crate::store::Store;
use crate::timers::Timer;
use crate::wire::{Kind, Request};
use core::time::Duration;
use flockmap_codec::Priority;
use flockmap_grid::Stamp;

/// On radios that carry less for a robot nothing hurries: all that is sent twice is missing elsewhere.
const BYTES_PER_S_MIN: u32 = 16_000;
/// Share of losses from which obstacles hurry …
const LOSS_MIN: u32 = LOSS_ONE / 20;
/// … and from which they are sent twice.
const TWICE_LOSS_MIN: u32 = LOSS_ONE / 3;
/// So many to a peer at once.
const TWICE_MAX: usize = 64;
/// The second time comes so much later.
const TWICE_AFTER: Duration = Duration::from_millis(20);
/// A probe takes some 64 bytes on the air. One goes out for each so many bytes of obstacles, no more.
const PROBE_EVERY: usize = 448;
/// Older obstacles do not hurry.
const FRESH_FOR: Duration = Duration::from_secs(2);
/// Whoever was probed hurries too, for so long.
const PROBED_FOR: Duration = Duration::from_secs(2);

impl Session {
    /// Whether obstacles hurry: in a small swarm, where a peer loses much, or says that this robot does.
    pub(super) fn hurries(&self, now: Stamp) -> bool {
        let rate = self.radio_bytes_per_s().into_iter().chain(self.config.link_bytes_per_s).min();
        self.config.hurry_obstacles
            && self.peers.len() <= SMALL_SWARM
            && rate.is_none_or(|rate| rate >= BYTES_PER_S_MIN)
            && (now.since(self.schedule.probed) < PROBED_FOR || self.loses(LOSS_MIN))
    }

    /// Part of the round trip that passes between two requests for a gap: an answer takes all of it, but either may be
    /// lost. What is asked for again while the answer is on its way is not sent again.
    pub(super) fn round_trip_parts(&self) -> u32 {
        if self.loses(TWICE_LOSS_MIN) { 4 } else { 2 }
    }

    fn loses(&self, share: u32) -> bool {
        self.peers.values().any(|peer| peer.loss.share() >= share)
    }

    /// Notes that packages go out.
    pub(super) fn note_hurry(&mut self, now: Stamp, items: &[Item], bytes: usize) {
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
        if !self.hurries(now) || !items.iter().any(|item| hurries(&self.store, now, *item)) {
            return;
        }
        if self.loses(TWICE_LOSS_MIN) {
            self.schedule.timers.set_sooner(Timer::Hurry, now.plus(TWICE_AFTER));
        } else if is_new {
            self.schedule.unprobed += bytes;
            if self.schedule.unprobed >= PROBE_EVERY {
                let variation = self.peers.values().map(|peer| peer.round_trip.variation()).max();
                // Then the peers need not wait for datagrams that overtake each other.
                let patience = self.config.patience(variation.unwrap_or_default()) + Duration::from_millis(1);
                self.schedule.timers.set(Timer::Hurry, self.schedule.probe_from.max(now.plus(patience)));
            }
        }
    }

    /// What is due of a hurry: what goes out again is put into the queues; else a probe, a short request that names
    /// nothing but the own run.
    pub(super) fn transmit_hurry(&mut self, now: Stamp) -> Option<Transmit> {
        self.schedule.timers.stop(Timer::Hurry);
        if self.loses(TWICE_LOSS_MIN) {
            self.repeat_obstacles(now);
            return None;
        }
        let received = vec![self.list_of(self.identity.own, now)];
        let request = Request {
            is_short: true,
            no_new_streams: self.store.is_full(),
            next_within_ms: self.next_within_ms(),
            epochs_low: true,
            received,
            ..Request::default()
        };
        let header = self.header(now, Kind::Request);
        let (bytes, _) = request.emit_in_order(header, self.plain_bytes_max(Kind::Request), 1);
        let each = bytes.len() + self.overhead(Kind::Request);
        let (to, copies) = (Destination::Everyone, self.copies(Destination::Everyone));
        if !self.spend(now, to, each, copies as usize) {
            // There is none to spare: the next packages show it.
            return None;
        }
        self.schedule.unprobed = 0;
        self.schedule.probe_from = now.plus(self.budget_pause(each, copies as usize, true));
        self.report.counters.requests_out.add(copies, each);
        self.report.counters.probes += 1;
        Some(Transmit { to, path: None, bytes })
    }

    /// Obstacles that are in flight to peers that lose every third datagram count as lost, once.
    fn repeat_obstacles(&mut self, now: Stamp) {
        let Self { peers, store, config, .. } = self;
        let before = now.plus_micros(-(TWICE_AFTER.as_micros() as i64));
        for peer in peers.values_mut().filter(|peer| peer.loss.share() >= TWICE_LOSS_MIN) {
            let goes = |sent: &&crate::peer::SentPackage| {
                !sent.is_repeated && sent.at <= before && hurries(store, now, sent.item)
            };
            peer.forget_repeated();
            let room = TWICE_MAX.saturating_sub(peer.repeating.len());
            let again = peer.in_flight.iter().filter(goes).map(|sent| sent.item);
            let again: Vec<Item> = again.take(room).collect();
            peer.send_again(&again, config.in_flight_max);
            self.report.counters.repeated += again.len() as u64;
        }
    }

    /// A peer shows which of its packages it has sent.
    pub(super) fn note_probed(&mut self, now: Stamp) {
        self.schedule.probed = now;
        if self.config.gap_requests {
            self.schedule.gap_tries = 0;
            let at = now.max(self.schedule.last.plus(self.schedule.short_pause));
            self.schedule.timers.set_sooner(Timer::Gap, at);
        }
    }

    /// How long to wait for datagrams that were overtaken, before something that is missing is asked for.
    pub(super) fn hurried_patience(&self, now: Stamp, variation: Duration) -> Duration {
        if self.hurries(now) {
            self.config.patience(variation).min((2 * variation).max(Duration::from_millis(5)))
        } else {
            self.config.patience(variation)
        }
    }

    /// Least pause between two requests for a gap, as far as their bytes allow it.
    pub(super) fn gap_pause_shortest(&self, now: Stamp, round_trip: Duration) -> Duration {
        let pause = ms(self.config.gap_request_pause_ms);
        if self.hurries(now) {
            (round_trip / self.round_trip_parts()).max(pause / 10)
        } else {
            pause.max(round_trip)
        }
    }
}

/// Whether it is a package with obstacles that a planner waits for. Who catches up waits for thousands.
fn hurries(store: &Store, now: Stamp, item: Item) -> bool {
    let Item::Package { stream, index } = item else { return false };
    store.get(stream, index).is_some_and(|stored| {
        stored.package.header().priority == Priority::Obstacles && now.since(stored.fresh_at) < FRESH_FOR
    })
}

impl Peer {
    /// What was to go out again and has come meanwhile.
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
