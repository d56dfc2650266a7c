//! Packages that go out: what each peer misses, in which order, within the budget.

use super::peer::{Peer, Sent, View};
use super::{Destination, Session, Transmit};
use crate::Cast;
use crate::item::Item;
use crate::timers::Timer;
use crate::wire::{Kind, PackagesWriter};
use flockmap_grid::{RobotId, Stamp};
use flockmap_mutation::{self as mutation, Mutation};

/// Items looked at to fill up a datagram.
const BUNDLE_LOOKAHEAD: usize = 16;

/// Requests to everyone that may go out while packages wait for a budget. Where peers forget each other soon, requests alone could fill it.
const OVERTAKEN_MAX: u8 = 3;

/// What came of the attempt to send something to a peer.
enum Attempt {
    Send {
        bytes: Vec<u8>,
        items: Vec<Item>,
    },
    /// There is nothing for it now, or its link's budget is spent.
    Nothing,
    /// The radio's budget is spent: there is nothing for anybody now.
    RadioSpent,
}

impl View {
    /// Notes that an item need not be sent now; whether that was news. A view that is too torn to note it says no.
    /// Such an item is not sent either: it would be sent again and again.
    pub(super) fn cover(&mut self, item: Item) -> bool {
        match item {
            Item::Package { index, .. } => self.covered.insert(index).unwrap_or(false),
            Item::Tile { set, tile, .. } => match &mut self.sending {
                Some(sending) if sending.set == set => sending.covered.insert(tile + 1).unwrap_or(false),
                _ => false,
            },
        }
    }
}

impl Peer {
    /// Notes that an item goes out and is on its way to the peer: also one that it states to hold or has no place for, since it
    /// may take back either before the item arrives. One that is on its way already counts from now. Of more than `in_flight_max` the oldest is
    /// forgotten if it would count as lost by now; else the new one is not noted, and only kept back until the next request.
    pub(super) fn cover(&mut self, item: Item, now: Stamp, in_flight_max: usize) {
        let stream = item.stream();
        if stream == self.stream || mutation::is(Mutation::LedgerIgnored) {
            return;
        }
        let view = self.view(stream, now);
        if let Item::Tile { set, .. } = item
            && view.as_ref().and_then(|view| view.sending.as_ref()).is_none_or(|sending| sending.set != set)
        {
            // It is not sent this set.
            return;
        }
        let is_new = view.is_some_and(|view| view.cover(item));
        if let Some(at) = self.in_flight.iter().rposition(|sent| !is_new && sent.item == item) {
            self.in_flight.remove(at);
        }
        let timeout = self.round_trip.timeout();
        if self.in_flight.len() >= in_flight_max
            && self.in_flight.front().is_some_and(|oldest| now.micros_since(oldest.at) >= timeout)
        {
            self.in_flight.pop_front();
        }
        if self.in_flight.len() < in_flight_max || mutation::is(Mutation::WindowIgnored) {
            self.in_flight.push_back(Sent { item, at: now, requests: 0 });
        }
    }

    /// Notes that the peer hears an item from another robot, if there is room; whether it was missing.
    pub(super) fn cover_heard(&mut self, item: Item, now: Stamp, in_flight_max: usize) -> bool {
        if self.in_flight.len() >= in_flight_max
            || !self.wants(item.stream())
            || self.view(item.stream(), now).is_none()
        {
            return false;
        }
        let is_news = self.lacks(item);
        self.cover(item, now, in_flight_max);
        is_news
    }

    /// Whether an item is still missing and not on its way, and can be noted as being on its way.
    fn lacks(&self, item: Item) -> bool {
        let (covered, number) = match (self.views.get(&item.stream()), item) {
            (Some(view), Item::Package { index, .. }) => (&view.covered, index),
            (Some(View { sending: Some(sending), .. }), Item::Tile { set, tile, .. })
                if sending.set == set =>
            {
                (&sending.covered, tile + 1)
            }
            _ => return false,
        };
        !covered.contains(number) && covered.has_room_for(number)
    }
}

impl Session {
    /// The next datagram of packages, serving the peers in turn.
    pub(super) fn transmit_packages(&mut self, now: Stamp) -> Option<Transmit> {
        let overtaken = self.outbox.overtaken.take();
        let after = |id: &&RobotId| **id > self.outbox.served;
        let ids: Vec<RobotId> = self
            .peers
            .keys()
            .filter(after)
            .chain(self.peers.keys().filter(|id| !after(id)))
            .copied()
            .collect();
        for id in ids {
            match self.attempt(now, id) {
                Attempt::Send { bytes, items } => {
                    self.outbox.served = id;
                    return Some(self.sent_to(now, id, bytes, &items));
                }
                Attempt::RadioSpent => {
                    self.outbox.overtaken = Some(overtaken.unwrap_or(0));
                    return None;
                }
                Attempt::Nothing => {}
            }
        }
        None
    }

    /// Whether some datagram of packages has waited for so long that requests are to wait for it.
    pub(super) fn is_overtaken(&self) -> bool {
        let links = self.peers.values().map(|peer| peer.overtaken);
        links.chain([self.outbox.overtaken]).flatten().any(|requests| requests >= OVERTAKEN_MAX)
    }

    /// A request to everyone went out.
    pub(super) fn note_overtaken(&mut self) {
        let links = self.peers.values_mut().map(|peer| &mut peer.overtaken);
        for requests in links.chain([&mut self.outbox.overtaken]).flatten() {
            *requests = requests.saturating_add(1);
        }
    }

    fn attempt(&mut self, now: Stamp, id: RobotId) -> Attempt {
        let own = self.identity.own.origin;
        let Some(peer) = self.peers.get_mut(&id) else { return Attempt::Nothing };
        let overtaken = peer.overtaken.take();
        if !peer.hears(own) || peer.is_silent(now) || !peer.path.is_open() {
            return Attempt::Nothing;
        }
        if peer.queue_stale {
            self.plan(now, id);
        }
        let (writer, positions) = self.bundle(now, id);
        if positions.is_empty() {
            return Attempt::Nothing;
        }
        let window = self.peers.get(&id).map_or(0, |peer| peer.in_flight.len());
        if window >= self.config.in_flight_max && !mutation::is(Mutation::WindowIgnored) {
            self.report.counters.delayed_by_window += 1;
            return Attempt::Nothing;
        }
        let cost = writer.bytes() + self.overhead(Kind::Packages);
        let Some(peer) = self.peers.get_mut(&id) else { return Attempt::Nothing };
        let link = peer.pacer.as_mut().and_then(|pacer| pacer.wait(now, cost));
        let radio = self.outbox.radio.as_mut().and_then(|radio| radio.wait(now, cost));
        if let Some(ready) = link.max(radio) {
            self.schedule.timers.set_sooner(Timer::Budget, ready);
            self.report.counters.delayed_by_budget += 1;
            if radio.is_some() {
                return Attempt::RadioSpent;
            }
            peer.overtaken = Some(overtaken.unwrap_or(0));
            return Attempt::Nothing;
        }
        for pacer in [peer.pacer.as_mut(), self.outbox.radio.as_mut()].into_iter().flatten() {
            pacer.spend(now, cost);
        }
        let mut items = Vec::with_capacity(positions.len());
        for position in positions.into_iter().rev() {
            items.extend(peer.queue.remove(position));
        }
        items.reverse();
        // The queue may have been cut to its bound: look again when it is empty.
        peer.queue_stale |= peer.queue.is_empty();
        Attempt::Send { bytes: writer.finish(), items }
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
        let mut told = None;
        for (position, &item) in peer.queue.iter().enumerate().take(BUNDLE_LOOKAHEAD) {
            if positions.len() >= room || !peer.lacks(item) {
                continue;
            }
            let contents = self.outbox.contents(item).filter(|contents| told != Some(contents.set));
            if let Some(contents) = &contents {
                if !writer.push_contents(contents) {
                    continue;
                }
                told = Some(contents.set);
            }
            if let Some(package) = self.outbox.package(item, &self.store)
                && writer.push(package)
            {
                positions.push(position);
            }
        }
        if positions.len() == room && !positions.is_empty() {
            writer.ask_for_word();
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
            self.report.counters.tiles_sent += u64::from(matches!(item, Item::Tile { .. }));
        }
        let own = self.identity.own.origin;
        for (&other, peer) in &mut self.peers {
            if other == id || (to == Destination::Everyone && peer.hears(own)) {
                // What everyone hears is noted for everyone, as far as twice the limit goes.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SessionConfig;
    use crate::wire::Covered;
    use flockmap_grid::Stream;

    #[test]
    fn what_is_heard_from_others_pushes_nothing_that_was_sent_out_of_the_ledger() {
        let robot = |id| Stream { origin: RobotId(id), epoch: 1 };
        let item = |id, index| Item::Package { stream: robot(id), index };
        let mut peer = Peer::new(robot(2), Stamp(0), &SessionConfig::default());
        peer.takes_new_streams = true;
        peer.note_covered(Covered::all_from(RobotId(0)));
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
        peer.cover(item(1, 2), Stamp(peer.round_trip.timeout()), 6);
        assert_eq!((peer.in_flight.len(), peer.in_flight[5].item), (6, item(1, 2)));
    }
}
