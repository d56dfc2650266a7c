//! Packages that come in, and the driver's verdict on them.

use super::peer::Item;
use super::present::Incoming;
use super::{EVENTS_MAX, Event, Session};
use crate::store::{HELD_INTERVALS_MAX, NoRoom};
use crate::{Cast, IntervalSet};
use flockmap_codec::{ContentKind, Package};
use flockmap_grid::{RobotId, Stamp, Stream};

/// A rejected package is not asked for again for so long.
const REFUSED_FOR: i64 = 10_000_000;
/// Rejected packages remembered; of more, the one whose pause ends first is asked for again.
const REFUSED_MAX: usize = 1_024;

impl Session {
    pub(super) fn receive_packages(&mut self, now: Stamp, sender: Stream, packages: Vec<Package>) {
        for package in packages {
            let (stream, index) = (package.header().stream, package.header().index);
            if stream == self.own {
                self.counters.own_returned += 1;
                if index > self.store.newest_known(stream) {
                    self.tell_same_identity(now);
                }
            } else if self.open_stream(stream) {
                match package.header().content {
                    ContentKind::Changes => self.receive_changes(now, sender.origin, package),
                    ContentKind::Present { set, tile, tiles } => {
                        let incoming = Incoming::new(sender.origin, stream, index, set, tiles, now);
                        self.receive_tile(now, incoming, tile, package);
                    }
                }
            }
        }
    }

    fn receive_changes(&mut self, now: Stamp, from: RobotId, package: Package) {
        let (stream, index) = (package.header().stream, package.header().index);
        let newest = self.store.newest_known(stream);
        if self.store.note_newest(stream, index) && index - newest > 1 {
            self.note_gap(now, true);
        }
        self.note_seen_from(now, from, stream, index);
        let item = Item::Package { stream, index };
        let held = self.store.held(stream).is_some_and(|held| held.contains(index));
        self.deliver(now, from, item, held, package);
    }

    /// The sender holds what it sends; and by broadcast, those who hear it have just heard it too.
    fn note_seen_from(&mut self, now: Stamp, from: RobotId, stream: Stream, index: u32) {
        if let Some(view) = self.peers.get_mut(&from).and_then(|peer| peer.view(stream, now)) {
            view.note_held(index);
        }
        if self.config.cast == Cast::Broadcast {
            for peer in self.peers.values_mut() {
                if peer.stream.origin != from && peer.hears_all_listed && peer.hears(from) {
                    let item = Item::Package { stream, index };
                    if peer.cover(item, now, self.config.in_flight_max) {
                        self.counters.suppressed += 1;
                    }
                }
            }
        }
    }

    fn receive_tile(&mut self, now: Stamp, tile_of: Incoming, tile: u32, package: Package) {
        let (stream, upto) = (tile_of.stream, tile_of.upto);
        self.store.note_newest(stream, upto);
        if self.store.held(stream).is_some_and(|held| held.contains_range(1, upto)) {
            self.counters.duplicates += 1;
            return;
        }
        let from = tile_of.source;
        let at = match self.incoming.iter().position(|incoming| incoming.is_same(&tile_of)) {
            Some(at) => at,
            None => {
                // Sets of one robot are kept side by side: by broadcast, one that it sends to somebody else is
                // heard among the tiles of the one for us. Only for want of room does the newer one take over.
                if self.incoming.len() >= self.config.transfers_max {
                    self.finish_transfers(now);
                }
                if self.incoming.len() >= self.config.transfers_max {
                    let same = self.incoming.iter().enumerate();
                    let same = same.filter(|(_, other)| other.stream == stream && other.source == from);
                    if let Some((oldest, _)) = same.min_by_key(|(_, other)| other.touched) {
                        self.incoming.remove(oldest);
                    }
                }
                if self.incoming.len() >= self.config.transfers_max {
                    self.counters.too_many_transfers += 1;
                    return;
                }
                self.incoming.push(tile_of);
                self.incoming.len() - 1
            }
        };
        let incoming = &mut self.incoming[at];
        incoming.touched = now;
        let item = Item::Tile { stream, set: incoming.set, tile };
        let held = incoming.accepted.contains(tile + 1);
        self.deliver(now, from, item, held, package);
        // If the rest gets lost, say soon which tiles are missing.
        self.note_gap(now, false);
    }

    fn deliver(&mut self, now: Stamp, from: RobotId, item: Item, held: bool, package: Package) {
        if held || self.undecided.iter().any(|&(other, source)| other == item && source == from) {
            self.counters.duplicates += 1;
        } else if self.is_refused(item, now) {
            self.counters.rejected += 1;
        } else if self.undecided.len() >= EVENTS_MAX || self.events.len() >= EVENTS_MAX {
            self.counters.events_overflowed += 1;
        } else {
            self.counters.received += 1;
            self.undecided.push_back((item, from));
            self.events.push_back(Event::Received(package));
        }
    }

    /// The package of an [`Event::Received`] is decoded and merged: it counts as held and is offered to others.
    /// A package that is not waiting for a verdict is ignored.
    pub fn accept(&mut self, now: Stamp, package: &Package) {
        let now = self.advance(now);
        let Some((item, from)) = self.take_undecided(package) else { return };
        self.refused.remove(&item);
        match item {
            Item::Package { stream, index } => self.accept_changes(now, stream, index, package),
            Item::Tile { stream, set, tile } => self.accept_tile(now, from, stream, set, tile),
        }
        self.note_activity(now);
    }

    fn accept_changes(&mut self, now: Stamp, stream: Stream, index: u32, package: &Package) {
        let offset = self.clock_offset(stream);
        let fresh_at =
            offset.map_or(now, |offset| package.header().cycle_end.plus_micros(offset.saturating_neg()));
        let fills_gap = self.store.held(stream).and_then(IntervalSet::last).is_some_and(|last| last > index);
        match self.store.insert(package, now, fresh_at) {
            Ok(is_new) => {
                self.counters.accepted += u64::from(is_new);
                self.counters.repaired += u64::from(is_new && fills_gap);
                self.mark_queues_stale();
            }
            Err(NoRoom::Intervals) => self.counters.too_fragmented += 1,
            Err(_) => self.counters.too_many_streams += 1,
        }
    }

    fn accept_tile(&mut self, now: Stamp, from: RobotId, stream: Stream, set: u32, tile: u32) {
        let found = self.incoming.iter().position(|i| i.source == from && i.stream == stream && i.set == set);
        let Some(at) = found else { return };
        match self.incoming[at].accepted.insert(tile + 1) {
            Ok(is_new) => self.counters.tiles_accepted += u64::from(is_new),
            Err(_) => {
                self.counters.too_fragmented += 1;
                return;
            }
        }
        self.finish_transfers(now);
    }

    /// Counts as held what completely received present states contain; lets go of transfers that are done,
    /// overtaken or abandoned.
    pub(super) fn finish_transfers(&mut self, now: Stamp) {
        let complete = |i: &&Incoming| i.accepted.contains_range(1, i.tiles);
        let complete: Vec<_> = self.incoming.iter().filter(complete).map(|i| (i.stream, i.upto)).collect();
        for (stream, upto) in complete {
            match self.store.hold(stream, 1, upto) {
                Ok(_) => {
                    self.counters.caught_up += 1;
                    self.push_event(Event::CaughtUp { stream, upto });
                    self.mark_queues_stale();
                    // The sender should learn soon that it can stop, and what came after.
                    self.greet(now);
                }
                // Stays complete, and counts once some gaps above it are filled.
                Err(_) => self.counters.too_fragmented += 1,
            }
        }
        let store = &self.store;
        self.incoming.retain(|incoming| {
            let held = store.held(incoming.stream).is_some_and(|held| held.contains_range(1, incoming.upto));
            !held && !incoming.is_abandoned(now)
        });
    }

    /// The package of an [`Event::Received`] does not decode: it is dropped and asked for again after 10 s.
    pub fn reject(&mut self, now: Stamp, package: &Package) {
        let now = self.advance(now);
        let Some((item, _)) = self.take_undecided(package) else { return };
        self.counters.rejected += 1;
        self.refused.retain(|_, until| *until > now);
        if self.refused.len() >= REFUSED_MAX
            && let Some(first) = self.refused.iter().min_by_key(|(_, until)| **until).map(|(item, _)| *item)
        {
            self.refused.remove(&first);
        }
        self.refused.insert(item, now.plus_micros(REFUSED_FOR));
    }

    fn take_undecided(&mut self, package: &Package) -> Option<(Item, RobotId)> {
        let header = package.header();
        let item = match header.content {
            ContentKind::Changes => Item::Package { stream: header.stream, index: header.index },
            ContentKind::Present { set, tile, .. } => Item::Tile { stream: header.stream, set, tile },
        };
        let at = self.undecided.iter().position(|(other, _)| *other == item)?;
        self.undecided.remove(at)
    }
}

impl Incoming {
    pub(super) const fn new(
        source: RobotId,
        stream: Stream,
        upto: u32,
        set: u32,
        tiles: u32,
        now: Stamp,
    ) -> Self {
        Self {
            source,
            stream,
            upto,
            set,
            tiles,
            accepted: IntervalSet::new(HELD_INTERVALS_MAX),
            touched: now,
        }
    }
}
