//! What a peer is sent next: the best of what it misses.

use super::Session;
use crate::item::Item;
use crate::peer::Peer;
use crate::store::Stored;
use crate::{IntervalSet, Order, Relay};
use flockmap_codec::Priority;
use flockmap_grid::{RobotId, Stamp, Stream};
use std::cmp::Reverse;
use std::collections::VecDeque;

/// Items planned ahead for a peer, and looked at per stream for it.
const QUEUE_MAX: usize = 256;
/// A peer that misses more packages of a stream than this gets the oldest first: what builds on them could
/// only wait, and of what may wait there is not enough room for a long flight.
pub(super) const BACKLOG_MIN: u32 = 64;

/// A package that the peer misses.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Due {
    fresh_at: Stamp,
    stream: Stream,
    index: u32,
    priority: Priority,
}

impl Session {
    /// Makes the peer's queue anew: the best of what it misses.
    pub(super) fn plan(&mut self, now: Stamp, id: RobotId) {
        self.plan_streams(now, id);
        let Some(peer) = self.peers.get(&id) else { return };
        let queue = self.best_for(now, peer);
        let Some(peer) = self.peers.get_mut(&id) else { return };
        (peer.queue, peer.queue_stale) = (queue, false);
    }

    /// Finds the streams of which it may have to be sent something. O(streams).
    fn plan_streams(&mut self, now: Stamp, id: RobotId) {
        let Some(peer) = self.peers.get_mut(&id).filter(|peer| peer.planned_stale) else { return };
        let own = self.identity.own.origin;
        let before = core::mem::take(&mut peer.planned);
        for stream in self.store.streams() {
            if !peer.wants(stream) {
                continue;
            }
            let Some(theirs) = peer.theirs(stream, now) else { continue };
            let is_served = theirs.overdue.is_empty() && theirs.sending.is_none();
            // Of most streams of a crowd the origin answers, and nothing stayed missing for long. Its own former run a
            // peer has from others.
            let is_others = self.config.relay == Relay::Ranked
                && ![own, peer.stream.origin].contains(&stream.origin)
                && is_served
                && peer.hears(stream.origin);
            if is_others {
                continue;
            }
            peer.planned.push(stream);
            if !before.contains(&stream) {
                // What it heard of that lately was not noted.
                let since = now.plus_micros(-(peer.round_trip.timeout().as_micros() as i64));
                for (from, item) in self.outbox.broadcasts.heard(stream, since) {
                    self.report.counters.suppressed += u64::from(
                        peer.hears_too(from) && peer.cover_heard(item, now, 2 * self.config.in_flight_max),
                    );
                }
            }
        }
        peer.planned_stale = false;
    }

    fn best_for(&self, now: Stamp, peer: &Peer) -> VecDeque<Item> {
        let (mut due, mut backlog, mut overdue) = (Vec::new(), Vec::new(), Vec::new());
        for &stream in &peer.planned {
            // Without push, a request is answered with what there was when it came.
            let asked_at = peer.request.map_or(Stamp(i64::MIN), |(_, at)| at);
            let Some(theirs) = peer.streams.get(&stream) else { continue };
            let upto = self.store.newest_known(stream);
            // What a snapshot or its next pieces bring that is in flight, or being made, is not sent beside it.
            let of_snapshot = match &theirs.sending {
                Some(sending) => Some((sending.since, sending.pieces_upto)),
                None => self.outbox.coming_to(now, stream, peer.stream.origin),
            };
            let (since, after) = of_snapshot.map_or((0, 1), |(since, upto)| (since, upto.saturating_add(1)));
            let before = theirs.received_or_in_flight.missing(theirs.from.max(1), since);
            let mut missing: Vec<(u32, u32)> =
                before.chain(theirs.received_or_in_flight.missing(theirs.from.max(after), upto)).collect();
            if missing.is_empty() && theirs.sending.is_none() {
                // Most of the time there is nothing, and the turn costs more to work out than this.
                continue;
            }
            let Some(relay_rank) = self.relay_rank(peer, stream) else { continue };
            if relay_rank > 0 {
                let overdue = IntervalSet::from_intervals(0, missing).intersection(&theirs.overdue);
                missing = overdue.intervals().to_vec();
            }
            let is_known = |(_, stored): &(u32, &Stored)| self.config.push || stored.stored_at <= asked_at;
            let item = |(index, stored): (u32, &Stored)| Due {
                fresh_at: stored.fresh_at,
                stream,
                index,
                priority: stored.package.header().priority,
            };
            let oldest = missing.iter().flat_map(|&(low, high)| self.store.range(stream, low, high));
            let newest =
                missing.iter().rev().flat_map(|&(low, high)| self.store.range(stream, low, high).rev());
            let (oldest, newest) = (oldest.filter(is_known), newest.filter(is_known));
            let count = missing.iter().map(|&(low, high)| high - low + 1).fold(0, u32::saturating_add);
            if relay_rank > 0 {
                // The origin sends its newest first. From the other end a relay meets it in the middle.
                overdue.extend(oldest.map(item).take(QUEUE_MAX));
            } else if self.config.order == Order::OldestFirst {
                due.extend(oldest.map(item).take(QUEUE_MAX));
            } else if count > BACKLOG_MIN {
                backlog.extend(oldest.map(item).take(QUEUE_MAX));
            } else {
                due.extend(newest.map(item).take(QUEUE_MAX));
            }
        }
        match self.config.order {
            // Obstacles, near free space, far free space; of each batch by batch; within a batch in the order
            // of the indices, so that no gaps appear.
            Order::NewestFirst => {
                due.sort_unstable_by_key(|due| (due.priority, Reverse(due.fresh_at), due.stream, due.index))
            }
            Order::OldestFirst => due.sort_unstable(),
        }
        backlog.sort_unstable();
        overdue.sort_unstable();
        let packages = due
            .into_iter()
            .chain(backlog)
            .chain(overdue)
            .map(|due| Item::Package { stream: due.stream, index: due.index });
        let chunks = self.plan_chunks(now, peer, QUEUE_MAX);
        packages.chain(chunks).take(QUEUE_MAX).collect()
    }
}
