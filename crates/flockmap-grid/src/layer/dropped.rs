//! What of a layer was dropped for want of room.

use rustc_hash::FxHashMap;

use super::cube::cube_of;
use super::{Layer, Place};
use crate::memory::table_bytes;
use crate::{BlockIndex, Plane, Stamp};

/// Cubes of which it is remembered one by one that they were dropped. Of more those that were dropped with the oldest
/// stamps are one: then a place where nothing is known may be one that was dropped.
const CUBES_MAX: usize = if cfg!(test) { 8 } else { 1 << 16 };
const CUBE_BYTES: usize = size_of::<(BlockIndex, Stamp)>();

/// Up to which stamp something is lacking, and where.
///
/// Of a voxel that is unknown where something was dropped, nothing newer than the limit of its cube was ever dropped.
/// What comes late, at most as new, may be older than that: it is ignored. So a voxel that is known has the newest
/// state of all packages received, also here.
#[derive(Clone, Debug, Default)]
pub(super) struct Dropped {
    /// The limit of each cube of which that is remembered, also of those that are there again.
    pub(super) cubes: FxHashMap<BlockIndex, Stamp>,
    /// The limit of all cubes that are not there, at least.
    floor: Option<Stamp>,
    newest: Option<Stamp>,
    /// How often something was noted since it was looked last whether there are too many cubes.
    noted: usize,
}

impl Dropped {
    /// The limit of a cube that is there, or not.
    fn limit(&self, at: BlockIndex, is_there: bool) -> Option<Stamp> {
        let floor = self.floor.filter(|_| !is_there);
        self.cubes.get(&at).copied().max(floor)
    }

    /// Something with this stamp is gone from a cube.
    fn note(&mut self, at: BlockIndex, newest: Stamp) {
        let limit = self.cubes.entry(at).or_insert(newest);
        *limit = newest.max(*limit);
        self.newest = self.newest.max(Some(newest));
        self.noted += 1;
    }

    /// A cube is there now: what held of all that are not there holds of it for ever.
    pub(super) fn note_there(&mut self, at: BlockIndex) {
        if let Some(limit) = self.limit(at, false) {
            self.cubes.insert(at, limit);
        }
    }

    /// Makes one of the older half of the cubes that are not there, if there are too many. Now and then O(cubes).
    fn thin(&mut self, is_there: impl Fn(&BlockIndex) -> bool) {
        if self.noted < CUBES_MAX / 4 || self.cubes.len() <= CUBES_MAX {
            return;
        }
        self.noted = 0;
        let mut gone: Vec<Stamp> =
            self.cubes.iter().filter(|(at, _)| !is_there(at)).map(|(_, limit)| *limit).collect();
        if gone.len() <= CUBES_MAX {
            return;
        }
        let half = gone.len() / 2;
        let floor = Some(*gone.select_nth_unstable(half).1).max(self.floor);
        self.cubes.retain(|at, limit| is_there(at) || Some(*limit) > floor);
        self.floor = floor;
    }

    pub(super) fn memory_bytes(&self) -> usize {
        // It may have held more, and then it is not made smaller.
        table_bytes(self.cubes.capacity(), CUBE_BYTES)
    }
}

impl Layer {
    /// Of what packages said that were taken over, some is lacking, since there was no room for it: nothing newer than
    /// this. `None`: nothing is lacking.
    pub const fn lost_upto(&self) -> Option<Stamp> {
        self.dropped.newest
    }

    /// Whether so much was dropped that of no place where nothing is known it can be said that nothing was: next to
    /// no package can be decoded that is coded against the layer of its origin.
    pub const fn lacks_anywhere(&self) -> bool {
        self.dropped.floor.is_some()
    }

    /// Up to which stamp something may be lacking in a cube.
    pub(super) fn limit_of(&self, at: BlockIndex) -> Option<Stamp> {
        self.dropped.newest?;
        self.dropped.limit(at, self.cubes.contains_key(&at))
    }

    /// Drops a cube for want of room. Returns its blocks with what of them was known. O(its blocks), and unpacks it.
    pub(crate) fn drop_cube(&mut self, at: BlockIndex) -> Vec<(BlockIndex, Plane)> {
        let known = self.known_in_cube(at);
        let newest = self.cubes.get(&at).and_then(Place::newest);
        self.voxels -=
            known.iter().flat_map(|(_, plane)| plane).map(|word| word.count_ones() as usize).sum::<usize>();
        self.take_out(at);
        if let Some(newest) = newest {
            self.note_dropped(at, newest);
        }
        known
    }

    /// Something of a cube with this stamp that comes is not taken over, for want of room: then nothing of it stays
    /// that would be older. Returns what was known, as [`Self::drop_cube`] does.
    pub(crate) fn refuse(&mut self, at: BlockIndex, stamp: Stamp) -> Vec<(BlockIndex, Plane)> {
        let known = self.drop_cube(at);
        self.note_dropped(at, stamp);
        known
    }

    /// Who made the snapshot that comes had dropped something, nothing newer than this: so of what was known before
    /// only what is newer is certain to be the newest once the snapshot is there. The rest is taken out. Returns what
    /// was known before. O(voxels).
    pub(crate) fn begin_part(&mut self, lost_upto: Stamp) -> Vec<(BlockIndex, Plane)> {
        let known: Vec<_> = self.blocks().map(|(index, states)| (index, states.known())).collect();
        let newer = self.snapshot_since(lost_upto);
        let mut dropped = core::mem::take(&mut self.dropped);
        dropped.floor = dropped.floor.max(Some(lost_upto));
        dropped.newest = dropped.newest.max(Some(lost_upto));
        *self = Self { dropped, newest: self.newest, ignored: self.ignored, ..Self::new(&self.unpacked) };
        if let Some(newer) = newer {
            self.apply_rest(&newer);
        }
        known
    }

    /// All that is lacking has come: by a whole snapshot of as many packages or more.
    pub(crate) fn end_lack(&mut self) {
        self.dropped = Dropped::default();
    }

    fn note_dropped(&mut self, at: BlockIndex, newest: Stamp) {
        let Self { dropped, cubes, .. } = self;
        dropped.note(at, newest);
        dropped.thin(|at| cubes.contains_key(at));
    }

    /// Takes a cube, whose voxels are not counted any more, out of the table.
    fn take_out(&mut self, at: BlockIndex) {
        match self.cubes.remove(&at) {
            None => {}
            Some(Place::Open(open)) => {
                self.open_bytes -= super::OPEN_BYTES + open.cube.memory_bytes();
                self.open -= open.cube.len();
                self.blocks -= open.cube.len();
                self.queue.retain(|(_, queued)| *queued != at);
            }
            Some(Place::Packed(packed)) => {
                self.packed_bytes -= packed.memory_bytes();
                self.blocks -= packed.len();
            }
        }
    }

    /// Of each cube: its index and its newest stamp. O(open blocks, packed cubes).
    pub(crate) fn cubes_with_newest(&self) -> impl Iterator<Item = (BlockIndex, Stamp)> {
        self.cubes.iter().filter_map(|(at, place)| Some((*at, place.newest()?)))
    }

    /// The newest stamp of a cube.
    pub(crate) fn newest_in(&self, at: BlockIndex) -> Option<Stamp> {
        self.cubes.get(&at).and_then(Place::newest)
    }
}

/// The cube that a block lies in.
pub(crate) const fn cube_at(index: BlockIndex) -> BlockIndex {
    cube_of(index)
}
