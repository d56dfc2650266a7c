//! Packages that come in, and the driver's verdict on them.

use super::{EVENTS_MAX, Session};
use crate::event::Event;
use crate::inbox::{Intake, Ready, Transfer, Verdict};
use crate::item::Item;
use crate::store::NoRoom;
use crate::wire::Contents;
use crate::{Cast, IntervalSet};
use flockmap_codec::{Codec, ContentKind, Header, Package};
use flockmap_grid::{RobotId, Stamp, Stream};

impl Session {
    pub(super) fn receive_packages(
        &mut self,
        now: Stamp,
        sender: Stream,
        packages: Vec<Package>,
        contents: Vec<Contents>,
    ) {
        for package in packages {
            let (stream, index) = (package.header().stream, package.header().index);
            self.note_own_id(now, stream);
            if stream == self.identity.own {
                self.report.counters.own_returned += 1;
                if index > self.store.newest_known(stream) {
                    self.note_own_run_used(now);
                }
            } else if self.open_stream(stream) {
                match package.header().content {
                    ContentKind::Changes => self.receive_changes(now, sender.origin, package),
                    ContentKind::Snapshot { since, id: snapshot_id, chunk, chunks } => {
                        let &Header { lost_upto, is_cut, .. } = package.header();
                        let incoming = Transfer {
                            lost_upto,
                            is_cut,
                            newest_of: package.header().newest_of(),
                            ..Transfer::new(sender.origin, stream, [since, index], snapshot_id, chunks, now)
                        };
                        self.receive_chunk(now, incoming, chunk, package);
                    }
                }
            }
        }
        for Contents { stream, snapshot_id, received } in contents {
            let is_of = |i: &&mut Transfer| {
                (i.source, i.stream, i.snapshot_id) == (sender.origin, stream, snapshot_id)
            };
            if let Some(incoming) = self.inbox.transfers.iter_mut().find(is_of) {
                incoming.contents = Some(received);
            }
        }
    }

    pub(super) fn receive_changes(&mut self, now: Stamp, from: RobotId, package: Package) {
        let (stream, index) = (package.header().stream, package.header().index);
        let newest = self.store.newest_known(stream);
        if self.store.note_newest(stream, index, now) && index - newest > 1 {
            self.note_gap(now, true);
        }
        self.note_seen_from(now, from, stream, index);
        let item = Item::Package { stream, index };
        let received = self.store.received(stream).is_some_and(|received| received.contains(index));
        self.deliver(now, from, item, received, package);
    }

    /// The sender holds what it sends; and by broadcast, those who hear it have just heard it too.
    fn note_seen_from(&mut self, now: Stamp, from: RobotId, stream: Stream, index: u32) {
        if let Some(theirs) = self.peers.get_mut(&from).and_then(|peer| peer.theirs(stream, now)) {
            theirs.note_received(index);
        }
        // What did not come over the radio, nobody has heard.
        if self.config.cast == Cast::Broadcast && from != self.identity.own.origin {
            let item = Item::Package { stream, index };
            self.outbox.broadcasts.note_heard(now, from, item);
            for peer in self.peers.values_mut().filter(|peer| peer.is_planned(stream)) {
                if peer.hears_too(from) && peer.cover_heard(item, now, 2 * self.config.in_flight_max) {
                    self.report.counters.suppressed += 1;
                }
            }
        }
    }

    pub(super) fn deliver(
        &mut self,
        now: Stamp,
        from: RobotId,
        item: Item,
        received: bool,
        package: Package,
    ) {
        if self.report.events.len() >= EVENTS_MAX && !received && !self.inbox.is_pending(item) {
            self.report.counters.events_overflowed += 1;
            return;
        }
        match self.inbox.take_in(now, from, item, received) {
            Intake::Taken => {
                self.report.counters.received += 1;
                self.report.events.push_back(Event::Received(package));
            }
            Intake::Duplicate => self.report.counters.duplicates += 1,
            Intake::Unwanted => self.report.counters.rejected += 1,
            Intake::Full => self.report.counters.events_overflowed += 1,
        }
    }

    /// Whether there may be an event to poll.
    pub fn has_events(&self) -> bool {
        self.inbox.is_releasing() || !self.report.events.is_empty()
    }

    /// The next event, until `None`, or as many as the driver has time for: the others wait. A package comes when it
    /// can be decoded: what has to wait for others is kept here.
    pub fn poll_event(&mut self) -> Option<Event> {
        loop {
            if let Some(package) = self.inbox.next_released(&self.store) {
                return Some(Event::Received(package));
            }
            match self.report.events.pop_front()? {
                Event::Received(package) => match self.inbox.look_at(package, &self.store) {
                    Ready::Decodable(package) => return Some(Event::Received(package)),
                    Ready::Waits(dropped) => {
                        self.report.counters.waited += 1;
                        dropped.into_iter().for_each(|package| self.drop_waiting(&package));
                    }
                    Ready::Merged(package) => self.accept(self.clocks.now(), &package),
                    Ready::Settled => {}
                    Ready::TakesPlaceOf((stream, snapshot_id), package) => {
                        self.report.events.push_front(Event::Received(package));
                        self.restart_snapshot(self.clocks.now(), stream, snapshot_id);
                        return Some(Event::SnapshotDropped { stream, snapshot_id });
                    }
                },
                Event::CaughtUp { stream, upto } => {
                    self.inbox.drop_upto(stream, upto);
                    self.inbox.release_stream(stream);
                    self.restart_rests(stream, upto);
                    self.welcome_back(stream);
                    return Some(Event::CaughtUp { stream, upto });
                }
                Event::StreamForgotten(stream) => {
                    self.inbox.drop_upto(stream, u32::MAX);
                    return Some(Event::StreamForgotten(stream));
                }
                event => return Some(event),
            }
        }
    }

    /// There is no room any more for something that waited.
    fn drop_waiting(&mut self, package: &Package) {
        self.report.counters.waiting_dropped += 1;
        let header = package.header();
        self.back_off(self.clocks.now(), package);
        if header.content == ContentKind::Changes {
            let (stream, index, base) = (header.stream, header.index, header.base);
            self.inbox.note_crowded_out(stream, base, index);
            self.push_event(Event::NoRoomToWait { stream, index, base });
        }
    }

    /// What became of the package of an [`Event::Received`]: of each, before the next event is polled. One
    /// that needs no verdict any more is ignored.
    pub fn verdict(&mut self, now: Stamp, package: &Package, verdict: Verdict) {
        let now = self.advance(now);
        let item = Item::of(package);
        if !self.inbox.is_pending(item) {
            return;
        }
        match (verdict, item) {
            (Verdict::Merged, _) => {
                self.accept(now, package);
                self.inbox.release(package);
                self.welcome_back(item.stream());
            }
            (Verdict::Damaged, Item::Chunk { stream, snapshot_id, .. }) => {
                self.back_off(now, package);
                if package.header().codec == Codec::Flock {
                    self.restart_snapshot(now, stream, snapshot_id);
                }
            }
            (Verdict::Damaged, Item::Package { .. }) if !self.inbox.is_damaged_again(package) => {
                self.back_off(now, package);
            }
            (Verdict::Damaged | Verdict::Undecodable, Item::Package { stream, index })
                if self.inbox.note_undecodable(stream, index) =>
            {
                self.inbox.take_out(item);
                self.report.counters.undecodable += 1;
                self.note_gap(now, true);
            }
            _ => self.back_off(now, package),
        }
    }

    /// More of a stream is in the map: what had no room to wait for it is asked for again.
    fn welcome_back(&mut self, stream: Stream) {
        if self.inbox.welcome_back(stream, &self.store) {
            self.note_gap(self.clocks.now(), true);
        }
    }

    /// It is dropped, and asked for again after a while.
    fn back_off(&mut self, now: Stamp, package: &Package) {
        let item = Item::of(package);
        while self.inbox.take_out(item).is_some() {
            self.report.counters.rejected += 1;
            self.inbox.back_off(now, item);
        }
    }

    /// It is merged: it counts as held and is offered to others.
    fn accept(&mut self, now: Stamp, package: &Package) {
        let item = Item::of(package);
        // A chunk may have come from several.
        while let Some(from) = self.inbox.take_out(item) {
            self.inbox.end_back_off(item);
            match item {
                Item::Package { stream, index } => self.accept_changes(now, stream, index, package),
                Item::Chunk { stream, snapshot_id, chunk } => {
                    self.accept_chunk(now, from, (stream, snapshot_id), chunk, package.header().batch_end)
                }
            }
            self.note_activity(now);
        }
    }

    fn accept_changes(&mut self, now: Stamp, stream: Stream, index: u32, package: &Package) {
        let offset = self.clock_offset_micros(stream);
        let fresh_at =
            offset.map_or(now, |offset| package.header().batch_end.plus_micros(offset.saturating_neg()));
        let fills_gap =
            self.store.received(stream).and_then(IntervalSet::last).is_some_and(|last| last > index);
        match self.store.insert(package, now, fresh_at) {
            Ok(is_new) => {
                // A span may have waited for this one.
                if self
                    .inbox
                    .transfers
                    .iter()
                    .any(|incoming| incoming.stream == stream && incoming.is_complete())
                {
                    self.finish_transfers(now);
                }
                self.report.counters.accepted += u64::from(is_new);
                self.report.counters.repaired += u64::from(is_new && fills_gap);
                if is_new && fills_gap {
                    self.note_gap_filled();
                }
                // Who hears the origin gets it from there, unless it stays missing for long: that a request says.
                for peer in self.peers.values_mut() {
                    peer.queue_stale |= peer.is_planned(stream);
                }
                if is_new {
                    self.mend_with(now, stream, index);
                }
            }
            Err(NoRoom::Intervals) => self.report.counters.too_fragmented += 1,
            Err(_) => self.report.counters.too_many_streams += 1,
        }
    }
}
