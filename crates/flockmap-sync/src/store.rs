//! All packages that a robot holds: the paper's containers H, one per stream.

use crate::IntervalSet;
use crate::stamp_index::StampIndex;
use flockmap_codec::Package;
use flockmap_grid::{RobotId, Stamp, Stream};
use flockmap_mutation::{self as mutation, Mutation};
use std::collections::{BTreeMap, BTreeSet};

/// Intervals in the index list of one stream. Packages that would tear more holes than that are refused until
/// some are filled. Worst case 8 KiB a stream.
pub const RECEIVED_INTERVALS_MAX: usize = 1_024;

/// Bookkeeping counted for each stored package beside its bytes: what it takes in memory, places in half-full
/// maps counted in.
const PACKAGE_OVERHEAD_BYTES: usize = 400;

/// What a [`Store`] may hold.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct StoreLimits {
    /// Streams besides the own one. Of more, a run that has ended is forgotten: the one of which nothing new
    /// has come for longest. Worst case 24 KiB each, beside the packages.
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
    /// When its batch ended, on the own clock as well as that is known; never after `stored_at`.
    pub fresh_at: Stamp,
}

/// What is held and stored of one stream.
#[derive(Debug)]
struct StreamStore {
    received: IntervalSet,
    /// Highest index known to exist, from packages and from what others state.
    newest_known: u32,
    stored: BTreeMap<u32, Stored>,
    /// Outlives the packages.
    stamp_index: StampIndex,
    bytes: usize,
    /// When something of it was news last.
    touched: Stamp,
    /// What packages up to this one changed may be lacking, of those that are not held.
    changed_upto: u32,
    /// What packages up to this one changed may be in the layer, of those that are not held.
    said_upto: u32,
}

/// Packages by stream. *Held* is what was taken into the map; *stored* is what of it can be sent on as it came.
#[derive(Debug)]
pub struct Store {
    own: Stream,
    limits: StoreLimits,
    streams: BTreeMap<Stream, StreamStore>,
    /// Packages of other streams, oldest first: the order of dropping.
    by_age: BTreeSet<(Stamp, Stream, u32)>,
    bytes: usize,
    dropped: u64,
    /// Origins of which runs were forgotten or refused: none before the oldest one that is here is wanted.
    cut: BTreeSet<RobotId>,
}

/// What a peer misses of a stream up to some index.
pub(crate) struct Missing {
    pub(crate) bytes: u64,
    /// Some of it is not stored any more.
    pub(crate) unstored: bool,
    pub(crate) range: u32,
}

/// A stream that has a place now.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Opened {
    pub(crate) is_new: bool,
    /// The run that had to go for it.
    pub(crate) forgotten: Option<Stream>,
}

/// Why a stream or a package has no place in the store.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum NoRoom {
    /// As many streams as may be.
    Streams,
    /// A run older than those kept of its robot.
    OldEpoch,
    /// Too many holes in the index list.
    Intervals,
}

impl Store {
    pub(crate) fn new(own: Stream, limits: StoreLimits) -> Self {
        let mut streams = BTreeMap::new();
        streams.insert(own, StreamStore::new(Stamp(i64::MIN)));
        Self { own, limits, streams, by_age: BTreeSet::new(), bytes: 0, dropped: 0, cut: BTreeSet::new() }
    }

    /// The own stream is another one from now on; nothing of the former one is kept.
    pub(crate) fn begin_run(&mut self, own: Stream) {
        self.forget(self.own);
        self.own = own;
        self.streams.insert(own, StreamStore::new(Stamp(i64::MIN)));
    }

    /// The streams of which something is known, in ascending order; the own one is always among them.
    pub fn streams(&self) -> impl Iterator<Item = Stream> + '_ {
        self.streams.keys().copied()
    }

    /// Indices held of a stream; `None` for an unknown stream.
    pub fn received(&self, stream: Stream) -> Option<&IntervalSet> {
        self.streams.get(&stream).map(|stream_store| &stream_store.received)
    }

    /// The highest index of a stream that is known to exist, held or not; 0 if none is.
    pub fn newest_known(&self, stream: Stream) -> u32 {
        self.streams.get(&stream).map_or(0, |stream_store| stream_store.newest_known)
    }

    /// Indices of a stream that are known to exist and not held, as ascending closed intervals.
    pub fn missing(&self, stream: Stream) -> impl DoubleEndedIterator<Item = (u32, u32)> + '_ {
        self.streams
            .get(&stream)
            .into_iter()
            .flat_map(|stream_store| stream_store.received.missing(1, stream_store.newest_known))
    }

    /// A stored package.
    pub fn get(&self, stream: Stream, index: u32) -> Option<&Stored> {
        self.streams.get(&stream)?.stored.get(&index)
    }

    /// The stored packages of a stream with an index from `low` to `high`, ascending.
    pub fn range(
        &self,
        stream: Stream,
        low: u32,
        high: u32,
    ) -> impl DoubleEndedIterator<Item = (u32, &Stored)> + '_ {
        self.streams.get(&stream).filter(|_| low <= high).into_iter().flat_map(move |stream_store| {
            stream_store.stored.range(low..=high).map(|(&index, stored)| (index, stored))
        })
    }

    /// A stamp of the stream's robot that no package from `index` on is older than, as late as is known; for
    /// packages that are not stored any more it may be that of an earlier one. `None` if nothing is known of
    /// any up to `index`.
    pub fn stamp_not_after(&self, stream: Stream, index: u32) -> Option<Stamp> {
        let stream_store = self.streams.get(&stream)?;
        let stored = stream_store.stored.range(..=index).next_back();
        stream_store
            .stamp_index
            .not_after(index)
            .max(stored.map(|(_, stored)| stored.package.header().batch_end))
    }

    /// Below every stamp of the packages after `since`. `None` if that is not known: then only the whole
    /// state will do.
    pub fn newer_than(&self, stream: Stream, since: u32) -> Option<Stamp> {
        let next = since.checked_add(1).filter(|_| since > 0)?;
        Some(Stamp(self.stamp_not_after(stream, next)?.0.checked_sub(1)?))
    }

    /// No package that is held is after this one and as old as a stamp, as far as is known. O(1).
    pub(crate) fn index_upto(&self, stream: Stream, stamp: Stamp) -> u32 {
        let Some(stream_store) = self.streams.get(&stream) else { return 0 };
        let first_after = stream_store.stamp_index.first_after(stamp);
        let last = stream_store.received.last().unwrap_or(0);
        first_after.map_or(last, |index| last.min(index.saturating_sub(1)))
    }

    /// Packages with their stamps, ascending, of which some are known for as long as the stream lasts: up to 512. What a
    /// layer holds of packages up to one of them is not newer than its stamp. O(stamps).
    pub fn stamps(&self, stream: Stream) -> impl Iterator<Item = (u32, Stamp)> + '_ {
        self.streams.get(&stream).into_iter().flat_map(|stream_store| stream_store.stamp_index.points())
    }

    /// Of packages that are held, what later ones up to this one changed may be lacking in the layer; 0 for none.
    pub(crate) fn changed_upto(&self, stream: Stream) -> u32 {
        self.streams.get(&stream).map_or(0, |stream_store| stream_store.changed_upto)
    }

    /// Notes that of packages that will be held, what later ones up to this one changed may be lacking.
    pub(crate) fn note_changed(&mut self, stream: Stream, upto: u32) {
        if let Some(stream_store) = self.streams.get_mut(&stream) {
            stream_store.changed_upto = stream_store.changed_upto.max(upto);
        }
    }

    /// Of packages that are not held, some of what those up to this one changed may be in the layer; 0 for none.
    pub(crate) fn said_upto(&self, stream: Stream) -> u32 {
        self.streams.get(&stream).map_or(0, |stream_store| stream_store.said_upto)
    }

    /// Notes that some of what packages up to this one changed is in the layer, held or not.
    pub(crate) fn note_said(&mut self, stream: Stream, upto: u32) {
        if let Some(stream_store) = self.streams.get_mut(&stream) {
            stream_store.said_upto = stream_store.said_upto.max(upto);
        }
    }

    /// Notes that all that is in the layer of packages up to one is not newer than this stamp, or than those of packages
    /// before it.
    pub(crate) fn note_stamp(&mut self, stream: Stream, upto: u32, stamp: Stamp) {
        if let Some(StreamStore { stamp_index, .. }) = self.streams.get_mut(&stream) {
            let before = stamp_index.not_after(upto);
            stamp_index.note(upto, before.map_or(stamp, |before| before.max(stamp)));
        }
    }

    /// The first of these packages that is not stored.
    pub(crate) fn first_unstored(&self, stream: Stream, missing: &IntervalSet) -> Option<u32> {
        missing.intervals().iter().find_map(|&(low, high)| {
            let mut stored = self.range(stream, low, high).map(|(index, _)| index);
            (low..=high).find(|index| stored.next() != Some(*index))
        })
    }

    /// What these packages of a stream up to one would cost as packages.
    pub(crate) fn weigh(&self, stream: Stream, missing: &IntervalSet, upto: u32) -> Missing {
        let missing = missing.within(1, upto);
        let (mut bytes, mut stored) = (0, 0);
        for &(low, high) in missing.intervals() {
            for (_, package) in self.range(stream, low, high) {
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

    /// Bytes of all stored packages, with their bookkeeping.
    pub const fn bytes(&self) -> usize {
        self.bytes
    }

    /// Packages stored now.
    pub fn packages(&self) -> usize {
        self.streams.values().map(|stream_store| stream_store.stored.len()).sum()
    }

    /// Packages dropped so far to stay within the byte limit.
    pub const fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Whether no run of its origin before this one is wanted any more. Only the oldest one that is here says so.
    pub(crate) fn is_oldest_wanted(&self, stream: Stream) -> bool {
        self.cut.contains(&stream.origin) && self.oldest_run(stream.origin) == Some(stream)
    }

    /// Whether there is no place for another stream, unless its robot is heard and takes that of one which is
    /// not.
    pub(crate) fn is_full(&self) -> bool {
        self.is_at_limit() && self.ended_runs(None).next().is_none()
    }

    /// Whether a later run of its robot is known.
    pub(crate) fn is_superseded(&self, stream: Stream) -> bool {
        self.runs(stream.origin).any(|run| run > stream)
    }

    /// When something of a stream was news last.
    pub(crate) fn touched(&self, stream: Stream) -> Option<Stamp> {
        self.streams.get(&stream).map(|stream_store| stream_store.touched)
    }

    /// Whether any run of a robot is here.
    pub(crate) fn has_runs(&self, origin: RobotId) -> bool {
        self.oldest_run(origin).is_some()
    }

    fn is_at_limit(&self) -> bool {
        self.streams.len() > self.limits.streams_max
    }

    /// The runs of a robot that are here, oldest first.
    pub(crate) fn runs(&self, origin: RobotId) -> impl DoubleEndedIterator<Item = Stream> + '_ {
        let run = |epoch| Stream { origin, epoch };
        self.streams.range(run(0)..=run(u64::MAX)).map(|(stream, _)| *stream)
    }

    /// The newest run of a robot that is here.
    pub(crate) fn newest_run(&self, origin: RobotId) -> Option<Stream> {
        self.runs(origin).next_back()
    }

    fn oldest_run(&self, origin: RobotId) -> Option<Stream> {
        self.runs(origin).next()
    }

    /// The oldest run of each robot of which there is a later one, also `newcomer`.
    fn ended_runs(&self, newcomer: Option<Stream>) -> impl Iterator<Item = (Stream, &StreamStore)> {
        let mut before = None;
        self.streams.iter().filter(|(run, _)| **run != self.own).filter_map(move |(&run, stream_store)| {
            let is_oldest = before.replace(run.origin) != Some(run.origin);
            let is_ended =
                self.is_superseded(run) || newcomer.is_some_and(|new| new.origin == run.origin && new > run);
            (is_oldest && is_ended).then_some((run, stream_store))
        })
    }

    /// Makes a place for a stream. `is_heard`: robots of which there is a sign of life; their newest runs are
    /// never forgotten.
    pub(crate) fn open(
        &mut self,
        stream: Stream,
        now: Stamp,
        is_heard: impl Fn(RobotId) -> bool,
    ) -> Result<Opened, NoRoom> {
        if self.streams.contains_key(&stream) {
            return Ok(Opened { is_new: false, forgotten: None });
        }
        let origin = stream.origin;
        let oldest = self.oldest_run(origin);
        let is_before = oldest.is_some_and(|oldest| stream < oldest);
        if is_before && self.cut.contains(&origin) {
            return Err(NoRoom::OldEpoch);
        }
        let others = || self.runs(origin).filter(|run| *run != self.own);
        let forgotten = if others().count() >= self.limits.epochs_max {
            let oldest = others().next();
            self.cut.insert(origin);
            if is_before {
                return Err(NoRoom::OldEpoch);
            }
            oldest
        } else if !self.is_at_limit() {
            None
        } else if mutation::is(Mutation::LiveBackedOff) {
            return Err(NoRoom::Streams);
        } else if self.is_superseded(stream) {
            // All places are taken: what has ended takes one from an older run of the same robot, and from no
            // other.
            let older = others().next().filter(|older| *older < stream);
            self.cut.insert(origin);
            Some(older.ok_or(NoRoom::OldEpoch)?)
        } else {
            let ended = self.ended_runs(Some(stream));
            let silent =
                self.streams.iter().map(|(run, stream_store)| (*run, stream_store)).filter(|(run, _)| {
                    *run != self.own && is_heard(origin) && !is_heard(run.origin) && !self.is_superseded(*run)
                });
            let age = |(_, stream_store): &(Stream, &StreamStore)| stream_store.touched;
            let (run, _) = ended.min_by_key(age).or_else(|| silent.min_by_key(age)).ok_or(NoRoom::Streams)?;
            self.cut.insert(run.origin);
            Some(run)
        };
        if let Some(forgotten) = forgotten {
            self.forget(forgotten);
        }
        self.streams.insert(stream, StreamStore::new(now));
        if let Some(forgotten) = forgotten
            && self.oldest_run(forgotten.origin).is_none()
        {
            self.cut.remove(&forgotten.origin);
        }
        Ok(Opened { is_new: true, forgotten })
    }

    fn forget(&mut self, stream: Stream) {
        if let Some(stream_store) = self.streams.remove(&stream) {
            self.bytes -= stream_store.bytes;
            self.dropped += stream_store.stored.len() as u64;
            for (index, stored) in stream_store.stored {
                self.by_age.remove(&(stored.fresh_at, stream, index));
            }
        }
    }

    /// Notes that packages up to `index` exist; whether that is news.
    pub(crate) fn note_newest(&mut self, stream: Stream, index: u32, now: Stamp) -> bool {
        let Some(stream_store) = self.streams.get_mut(&stream) else { return false };
        let news = index > stream_store.newest_known;
        if news {
            stream_store.newest_known = index;
            stream_store.touched = now;
        }
        news
    }

    /// Marks indices of a stream that has a place as held without a package to send on; whether any was new.
    pub(crate) fn hold(&mut self, stream: Stream, low: u32, high: u32, now: Stamp) -> Result<bool, NoRoom> {
        let Some(stream_store) = self.streams.get_mut(&stream) else { return Err(NoRoom::Streams) };
        let is_new = stream_store.received.insert_range(low, high).map_err(|_| NoRoom::Intervals)?;
        stream_store.newest_known = stream_store.newest_known.max(high);
        if is_new {
            stream_store.touched = now;
        }
        Ok(is_new)
    }

    /// Puts a package of a stream that has a place away and drops the oldest ones if there are too many
    /// bytes; whether it was new.
    pub(crate) fn insert(&mut self, package: &Package, now: Stamp, fresh_at: Stamp) -> Result<bool, NoRoom> {
        let (stream, index) = (package.header().stream, package.header().index);
        let is_new = self.hold(stream, index, index, now)?;
        let Some(stream_store) = self.streams.get_mut(&stream) else { return Err(NoRoom::Streams) };
        if !is_new {
            return Ok(false);
        }
        stream_store.stamp_index.note(index, package.header().batch_end);
        let fresh_at = fresh_at.min(now);
        let bytes = package.bytes().len() + PACKAGE_OVERHEAD_BYTES;
        stream_store.stored.insert(index, Stored { package: package.clone(), stored_at: now, fresh_at });
        stream_store.bytes += bytes;
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
                .streams
                .get(&self.own)
                .and_then(|stream_store| stream_store.stored.first_key_value())
                .map(|(&index, _)| (self.own, index)),
        };
        let Some((stream, index)) = oldest else { return false };
        if let Some(stream_store) = self.streams.get_mut(&stream)
            && let Some(stored) = stream_store.stored.remove(&index)
        {
            let bytes = stored.package.bytes().len() + PACKAGE_OVERHEAD_BYTES;
            stream_store.bytes -= bytes;
            self.bytes -= bytes;
            self.dropped += 1;
        }
        true
    }
}

impl StreamStore {
    const fn new(now: Stamp) -> Self {
        Self {
            received: IntervalSet::new(RECEIVED_INTERVALS_MAX),
            newest_known: 0,
            stored: BTreeMap::new(),
            stamp_index: StampIndex::new(),
            bytes: 0,
            touched: now,
            changed_upto: 0,
            said_upto: 0,
        }
    }
}
