//! All packages that a robot holds: the paper's containers H, one per stream.

use crate::IntervalSet;
use crate::milestones::Milestones;
use flockmap_codec::Package;
use flockmap_grid::mutation::{self, Mutation};
use flockmap_grid::{RobotId, Stamp, Stream};
use std::collections::{BTreeMap, BTreeSet};

/// Intervals in the index list of one stream. Packages that would tear more holes than that are refused until
/// some are filled. Worst case 8 KiB a stream.
pub const HELD_INTERVALS_MAX: usize = 1_024;

/// Bookkeeping counted for each stored package beside its bytes: what it takes in memory, places in half-full maps counted in.
const PACKAGE_OVERHEAD_BYTES: usize = 400;

/// What a [`Store`] may hold.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct StoreLimits {
    /// Streams besides the own one. Worst case 24 KiB each, beside the packages.
    pub streams_max: usize,
    /// Runs of one origin; of more, the oldest is forgotten.
    pub epochs_max: usize,
    /// Bytes of all packages, with 400 bytes of bookkeeping for each. Past it the oldest packages are dropped,
    /// the own stream's last. A dropped package stays *held*; it just cannot be sent again as it was.
    pub bytes_max: usize,
}

/// A package in the store.
#[derive(Clone, Debug)]
pub struct Stored {
    /// The package.
    pub package: Package,
    /// When it came into the store, on the own clock.
    pub stored_at: Stamp,
    /// When its cycle ended, on the own clock as well as that is known; never after `stored_at`.
    pub fresh_at: Stamp,
}

/// What is held and stored of one stream.
#[derive(Debug)]
struct Shelf {
    held: IntervalSet,
    /// Highest index known to exist, from packages and from what others state.
    newest_known: u32,
    stored: BTreeMap<u32, Stored>,
    /// Outlives the packages.
    milestones: Milestones,
    bytes: usize,
}

/// Packages by stream. *Held* is what was taken into the map; *stored* is what of it can be sent on as it came.
#[derive(Debug)]
pub struct Store {
    own: Stream,
    limits: StoreLimits,
    shelves: BTreeMap<Stream, Shelf>,
    /// Packages of other streams, oldest first: the order of dropping.
    by_age: BTreeSet<(Stamp, Stream, u32)>,
    bytes: usize,
    dropped: u64,
    /// Origins of which streams were forgotten, with the lowest epoch that is still wanted.
    floors: BTreeMap<RobotId, u64>,
}

/// Why a stream or a package has no place in the store.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum NoRoom {
    /// As many streams as may be.
    Streams,
    /// An epoch older than those kept of its origin.
    OldEpoch,
    /// Too many holes in the index list.
    Intervals,
}

impl Store {
    pub(crate) fn new(own: Stream, limits: StoreLimits) -> Self {
        let mut shelves = BTreeMap::new();
        shelves.insert(own, Shelf::new());
        Self { own, limits, shelves, by_age: BTreeSet::new(), bytes: 0, dropped: 0, floors: BTreeMap::new() }
    }

    /// The streams of which something is known, in ascending order; the own one is always among them.
    pub fn streams(&self) -> impl Iterator<Item = Stream> + '_ {
        self.shelves.keys().copied()
    }

    /// Indices held of a stream; `None` for an unknown stream.
    pub fn held(&self, stream: Stream) -> Option<&IntervalSet> {
        self.shelves.get(&stream).map(|shelf| &shelf.held)
    }

    /// The highest index of a stream that is known to exist, held or not; 0 if none is.
    pub fn newest_known(&self, stream: Stream) -> u32 {
        self.shelves.get(&stream).map_or(0, |shelf| shelf.newest_known)
    }

    /// Indices of a stream that are known to exist and not held, as ascending closed intervals.
    pub fn missing(&self, stream: Stream) -> impl DoubleEndedIterator<Item = (u32, u32)> + '_ {
        self.shelves.get(&stream).into_iter().flat_map(|shelf| shelf.held.missing(1, shelf.newest_known))
    }

    /// A stored package.
    pub fn get(&self, stream: Stream, index: u32) -> Option<&Stored> {
        self.shelves.get(&stream)?.stored.get(&index)
    }

    /// The stored packages of a stream with an index from `low` to `high`, ascending.
    pub fn range(
        &self,
        stream: Stream,
        low: u32,
        high: u32,
    ) -> impl DoubleEndedIterator<Item = (u32, &Stored)> + '_ {
        self.shelves
            .get(&stream)
            .filter(|_| low <= high)
            .into_iter()
            .flat_map(move |shelf| shelf.stored.range(low..=high).map(|(&index, stored)| (index, stored)))
    }

    /// A stamp of the stream's robot that no package from `index` on is older than, as late as is known; for packages that
    /// are not stored any more it may be that of an earlier one. `None` if nothing is known of any up to `index`.
    pub fn stamp_not_after(&self, stream: Stream, index: u32) -> Option<Stamp> {
        let shelf = self.shelves.get(&stream)?;
        let stored = shelf.stored.range(..=index).next_back();
        shelf.milestones.not_after(index).max(stored.map(|(_, stored)| stored.package.header().cycle_end))
    }

    /// Bytes of all stored packages, with their bookkeeping.
    pub const fn bytes(&self) -> usize {
        self.bytes
    }

    /// Packages stored now.
    pub fn packages(&self) -> usize {
        self.shelves.values().map(|shelf| shelf.stored.len()).sum()
    }

    /// Packages dropped so far to stay within the byte limit.
    pub const fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Origins of which old runs were forgotten, with the lowest epoch still wanted. At most `streams_max`.
    pub(crate) const fn floors(&self) -> &BTreeMap<RobotId, u64> {
        &self.floors
    }

    pub(crate) fn is_full_of_streams(&self) -> bool {
        self.shelves.len() > self.limits.streams_max
    }

    /// Makes a place for a stream; whether it is new, and the old run that had to go for it.
    pub(crate) fn open(&mut self, stream: Stream) -> Result<(bool, Option<Stream>), NoRoom> {
        if self.shelves.contains_key(&stream) {
            return Ok((false, None));
        }
        if self.floors.get(&stream.origin).is_some_and(|&floor| stream.epoch < floor) {
            return Err(NoRoom::OldEpoch);
        }
        let of_origin = |epoch| Stream { origin: stream.origin, epoch };
        let mut runs = self.shelves.range(of_origin(0)..=of_origin(u64::MAX)).map(|(stream, _)| *stream);
        let oldest = runs.clone().find(|&run| run != self.own);
        let forgotten = if runs.by_ref().filter(|&run| run != self.own).count() >= self.limits.epochs_max {
            let Some(oldest) = oldest.filter(|oldest| oldest.epoch < stream.epoch) else {
                // Said to all, so that nobody offers it for ever.
                self.floors.extend(oldest.map(|oldest| (stream.origin, oldest.epoch)));
                return Err(NoRoom::OldEpoch);
            };
            self.forget(oldest);
            self.floors.insert(stream.origin, oldest.epoch.saturating_add(1));
            Some(oldest)
        } else if self.is_full_of_streams() {
            return Err(NoRoom::Streams);
        } else {
            None
        };
        self.shelves.insert(stream, Shelf::new());
        Ok((true, forgotten))
    }

    fn forget(&mut self, stream: Stream) {
        if let Some(shelf) = self.shelves.remove(&stream) {
            self.bytes -= shelf.bytes;
            self.dropped += shelf.stored.len() as u64;
            for (index, stored) in shelf.stored {
                self.by_age.remove(&(stored.fresh_at, stream, index));
            }
        }
    }

    /// Notes that packages up to `index` exist; whether that is news.
    pub(crate) fn note_newest(&mut self, stream: Stream, index: u32) -> bool {
        let Some(shelf) = self.shelves.get_mut(&stream) else { return false };
        let news = index > shelf.newest_known;
        shelf.newest_known = shelf.newest_known.max(index);
        news
    }

    /// Marks indices as held without a package to send on; whether any was new.
    pub(crate) fn hold(&mut self, stream: Stream, low: u32, high: u32) -> Result<bool, NoRoom> {
        self.open(stream)?;
        let Some(shelf) = self.shelves.get_mut(&stream) else { return Err(NoRoom::Streams) };
        shelf.newest_known = shelf.newest_known.max(high);
        shelf.held.insert_range(low, high).map_err(|_| NoRoom::Intervals)
    }

    /// Puts a package away and drops the oldest ones if there are too many bytes; whether it was new.
    pub(crate) fn insert(&mut self, package: &Package, now: Stamp, fresh_at: Stamp) -> Result<bool, NoRoom> {
        let (stream, index) = (package.header().stream, package.header().index);
        let is_new = self.hold(stream, index, index)?;
        let Some(shelf) = self.shelves.get_mut(&stream) else { return Err(NoRoom::Streams) };
        if !is_new {
            return Ok(false);
        }
        shelf.milestones.note(index, package.header().cycle_end);
        let fresh_at = fresh_at.min(now);
        let bytes = package.bytes().len() + PACKAGE_OVERHEAD_BYTES;
        shelf.stored.insert(index, Stored { package: package.clone(), stored_at: now, fresh_at });
        shelf.bytes += bytes;
        self.bytes += bytes;
        if stream != self.own {
            self.by_age.insert((fresh_at, stream, index));
        }
        while self.bytes > self.limits.bytes_max
            && !mutation::is(Mutation::StoreLimitIgnored)
            && self.drop_oldest()
        {}
        Ok(true)
    }

    fn drop_oldest(&mut self) -> bool {
        let oldest = match self.by_age.pop_first() {
            Some((_, stream, index)) => Some((stream, index)),
            None => self
                .shelves
                .get(&self.own)
                .and_then(|shelf| shelf.stored.first_key_value())
                .map(|(&index, _)| (self.own, index)),
        };
        let Some((stream, index)) = oldest else { return false };
        if let Some(shelf) = self.shelves.get_mut(&stream)
            && let Some(stored) = shelf.stored.remove(&index)
        {
            let bytes = stored.package.bytes().len() + PACKAGE_OVERHEAD_BYTES;
            shelf.bytes -= bytes;
            self.bytes -= bytes;
            self.dropped += 1;
        }
        true
    }
}

impl Shelf {
    const fn new() -> Self {
        Self {
            held: IntervalSet::new(HELD_INTERVALS_MAX),
            newest_known: 0,
            stored: BTreeMap::new(),
            milestones: Milestones::new(),
            bytes: 0,
        }
    }
}
