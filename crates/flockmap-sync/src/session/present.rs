//! Present states: the map as it is, sent in place of the packages that made it.

use super::peer::{Item, Peer, Sending, VIEW_INTERVALS_MAX};
use super::{Event, Session};
use crate::IntervalSet;
use flockmap_codec::{ContentKind, Package};
use flockmap_grid::{RobotId, Stamp, Stream};

/// A present state that is being received.
#[derive(Debug)]
pub(super) struct Incoming {
    pub(super) source: RobotId,
    pub(super) stream: Stream,
    pub(super) upto: u32,
    pub(super) set: u32,
    pub(super) tiles: u32,
    /// Number + 1 of the tiles accepted.
    pub(super) accepted: IntervalSet,
    pub(super) touched: Stamp,
}

impl Incoming {
    /// Whether tiles of both belong together: cut by the same robot from the same state.
    pub(super) fn is_same(&self, other: &Self) -> bool {
        (self.source, self.stream, self.upto, self.set, self.tiles)
            == (other.source, other.stream, other.upto, other.set, other.tiles)
    }

    pub(super) const fn is_abandoned(&self, now: Stamp) -> bool {
        now.micros_since(self.touched) > 30_000_000
    }
}

/// A present state that can be sent, to several peers if they need it.
#[derive(Debug)]
pub(super) struct Outgoing {
    pub(super) stream: Stream,
    pub(super) set: u32,
    pub(super) upto: u32,
    pub(super) tiles: Vec<Package>,
    bytes: usize,
    pub(super) used_at: Stamp,
}

/// The driver is asked again for the state of a stream after so long; after it declined, later.
const ASK_AGAIN: i64 = 2_000_000;
const ASK_AGAIN_DECLINED: i64 = 30_000_000;

/// What a peer misses of a stream up to some index.
struct Missing {
    bytes: u64,
    /// Some of it is not stored any more.
    unstored: bool,
    range: u32,
}

impl Session {
    /// The answer to [`Event::PresentStateWanted`]: the layer of the stream as tiles, all of one set, all with
    /// the index `upto` of the event. No tiles: there is none to give now; it is asked for again later.
    /// Tiles that cannot be used are counted and dropped.
    pub fn provide_present_state(&mut self, now: Stamp, stream: Stream, tiles: Vec<Package>) {
        let now = self.advance(now);
        let Some(outgoing) = self.check_tiles(now, stream, tiles) else {
            self.present_asked.insert(stream, now.plus_micros(ASK_AGAIN_DECLINED));
            return;
        };
        self.outgoing.retain(|other| other.stream != stream || other.set != outgoing.set);
        self.outgoing.push(outgoing);
        while self.outgoing.iter().map(|o| o.bytes).sum::<usize>() > self.config.present_state_bytes_max {
            let oldest = (0..self.outgoing.len() - 1).min_by_key(|&at| self.outgoing[at].used_at);
            let Some(oldest) = oldest else { break };
            self.outgoing.remove(oldest);
        }
        let ids: Vec<RobotId> = self.peers.keys().copied().collect();
        for id in ids {
            if let Some(mut peer) = self.peers.remove(&id) {
                self.review_present_state(now, &mut peer, stream);
                self.peers.insert(id, peer);
            }
        }
    }

    fn check_tiles(&mut self, now: Stamp, stream: Stream, tiles: Vec<Package>) -> Option<Outgoing> {
        let first = tiles.first()?.header();
        let (upto, count) = (first.index, tiles.len() as u32);
        let ContentKind::Present { set, .. } = first.content else {
            self.counters.present_states_unusable += 1;
            return None;
        };
        let bytes = tiles.iter().map(|tile| tile.bytes().len()).sum();
        let longest = self.package_bytes_max();
        let usable = bytes <= self.config.present_state_bytes_max
            && self.store.held(stream).is_some_and(|held| held.contains_range(1, upto))
            && (0..).zip(&tiles).all(|(number, tile)| {
                tile.header().stream == stream
                    && tile.header().index == upto
                    && tile.bytes().len() <= longest
                    && tile.header().content == ContentKind::Present { set, tile: number, tiles: count }
            });
        if !usable {
            self.counters.present_states_unusable += 1;
            return None;
        }
        Some(Outgoing { stream, set, upto, tiles, bytes, used_at: now })
    }

    /// Decides whether a peer gets the present state of a stream instead of packages.
    pub(super) fn review_present_state(&mut self, now: Stamp, peer: &mut Peer, stream: Stream) {
        let Some(turn) = self.turn(peer, stream) else { return };
        let Some(held) = self.store.held(stream) else { return };
        let prefix = held.prefix();
        let Some(view) = peer.view(stream, now) else { return };
        let wanted = view.state_wanted;
        if let Some(sending) = &view.sending {
            let kept = self.outgoing.iter().any(|o| o.stream == stream && o.set == sending.set);
            // What it cannot decode it states as held.
            let lacks = wanted.is_some_and(|(index, _)| index <= sending.upto);
            if kept && (lacks || !view.held.contains_range(1, sending.upto)) {
                return;
            }
            view.sending = None;
        }
        let mut missing = held.within(view.from.max(1), prefix).difference(&view.held);
        if turn > 0 {
            missing = missing.intersection(&view.overdue);
        }
        // Those further down the line wait whether others give it.
        let delay = i64::from(turn) * i64::from(self.config.relay_delay_ms) * 1_000;
        let wanted = wanted.filter(|&(upto, since)| upto <= prefix && now.micros_since(since) >= delay);
        let wanted = wanted.map(|(upto, _)| upto);
        if missing.is_empty() && wanted.is_none() {
            return;
        }
        let all = self.weigh(stream, &missing, prefix);
        // The newest state at hand, if any, tells what one costs.
        let at_hand = self.outgoing.iter_mut().rev().find(|outgoing| outgoing.stream == stream);
        let cost = at_hand.as_ref().map_or(0, |outgoing| outgoing.bytes as u64);
        if wanted.is_none() && !self.config.present_state_is_worth(&all, cost) {
            return;
        }
        if let Some(upto) = at_hand.as_ref().map(|outgoing| outgoing.upto) {
            let covered = self.weigh(stream, &missing, upto);
            let rest = all.bytes - covered.bytes;
            let is_enough = match wanted {
                Some(wanted) => upto >= wanted,
                None => self.config.present_state_is_worth(&covered, cost),
            };
            if covered.unstored == all.unstored
                && is_enough
                && rest <= (cost / 2).max(u64::from(self.config.present_state_bytes_min.unwrap_or(0)))
            {
                let Some(outgoing) = self.outgoing.iter_mut().rev().find(|o| o.stream == stream) else {
                    return;
                };
                outgoing.used_at = now;
                let nothing = IntervalSet::new(VIEW_INTERVALS_MAX);
                let (set, upto) = (outgoing.set, outgoing.upto);
                view.sending = Some(Sending { set, upto, accepted: nothing.clone(), covered: nothing });
                peer.queue_stale = true;
                return;
            }
        }
        if self.present_asked.get(&stream).is_none_or(|&again| again <= now) {
            self.present_asked.insert(stream, now.plus_micros(ASK_AGAIN));
            self.counters.present_states_wanted += 1;
            self.push_event(Event::PresentStateWanted { stream, upto: prefix, peer: peer.stream.origin });
        }
    }

    fn weigh(&self, stream: Stream, missing: &IntervalSet, upto: u32) -> Missing {
        let missing = missing.within(1, upto);
        let (mut bytes, mut stored) = (0, 0);
        for &(low, high) in missing.intervals() {
            for (_, package) in self.store.range(stream, low, high) {
                bytes += package.package.bytes().len() as u64;
                stored += 1;
            }
        }
        let range = match (missing.first(), missing.last()) {
            (Some(first), Some(last)) => (last - first).saturating_add(1),
            _ => 0,
        };
        Missing { bytes, unstored: stored < missing.count(), range }
    }

    pub(super) fn tile(&self, stream: Stream, set: u32, tile: u32) -> Option<&Package> {
        self.outgoing.iter().find(|o| o.stream == stream && o.set == set)?.tiles.get(tile as usize)
    }

    /// Tiles of the present state on its way to the peer that are neither accepted nor in flight.
    pub(super) fn tiles_to_send(&self, stream: Stream, sending: &Sending) -> impl Iterator<Item = Item> {
        let set = sending.set;
        let count = self
            .outgoing
            .iter()
            .find(|outgoing| outgoing.stream == stream && outgoing.set == set)
            .map_or(0, |outgoing| outgoing.tiles.len() as u32);
        sending.covered.missing(1, count).flat_map(|(low, high)| low..=high).map(move |number| Item::Tile {
            stream,
            set,
            tile: number - 1,
        })
    }
}

impl crate::SessionConfig {
    fn present_state_is_worth(&self, missing: &Missing, cost: u64) -> bool {
        missing.unstored
            || self.present_state_bytes_min.is_some_and(|min| missing.bytes > cost.max(u64::from(min)))
            || self.present_state_range_max.is_some_and(|max| missing.range > max)
    }
}
