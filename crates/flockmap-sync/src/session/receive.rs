//! Packages that come in, and the driver's verdict on them.

use super::peer::Item;
use super::present::Incoming;
use super::{EVENTS_MAX, Event, Session};
use crate::store::{HELD_INTERVALS_MAX, NoRoom};
use crate::wire::Contents;
use crate::{Cast, IntervalSet};
use flockmap_codec::{ContentKind, Package};
use flockmap_grid::{RobotId, Stamp, Stream};

/// A rejected package is not asked for again for so long.
const REFUSED_FOR: i64 = 10_000_000;
/// Rejected packages remembered; of more, the one whose pause ends first is asked for again.
const REFUSED_MAX: usize = 1_024;
/// Intervals in the indices given up of one stream.
const GIVEN_UP_INTERVALS_MAX: usize = 64;

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
            if stream == self.own {
                self.counters.own_returned += 1;
                if index > self.store.newest_known(stream) {
                    self.note_own_run_used(now);
                }
            } else if self.open_stream(stream) {
                match package.header().content {
                    ContentKind::Changes => self.receive_changes(now, sender.origin, package),
                    ContentKind::Present { since, set, tile, tiles } => {
                        let incoming = Incoming::new(sender.origin, stream, [since, index], set, tiles, now);
                        self.receive_tile(now, incoming, tile, package);
                    }
                }
            }
        }
        for Contents { stream, set, held } in contents {
            let is_of = |i: &&mut Incoming| (i.source, i.stream, i.set) == (sender.origin, stream, set);
            if let Some(incoming) = self.incoming.iter_mut().find(is_of) {
                incoming.contents = Some(held);
            }
        }
    }

    fn receive_changes(&mut self, now: Stamp, from: RobotId, package: Package) {
        let (stream, index) = (package.header().stream, package.header().index);
        let newest = self.store.newest_known(stream);
        if self.store.note_newest(stream, index, now) && index - newest > 1 {
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
                    if peer.cover_heard(item, now, 2 * self.config.in_flight_max) {
                        self.counters.suppressed += 1;
                    }
                }
            }
        }
    }

    fn receive_tile(&mut self, now: Stamp, tile_of: Incoming, tile: u32, package: Package) {
        let (stream, upto) = (tile_of.stream, tile_of.upto);
        self.store.note_newest(stream, upto, now);
        if self.store.held(stream).is_some_and(|held| held.contains_range(1, upto)) {
            self.counters.duplicates += 1;
            return;
        }
        let from = tile_of.source;
        let at = match self.incoming.iter().position(|incoming| incoming.is_same(&tile_of)) {
            Some(at) => at,
            None => {
                // Sets of one robot are kept side by side: by broadcast, one that it sends to somebody else is
                // heard among the tiles of the one for us.
                if self.incoming.len() >= self.config.transfers_max {
                    self.finish_transfers(now);
                }
                if self.incoming.len() >= self.config.transfers_max {
                    self.make_way(&tile_of);
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
        let item = Item::Tile { stream, set: incoming.set, tile };
        let held = incoming.accepted.contains(tile + 1);
        if !held {
            // One of which nothing new comes keeps its place from others no longer than one of which nothing comes.
            incoming.touched = now;
        }
        self.deliver(now, from, item, held, package);
        // If the rest gets lost, say soon which tiles are missing.
        self.note_gap(now, false);
    }

    /// For want of room one set takes the place of another, the one of which nothing has come for longest. By unicast a robot sends one set of a
    /// stream at a time, so a newer one takes over. By broadcast two sets for two robots would push each other out without end: there, and of
    /// other robots and streams, only a set that goes on from what is held takes a place, and that of one that does not go on: complete or,
    /// of the same stream, not, it waits for packages before it; or it is from the own disk. What that brought is merged; what it
    /// contains may have to come again.
    fn make_way(&mut self, newcomer: &Incoming) {
        let own = self.own.origin;
        let goes_on = |i: &Incoming| i.since <= self.store.held(i.stream).map_or(0, IntervalSet::prefix);
        let gives_way = |i: &Incoming| {
            let is_same_stream = i.stream == newcomer.stream;
            let is_idle = i.source == own || (!goes_on(i) && (i.is_complete() || is_same_stream));
            let is_replaced =
                is_same_stream && i.source == newcomer.source && self.config.cast == Cast::Unicast;
            is_replaced || (is_idle && goes_on(newcomer) && newcomer.source != own)
        };
        let way = self.incoming.iter().enumerate().filter(|(_, incoming)| gives_way(incoming));
        if let Some((oldest, _)) = way.min_by_key(|(_, incoming)| incoming.touched) {
            self.incoming.remove(oldest);
            self.counters.transfers_dropped += 1;
            self.forget_tiles_of_nothing();
        }
    }

    fn deliver(&mut self, now: Stamp, from: RobotId, item: Item, held: bool, package: Package) {
        let is_undecided = match item {
            // Whoever it came from, it is the same.
            Item::Package { .. } => self.is_undecided(item),
            // Tiles count for the robot that they came from.
            Item::Tile { .. } => self.undecided.contains(&(item, from)),
        };
        if held || is_undecided {
            self.counters.duplicates += 1;
        } else if self.is_refused(item, now) || self.is_given_up(item) {
            self.counters.rejected += 1;
        } else if self.undecided.len() >= EVENTS_MAX || self.events.len() >= EVENTS_MAX {
            self.counters.events_overflowed += 1;
        } else {
            self.counters.received += 1;
            self.undecided.insert((item, from));
            self.events.push_back(Event::Received(package));
        }
    }

    /// The package of an [`Event::Received`] is decoded and merged: it counts as held and is offered to others.
    /// A package that is not waiting for a verdict is ignored.
    pub fn accept(&mut self, now: Stamp, package: &Package) {
        let now = self.advance(now);
        // A tile may have come from several.
        while let Some((item, from)) = self.take_undecided(package) {
            self.refused.remove(&item);
            match item {
                Item::Package { stream, index } => self.accept_changes(now, stream, index, package),
                Item::Tile { stream, set, tile } => self.accept_tile(now, from, stream, set, tile),
            }
            self.note_activity(now);
        }
    }

    fn accept_changes(&mut self, now: Stamp, stream: Stream, index: u32, package: &Package) {
        let offset = self.clock_offset(stream);
        let fresh_at =
            offset.map_or(now, |offset| package.header().cycle_end.plus_micros(offset.saturating_neg()));
        let fills_gap = self.store.held(stream).and_then(IntervalSet::last).is_some_and(|last| last > index);
        match self.store.insert(package, now, fresh_at) {
            Ok(is_new) => {
                // A span may have waited for this one.
                if self.incoming.iter().any(|incoming| incoming.stream == stream && incoming.is_complete()) {
                    self.finish_transfers(now);
                }
                self.counters.accepted += u64::from(is_new);
                self.counters.repaired += u64::from(is_new && fills_gap);
                if is_new && fills_gap {
                    self.note_gap_filled();
                }
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

    /// Whether tiles of this present state are being received: at most [`transfers_max`](crate::SessionConfig::transfers_max) at once are.
    pub fn is_receiving(&self, stream: Stream, set: u32) -> bool {
        self.incoming.iter().any(|incoming| incoming.stream == stream && incoming.set == set)
    }

    /// The driver has let go of what the tiles of a present state said, and needs all of them again to go on: those accepted or
    /// undecided count no more. Rejected ones stay so for their time.
    pub fn restart_present_state(&mut self, now: Stamp, stream: Stream, set: u32) {
        let now = self.advance(now);
        for incoming in self.incoming.iter_mut().filter(|i| i.stream == stream && i.set == set) {
            incoming.accepted = IntervalSet::new(HELD_INTERVALS_MAX);
        }
        let is_of_set =
            |item: &Item| matches!(item, Item::Tile { stream: s, set: n, .. } if *s == stream && *n == set);
        self.undecided.retain(|(item, _)| !is_of_set(item));
        self.counters.present_states_restarted += 1;
        self.note_gap(now, true);
    }

    /// Counts as held what completely received present states contain; lets go of transfers that are done,
    /// overtaken or abandoned.
    pub(super) fn finish_transfers(&mut self, now: Stamp) {
        let mut complete: Vec<_> = self
            .incoming
            .iter()
            .filter(|incoming| incoming.is_complete())
            .map(|i| (i.stream, i.since, i.upto, i.contents.clone().map(|contents| (i.set, contents))))
            .collect();
        // One may be what the next one waits for.
        complete.sort_unstable_by_key(|(stream, since, upto, _)| (*stream, *since, *upto));
        for (stream, since, upto, contents) in complete {
            let Some(held) = self.store.held(stream) else { continue };
            // What is wanting before it comes as packages, or by another present state.
            let prefix = held.prefix();
            let by_prefix = (prefix >= since && prefix < upto)
                .then(|| IntervalSet::from_intervals(1, vec![(since + 1, upto)]));
            let (news, contents) = match (by_prefix, contents) {
                (Some(news), _) => (news, None),
                (None, Some((set, contents))) => (contents.difference(held), Some((set, contents))),
                (None, None) => continue,
            };
            if news.is_empty() {
                continue;
            }
            let mut is_held = true;
            for &(low, high) in news.intervals() {
                is_held &= self.store.hold(stream, low, high, now).is_ok();
            }
            self.settle(stream, &news);
            if is_held {
                self.counters.caught_up += 1;
                let upto = self.store.held(stream).map_or(0, IntervalSet::prefix);
                if let Some((set, held)) = contents {
                    self.push_event(Event::StateContains { stream, set, held });
                }
                self.push_event(Event::CaughtUp { stream, upto });
                self.mark_queues_stale();
                // The sender should learn soon that it can stop, and what came after.
                self.greet(now);
            } else {
                // Stays complete, and counts once some gaps are filled.
                self.counters.too_fragmented += 1;
            }
        }
        let store = &self.store;
        let before = self.incoming.len();
        let mut dropped = 0;
        self.incoming.retain(|incoming| {
            let held = store.held(incoming.stream).is_some_and(|held| incoming.is_in(held));
            let is_abandoned = !held && incoming.is_abandoned(now);
            dropped += u64::from(is_abandoned);
            !held && !is_abandoned
        });
        self.counters.transfers_dropped += dropped;
        if self.incoming.len() < before {
            self.forget_tiles_of_nothing();
        }
    }

    /// Tiles of transfers that are gone need no verdict any more.
    fn forget_tiles_of_nothing(&mut self) {
        let incoming = &self.incoming;
        self.undecided.retain(|&(item, from)| match item {
            Item::Package { .. } => true,
            Item::Tile { stream, set, .. } => {
                incoming.iter().any(|i| (i.source, i.stream, i.set) == (from, stream, set))
            }
        });
    }

    /// What these packages of a stream say is known: those that waited for a verdict, or for a present state, need none.
    fn settle(&mut self, stream: Stream, known: &IntervalSet) {
        self.undecided.retain(|(item, _)| match *item {
            Item::Package { stream: of, index } => of != stream || !known.contains(index),
            Item::Tile { .. } => true,
        });
        if let Some(given_up) = self.given_up.get_mut(&stream) {
            *given_up = given_up.difference(known);
            if given_up.is_empty() {
                self.given_up.remove(&stream);
            }
        }
    }

    /// The package of an [`Event::Received`] can never be decoded here, since what it was coded against is gone. It is not asked for
    /// again: the others are asked for a present state that contains it. When that is complete, it counts as held. A
    /// tile, or one package too many (the indices of a stream are kept as at most 64 intervals), is rejected.
    pub fn give_up(&mut self, now: Stamp, package: &Package) {
        let now = self.advance(now);
        let Some((item, _)) = self.take_undecided(package) else { return };
        if let Item::Package { stream, index } = item {
            let nothing = || IntervalSet::new(GIVEN_UP_INTERVALS_MAX);
            if self.given_up.entry(stream).or_insert_with(nothing).insert(index).is_ok() {
                self.counters.given_up += 1;
                self.note_gap(now, true);
                return;
            }
        }
        self.refuse(now, item);
    }

    /// The package of an [`Event::Received`] does not decode: it is dropped and asked for again after 10 s.
    pub fn reject(&mut self, now: Stamp, package: &Package) {
        let now = self.advance(now);
        while let Some((item, _)) = self.take_undecided(package) {
            self.refuse(now, item);
        }
    }

    fn refuse(&mut self, now: Stamp, item: Item) {
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
        let entry = *self.undecided.range((item, RobotId(0))..=(item, RobotId(u16::MAX))).next()?;
        self.undecided.remove(&entry);
        Some(entry)
    }

    pub(super) fn is_undecided(&self, item: Item) -> bool {
        self.undecided.range((item, RobotId(0))..=(item, RobotId(u16::MAX))).next().is_some()
    }

    fn is_given_up(&self, item: Item) -> bool {
        match item {
            Item::Package { stream, index } => {
                self.given_up.get(&stream).is_some_and(|given_up| given_up.contains(index))
            }
            Item::Tile { .. } => false,
        }
    }
}

impl Incoming {
    pub(super) const fn new(
        source: RobotId,
        stream: Stream,
        [since, upto]: [u32; 2],
        set: u32,
        tiles: u32,
        now: Stamp,
    ) -> Self {
        Self {
            source,
            stream,
            since,
            upto,
            set,
            tiles,
            accepted: IntervalSet::new(HELD_INTERVALS_MAX),
            contents: None,
            touched: now,
        }
    }
}
