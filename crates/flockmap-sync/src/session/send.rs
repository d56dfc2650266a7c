//! Packages that go out: what each peer misses, in which order, within the budget.

use super::Session;
use crate::Cast;
use crate::crowd::SMALL_SWARM;
use crate::event::{Destination, Transmit};
use crate::item::Item;
use crate::timers::Timer;
use crate::wire::{Kind, PackagesWriter};
use flockmap_grid::{RobotId, Stamp, Stream};
use flockmap_mutation::{self as mutation, Mutation};

/// Items looked at to fill up a datagram.
const BUNDLE_LOOKAHEAD: usize = 16;

/// Requests to everyone that may go out while packages wait for a budget. Where peers forget each other soon,
/// requests alone could fill it.
const SUPERSEDED_MAX: u8 = 3;

/// What came of the attempt to send something to a peer.
enum Attempt {
    Send {
        bytes: Vec<u8>,
        items: Vec<Item>,
    },
    /// There is nothing for it now, or its link's budget is exhausted.
    Nothing,
    /// The radio's budget is exhausted: there is nothing for anybody now.
    BudgetExhausted,
}

impl Session {
    /// The next datagram of packages, serving the peers in turn.
    pub(super) fn transmit_packages(&mut self, now: Stamp) -> Option<Transmit> {
        if let Some(until) = self.outbox.blocked_until.filter(|until| *until > now) {
            self.schedule.timers.set_sooner(Timer::Budget, until);
            return None;
        }
        let superseded = self.outbox.superseded.take();
        let served = self.outbox.served;
        let to_do = self.peers.iter().filter(|(_, peer)| peer.has_to_do()).map(|(id, _)| *id);
        let (after, before): (Vec<RobotId>, Vec<RobotId>) = to_do.partition(|id| *id > served);
        for id in after.into_iter().chain(before) {
            match self.attempt(now, id) {
                Attempt::Send { bytes, items } => {
                    self.outbox.served = id;
                    self.note_obstacles_sent(now, &items, bytes.len());
                    return Some(self.sent_to(now, id, bytes, &items));
                }
                Attempt::BudgetExhausted => {
                    self.outbox.superseded = Some(superseded.unwrap_or(0));
                    return None;
                }
                Attempt::Nothing => {}
            }
        }
        None
    }

    /// Whether some datagram of packages has waited for so long that requests are to wait for it.
    pub(super) fn is_superseded(&self) -> bool {
        let links = self.peers.values().map(|peer| peer.superseded);
        links.chain([self.outbox.superseded]).flatten().any(|requests| requests >= SUPERSEDED_MAX)
    }

    /// A request to everyone went out.
    pub(super) fn note_superseded(&mut self) {
        let links = self.peers.values_mut().map(|peer| &mut peer.superseded);
        for requests in links.chain([&mut self.outbox.superseded]).flatten() {
            *requests = requests.saturating_add(1);
        }
    }

    fn attempt(&mut self, now: Stamp, id: RobotId) -> Attempt {
        let own = self.identity.own.origin;
        let Some(peer) = self.peers.get_mut(&id) else { return Attempt::Nothing };
        let superseded = peer.superseded.take();
        if !peer.hears(own) || peer.is_silent(now) || !peer.path.is_open() {
            return Attempt::Nothing;
        }
        if peer.queue_stale {
            self.plan(now, id);
        }
        if self.peers.get(&id).is_none_or(|peer| peer.queue.is_empty()) {
            return Attempt::Nothing;
        }
        let (mut writer, mut positions) = self.bundle(now, id);
        if positions.is_empty() {
            return Attempt::Nothing;
        }
        let first = positions.first().and_then(|at| self.peers.get(&id)?.queue.get(*at).copied());
        let mending = first.and_then(|item| self.mending(now, item));
        let window = self.peers.get(&id).map_or(0, |peer| peer.in_flight.len());
        if window >= self.config.in_flight_max && !mutation::is(Mutation::WindowIgnored) {
            self.report.counters.delayed_by_window += 1;
            return Attempt::Nothing;
        }
        let mut items = Vec::with_capacity(positions.len());
        let mut mended = None;
        if let Some(mending) = mending {
            writer = mending.writer;
            positions.clear();
            mended = Some((mending.stream, mending.mended));
        }
        let cost = writer.bytes() + self.overhead(Kind::Packages);
        let peers = self.peers.len();
        let Some(peer) = self.peers.get_mut(&id) else { return Attempt::Nothing };
        let link = peer.pacer.as_mut().and_then(|pacer| pacer.wait(now, cost));
        let radio = self.outbox.wait_with_packages(now, cost, peers);
        if let Some(ready) = link.max(radio) {
            self.schedule.timers.set_sooner(Timer::Budget, ready);
            self.report.counters.delayed_by_budget += 1;
            if radio.is_some() {
                self.outbox.blocked_until = radio;
                return Attempt::BudgetExhausted;
            }
            peer.superseded = Some(superseded.unwrap_or(0));
            return Attempt::Nothing;
        }
        self.outbox.spend(now, cost);
        peer.pacer.iter_mut().for_each(|pacer| pacer.spend(now, cost));
        for position in positions.into_iter().rev() {
            items.extend(peer.queue.remove(position));
        }
        items.reverse();
        // The queue may have been cut to its bound: look again when it is empty.
        peer.queue_stale |= peer.queue.is_empty();
        if let Some((stream, mended)) = mended {
            self.report.counters.coded_sent += 1;
            self.note_sent_coded(now, stream, &mended);
        }
        Attempt::Send { bytes: writer.finish(), items }
    }

    /// Notes what repair symbols bring to each peer.
    fn note_sent_coded(&mut self, now: Stamp, stream: Stream, mended: &[(RobotId, Vec<u32>)]) {
        for (id, indices) in mended {
            let Some(peer) = self.peers.get_mut(id) else { continue };
            for &index in indices {
                peer.cover(Item::Package { stream, index }, now, 2 * self.config.in_flight_max);
            }
        }
    }

    /// Fills a datagram from the peer's queue; the places in the queue of what went in. Drops from the front of
    /// the queue what the peer does not miss any more.
    fn bundle(&mut self, now: Stamp, id: RobotId) -> (PackagesWriter, Vec<usize>) {
        let mut writer =
            PackagesWriter::new(self.header(now, Kind::Packages), self.plain_bytes_max(Kind::Packages));
        let mut positions = Vec::new();
        while let Some(peer) = self.peers.get_mut(&id)
            && let Some(&item) = peer.queue.front()
            && (!peer.lacks(item) || self.outbox.package(item, &self.store).is_none())
        {
            peer.queue.pop_front();
        }
        let Some(peer) = self.peers.get(&id) else { return (writer, positions) };
        let room = self.config.in_flight_max.saturating_sub(peer.in_flight.len()).max(1);
        let mut sent = None;
        let repairs_at = self.outbox.broadcasts.repairs_wait_until(now);
        let mut is_held = false;
        for (position, &item) in peer.queue.iter().enumerate().take(BUNDLE_LOOKAHEAD) {
            if positions.len() >= room || !peer.lacks(item) {
                continue;
            }
            if repairs_at.is_some() && self.outbox.broadcasts.was_sent(item) {
                is_held = true;
                continue;
            }
            let contents = self.outbox.contents(item).filter(|contents| sent != Some(contents.snapshot_id));
            if let Some(contents) = &contents {
                if !writer.push_contents(contents) {
                    continue;
                }
                sent = Some(contents.snapshot_id);
            }
            if let Some(package) = self.outbox.package(item, &self.store)
                && writer.push(package)
            {
                positions.push(position);
            }
        }
        if let Some(at) = repairs_at.filter(|_| is_held) {
            self.schedule.timers.set_sooner(Timer::Budget, at);
        }
        let is_echo_wanted = self.peers.len() <= SMALL_SWARM
            && self.outbox.rate.as_ref().is_some_and(|rate| rate.is_echo_wanted(writer.bytes()));
        if (positions.len() == room || is_echo_wanted) && !positions.is_empty() {
            writer.ask_for_request();
        }
        (writer, positions)
    }

    fn sent_to(&mut self, now: Stamp, id: RobotId, bytes: Vec<u8>, items: &[Item]) -> Transmit {
        let to = match self.config.cast {
            Cast::Unicast => Destination::Peer(id),
            Cast::Broadcast => Destination::Everyone,
        };
        let each = bytes.len() + self.overhead(Kind::Packages);
        self.report.counters.packages_out.add(1, each);
        for &item in items {
            self.report.counters.sent += 1;
            self.report.counters.relayed += u64::from(item.stream().origin != self.identity.own.origin);
            self.report.counters.chunks_sent += u64::from(matches!(item, Item::Chunk { .. }));
        }
        if to == Destination::Everyone {
            self.outbox.broadcasts.note(now, items);
        }
        for (&other, peer) in &mut self.peers {
            if other == id || to == Destination::Everyone {
                // What everyone hears is noted for everyone, as far as twice the limit goes. A peer that has not
                // said yet that it hears this robot may hear it all the same.
                for &item in items {
                    peer.cover(item, now, 2 * self.config.in_flight_max);
                }
            }
            if other == id && to != Destination::Everyone {
                peer.traffic_out.add(1, each);
            }
        }
        self.note_activity(now);
        self.note_sent(now);
        let path = self.peers.get(&id).and_then(|peer| peer.path.valid());
        Transmit { to, path: path.filter(|_| to != Destination::Everyone), bytes }
    }
}
