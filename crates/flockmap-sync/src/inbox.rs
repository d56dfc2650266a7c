//! Packages going into the map: held until what they build on is there, given out in an order in which they
//! decode, and each given one verdict. As quinn's `Assembler` for the bytes of a stream. Nothing is decoded
//! here.

mod chains;
mod transfer;
mod waiting;

pub(crate) use chains::CHUNKS_WAITING_MAX;
pub(crate) use transfer::{ABANDONED, Transfer};
pub(crate) use waiting::WAITING_BYTES_MAX;

use crate::item::Item;
use crate::{Cast, IntervalSet, Store};
use chains::{ChainId, Chains, Place};
use core::time::Duration;
use flockmap_codec::Package;
use flockmap_grid::{RobotId, Stamp, Stream};
use std::collections::{BTreeMap, BTreeSet};
use waiting::Waiting;

/// Packages and chunks that are in here at a time; more are dropped, counted, and come again by a later request.
pub(crate) const PENDING_MAX: usize = 4_096;
/// What was damaged, or had no room, is not asked for again for so long.
const BACK_OFF: Duration = Duration::from_secs(10);
/// Of these so many are remembered; of more, the one whose pause ends first is asked for again.
const BACKED_OFF_MAX: usize = 1_024;
/// Intervals in the undecodable indices of one stream.
const UNDECODABLE_INTERVALS_MAX: usize = 64;
/// Damaged packages remembered; of more, all are forgotten.
const DAMAGED_MAX: usize = 256;

/// What became of a package that was given out by [`Event::Received`](crate::Event::Received).
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Verdict {
    /// It is in the map, or will never fit this map but may fit others: it counts as held and is offered to
    /// others.
    Merged,
    /// It does not decode, and is asked for again after 10 s. A chunk that builds on others makes its
    /// snapshot begin again: which of them is at fault cannot be known. A package that builds on others and
    /// is damaged for the second time is undecodable: should a layer ever differ from its sender's, this is
    /// what heals it.
    Damaged,
    /// It can never be decoded here, since what it was coded against is gone. It is not asked for again: the
    /// others are asked for a snapshot that contains it, and when that is complete it counts as held. A
    /// chunk, or one package too many (the indices of a stream are kept as at most 64 intervals), is asked
    /// for again after 10 s.
    Undecodable,
    /// There was no room for it. It is asked for again after 10 s.
    NoRoom,
}

/// What is on its way into the map.
#[derive(Debug)]
pub(crate) struct Inbox {
    /// All that is in here, with the peer it came from, until its verdict.
    pending: BTreeSet<(Item, RobotId)>,
    /// Damaged, or without room: not asked for again until then.
    backed_off: BTreeMap<Item, Stamp>,
    /// Of these, packages that had no room to wait: stream, what they wait for, index. At most as many.
    crowded_out: BTreeSet<(Stream, u32, u32)>,
    /// Packages that a snapshot has to bring. Never empty sets.
    undecodable: BTreeMap<Stream, IntervalSet>,
    /// Packages that build on others and were damaged once.
    damaged: BTreeSet<(Stream, u32)>,
    pub(crate) transfers: Vec<Transfer>,
    waiting: Waiting,
    chains: Chains,
    releasing: Option<Releasing>,
}

/// Something was merged: what waited for it comes before all else.
#[derive(Clone, Copy, Debug)]
enum Releasing {
    /// The packages of this stream with a higher index.
    Packages {
        stream: Stream,
        after: u32,
    },
    Chunks(ChainId),
}

/// Whether something that came is taken in.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Intake {
    Taken,
    Duplicate,
    /// Backed off, or undecodable.
    Unwanted,
    Full,
}

/// What to do with something that was taken in, when its turn has come.
#[derive(Debug)]
pub(crate) enum Ready {
    Decodable(Package),
    /// It waits for what it builds on, for which these had to go.
    Waits(Vec<Package>),
    /// Its chunk was merged before.
    Merged(Package),
    /// It needs no verdict any more.
    Settled,
    /// It needs the place of another snapshot, of which all chunks are needed again then.
    TakesPlaceOf(ChainId, Package),
}

impl Inbox {
    pub(crate) fn new(transfers_max: usize) -> Self {
        Self {
            pending: BTreeSet::new(),
            backed_off: BTreeMap::new(),
            crowded_out: BTreeSet::new(),
            undecodable: BTreeMap::new(),
            damaged: BTreeSet::new(),
            transfers: Vec::new(),
            waiting: Waiting::default(),
            chains: Chains::new(transfers_max),
            releasing: None,
        }
    }

    /// Takes something in, unless it is there already (`is_received`: in the map), or not wanted now.
    pub(crate) fn take_in(&mut self, now: Stamp, from: RobotId, item: Item, is_received: bool) -> Intake {
        let is_pending = match item {
            // Whoever it came from, it is the same.
            Item::Package { .. } => self.is_pending(item),
            // Chunks count for the robot that they came from.
            Item::Chunk { .. } => self.pending.contains(&(item, from)),
        };
        if is_received || is_pending {
            Intake::Duplicate
        } else if self.backed_off.get(&item).is_some_and(|&until| until > now) || self.is_undecodable(item) {
            Intake::Unwanted
        } else if self.pending.len() >= PENDING_MAX {
            Intake::Full
        } else {
            self.pending.insert((item, from));
            Intake::Taken
        }
    }

    /// Looks at something that was taken in.
    pub(crate) fn look_at(&mut self, package: Package, store: &Store) -> Ready {
        let header = *package.header();
        if !self.is_pending(Item::of(&package)) {
            Ready::Settled
        } else if let Some((id, chunk)) = Chains::place_of(&package) {
            let is_received = |id| self.transfers.iter().any(|t| (t.stream, t.snapshot_id) == id);
            if let Some(dropped) = self.chains.open(id, header.index, is_received) {
                return Ready::TakesPlaceOf(dropped, package);
            }
            match self.chains.place(id, chunk) {
                Place::Merged => Ready::Merged(package),
                Place::Next => Ready::Decodable(package),
                Place::Later => Ready::Waits(self.chains.wait(id, chunk, package).into_iter().collect()),
            }
        } else if header.base > prefix(store, header.stream) {
            Ready::Waits(self.waiting.insert(package))
        } else {
            Ready::Decodable(package)
        }
    }

    /// Whether something may be next of what waited.
    pub(crate) const fn is_releasing(&self) -> bool {
        self.releasing.is_some()
    }

    /// The next of what waited for something that was merged.
    pub(crate) fn next_released(&mut self, store: &Store) -> Option<Package> {
        loop {
            let package = match self.releasing? {
                Releasing::Chunks(id) => self.chains.take_next(id),
                Releasing::Packages { stream, after } => {
                    self.waiting.take_ready(stream, after, prefix(store, stream))
                }
            };
            let Some(package) = package else {
                self.releasing = None;
                continue;
            };
            if let Some(Releasing::Packages { after, .. }) = &mut self.releasing {
                // A package that has to go on waiting keeps the prefix below itself: none before it can
                // become ready meanwhile.
                *after = package.header().index;
            }
            if self.is_pending(Item::of(&package)) {
                return Some(package);
            }
        }
    }

    /// Something was merged: what waited for it may be ready.
    pub(crate) fn release(&mut self, package: &Package) {
        if let Some((id, chunk)) = Chains::place_of(package) {
            self.chains.note_merged(id, chunk);
            self.releasing = Some(Releasing::Chunks(id));
        } else if self.releasing.is_none() {
            self.release_stream(package.header().stream);
        }
    }

    /// More packages of a stream are in the map: what waited for them may be ready.
    pub(crate) fn release_stream(&mut self, stream: Stream) {
        self.releasing = Some(Releasing::Packages { stream, after: 0 });
    }

    /// Takes out something for which there is a verdict now, with the peer it came from. A chunk may have
    /// come from several.
    pub(crate) fn take_out(&mut self, item: Item) -> Option<RobotId> {
        let entry = *self.pending.range(all_of(item)).next()?;
        self.pending.remove(&entry);
        Some(entry.1)
    }

    /// Something is not asked for again for a while.
    pub(crate) fn back_off(&mut self, now: Stamp, item: Item) {
        self.backed_off.retain(|_, until| *until > now);
        if self.backed_off.len() >= BACKED_OFF_MAX
            && let Some(first) =
                self.backed_off.iter().min_by_key(|(_, until)| **until).map(|(item, _)| *item)
        {
            self.backed_off.remove(&first);
        }
        self.backed_off.insert(item, now.plus(BACK_OFF));
    }

    /// A package is backed off for one reason: there was no room for it to wait for its base.
    pub(crate) fn note_crowded_out(&mut self, stream: Stream, base: u32, index: u32) {
        if self.crowded_out.len() < BACKED_OFF_MAX {
            self.crowded_out.insert((stream, base, index));
        }
    }

    /// Packages that had no room to wait, and need to wait no more, may be asked for again at once. Whether there
    /// are any.
    pub(crate) fn welcome_back(&mut self, stream: Stream, store: &Store) -> bool {
        let upto = (stream, prefix(store, stream), u32::MAX);
        let mut any = false;
        while let Some(&(_, base, index)) = self.crowded_out.range((stream, 0, 0)..=upto).next() {
            self.crowded_out.remove(&(stream, base, index));
            any |= self.backed_off.remove(&Item::Package { stream, index }).is_some();
        }
        any
    }

    pub(crate) fn end_back_off(&mut self, item: Item) {
        self.backed_off.remove(&item);
    }

    /// Notes that a package can never be decoded here; whether there was room for that.
    pub(crate) fn note_undecodable(&mut self, stream: Stream, index: u32) -> bool {
        let nothing = || IntervalSet::new(UNDECODABLE_INTERVALS_MAX);
        self.undecodable.entry(stream).or_insert_with(nothing).insert(index).is_ok()
    }

    /// Whether a package that builds on others was damaged before: asking for it again does not help then.
    pub(crate) fn is_damaged_again(&mut self, package: &Package) -> bool {
        let header = package.header();
        if header.is_independent {
            return false;
        }
        if self.damaged.len() >= DAMAGED_MAX {
            self.damaged.clear();
        }
        !self.damaged.insert((header.stream, header.index))
    }

    /// What was read of a snapshot is gone: it is read anew from its first chunk on. What of it waited needs
    /// no verdict any more.
    pub(crate) fn restart(&mut self, stream: Stream, snapshot_id: u32) {
        self.chains.drop_one((stream, snapshot_id));
        for transfer in
            self.transfers.iter_mut().filter(|t| t.stream == stream && t.snapshot_id == snapshot_id)
        {
            transfer.restart();
        }
        let is_of_set = |item: &Item| matches!(item, Item::Chunk { stream: s, snapshot_id: n, .. } if *s == stream && *n == snapshot_id);
        self.pending.retain(|(item, _)| !is_of_set(item));
    }

    /// Whether something of a snapshot was given out to be read, from whomever it came.
    pub(crate) fn has_read(&self, stream: Stream, snapshot_id: u32) -> bool {
        self.chains.has((stream, snapshot_id))
    }

    /// What came of a stream by snapshots may be gone again.
    pub(crate) fn spoil(&mut self, stream: Stream) {
        self.chains.spoil(stream);
        let transfers = self.transfers.iter_mut().filter(|transfer| transfer.stream == stream);
        transfers.for_each(|transfer| transfer.is_spoiled = true);
    }

    /// Whether what was read of a snapshot may be gone, and nobody else is sending it: it is to be read anew then.
    pub(crate) fn is_spoiled(&self, stream: Stream, snapshot_id: u32) -> bool {
        let is_sent = self.transfers.iter().any(|t| (t.stream, t.snapshot_id) == (stream, snapshot_id));
        !is_sent && self.chains.is_spoiled((stream, snapshot_id))
    }

    /// What these packages of a stream say is in the map: those that waited, for a verdict or for a snapshot,
    /// need none.
    pub(crate) fn settle(&mut self, stream: Stream, known: &IntervalSet) {
        self.pending.retain(|(item, _)| match *item {
            Item::Package { stream: of, index } => of != stream || !known.contains(index),
            Item::Chunk { .. } => true,
        });
        if let Some(undecodable) = self.undecodable.get_mut(&stream) {
            *undecodable = undecodable.difference(known);
            if undecodable.is_empty() {
                self.undecodable.remove(&stream);
            }
        }
    }

    /// All packages of a stream up to one are in the map: lets go of what waited and says no more.
    pub(crate) fn drop_upto(&mut self, stream: Stream, upto: u32) {
        self.waiting.drop_upto(stream, upto);
        self.chains.drop_upto(stream, upto);
    }

    /// Forgets a stream. What waited of it goes with [`drop_upto`](Self::drop_upto).
    pub(crate) fn forget(&mut self, stream: Stream) {
        self.crowded_out.retain(|(of, _, _)| *of != stream);
        self.transfers.retain(|transfer| transfer.stream != stream);
        self.pending.retain(|(item, _)| item.stream() != stream);
        self.undecodable.remove(&stream);
    }

    /// For want of room one snapshot takes the place of another, the one of which nothing has come for
    /// longest. By unicast a robot sends one snapshot of a stream at a time, so a newer one takes over. By
    /// broadcast two snapshots for two robots would push each other out without end: there, and of other
    /// robots and streams, only a snapshot that goes on from what was received takes a place, and that of one
    /// that does not go on: complete or, of the same stream, not, it waits for packages before it; or it is
    /// from the own disk. What that brought is merged; what it contains may have to come again. Whether one
    /// went.
    pub(crate) fn make_room(&mut self, newcomer: &Transfer, own: RobotId, cast: Cast, store: &Store) -> bool {
        let goes_on = |i: &Transfer| i.since <= prefix(store, i.stream);
        let gives_room = |i: &Transfer| {
            let is_same_stream = i.stream == newcomer.stream;
            let is_idle = i.source == own || (!goes_on(i) && (i.is_complete() || is_same_stream));
            let is_replaced = is_same_stream && i.source == newcomer.source && cast == Cast::Unicast;
            is_replaced || (is_idle && goes_on(newcomer) && newcomer.source != own)
        };
        let candidates = self.transfers.iter().enumerate().filter(|(_, transfer)| gives_room(transfer));
        let Some((oldest, _)) = candidates.min_by_key(|(_, transfer)| transfer.touched) else { return false };
        self.transfers.remove(oldest);
        self.forget_chunks_of_nothing();
        true
    }

    /// Lets go of transfers that are done or abandoned: nothing came of them for as long as is said of their source.
    /// Returns how many of them brought nothing.
    pub(crate) fn drop_done(
        &mut self,
        now: Stamp,
        store: &Store,
        patience: impl Fn(RobotId) -> Duration,
    ) -> u64 {
        let before = self.transfers.len();
        let mut abandoned = 0;
        self.transfers.retain(|transfer| {
            let is_received =
                store.received(transfer.stream).is_some_and(|received| transfer.is_in(received));
            let is_abandoned = !is_received && transfer.is_abandoned(now, patience(transfer.source));
            abandoned += u64::from(is_abandoned);
            !is_received && !is_abandoned
        });
        if self.transfers.len() < before {
            self.forget_chunks_of_nothing();
        }
        abandoned
    }

    /// Lets go of transfers from a robot that holds nothing any more of their streams: the chunks that are
    /// wanting will not come, and as long as it is named nobody else sends what they would say. Returns how
    /// many they were.
    pub(crate) fn drop_forgotten(&mut self, source: RobotId, has_nothing_of: impl Fn(Stream) -> bool) -> u64 {
        let before = self.transfers.len();
        self.transfers.retain(|transfer| {
            transfer.source != source || transfer.is_complete() || !has_nothing_of(transfer.stream)
        });
        let dropped = before - self.transfers.len();
        if dropped > 0 {
            self.forget_chunks_of_nothing();
        }
        dropped as u64
    }

    /// Chunks of transfers that are gone need no verdict any more.
    fn forget_chunks_of_nothing(&mut self) {
        let transfers = &self.transfers;
        self.pending.retain(|&(item, from)| match item {
            Item::Package { .. } => true,
            Item::Chunk { stream, snapshot_id, .. } => {
                transfers.iter().any(|t| (t.source, t.stream, t.snapshot_id) == (from, stream, snapshot_id))
            }
        });
    }

    pub(crate) fn is_pending(&self, item: Item) -> bool {
        self.pending.range(all_of(item)).next().is_some()
    }

    fn is_undecodable(&self, item: Item) -> bool {
        match item {
            Item::Package { stream, index } => {
                self.undecodable.get(&stream).is_some_and(|undecodable| undecodable.contains(index))
            }
            Item::Chunk { .. } => false,
        }
    }

    /// The streams of which a snapshot has to bring something, with the packages that it should contain.
    pub(crate) const fn undecodable(&self) -> &BTreeMap<Stream, IntervalSet> {
        &self.undecodable
    }

    /// Packages of a stream that nobody shall send just now: pending, backed off, or undecodable.
    pub(crate) fn unwanted_packages(&self, stream: Stream, now: Stamp) -> Vec<(u32, u32)> {
        let item = |index| Item::Package { stream, index };
        let index = |item: Item| match item {
            Item::Package { index, .. } => Some((index, index)),
            Item::Chunk { .. } => None,
        };
        let (first, last) = (item(0), item(u32::MAX));
        let backed_off = self.backed_off.range(first..=last).filter(|(_, until)| **until > now);
        let pending = self.pending.range((first, RobotId(0))..=(last, RobotId(u16::MAX)));
        let undecodable = self.undecodable.get(&stream).map(IntervalSet::intervals).unwrap_or_default();
        let mut unwanted: Vec<(u32, u32)> = backed_off.filter_map(|(item, _)| index(*item)).collect();
        unwanted.extend(pending.filter_map(|(item, _)| index(*item)));
        unwanted.extend(undecodable);
        unwanted
    }

    /// Number + 1 of the chunks of a transfer that its source shall not send just now: pending, or backed off.
    pub(crate) fn unwanted_chunks(&self, transfer: &Transfer, now: Stamp) -> Vec<(u32, u32)> {
        let item = |chunk| Item::Chunk { stream: transfer.stream, snapshot_id: transfer.snapshot_id, chunk };
        let number = |item: Item| match item {
            Item::Chunk { chunk, .. } => Some((chunk + 1, chunk + 1)),
            Item::Package { .. } => None,
        };
        let (first, last) = (item(0), item(u32::MAX));
        let backed_off = self.backed_off.range(first..=last).filter(|(_, until)| **until > now);
        let pending = self.pending.range((first, RobotId(0))..=(last, RobotId(u16::MAX)));
        let pending = pending.filter(|(_, source)| *source == transfer.source);
        let mut unwanted: Vec<(u32, u32)> = backed_off.filter_map(|(item, _)| number(*item)).collect();
        unwanted.extend(pending.filter_map(|(item, _)| number(*item)));
        unwanted
    }

    /// Sizes: pending, backed off.
    pub(crate) fn load(&self) -> (usize, usize) {
        (self.pending.len(), self.backed_off.len())
    }

    /// A package that waits for those that it builds on.
    pub(crate) fn waiting_package(&self, stream: Stream, index: u32) -> Option<&Package> {
        self.waiting.get(stream, index)
    }

    /// Packages that wait for those that they build on, and their bytes with bookkeeping.
    pub(crate) fn waiting(&self) -> (usize, usize) {
        self.waiting.load()
    }
}

fn all_of(item: Item) -> std::ops::RangeInclusive<(Item, RobotId)> {
    (item, RobotId(0))..=(item, RobotId(u16::MAX))
}

/// All packages of a stream from 1 to this one are in the map.
fn prefix(store: &Store, stream: Stream) -> u32 {
    store.received(stream).map_or(0, IntervalSet::prefix)
}
