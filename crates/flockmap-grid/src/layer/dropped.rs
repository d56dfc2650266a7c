//! What of a layer was dropped for want of room.

use rustc_hash::FxHashMap;

use crate::memory::table_bytes;
use crate::{BlockIndex, Stamp};

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
    pub(super) floor: Option<Stamp>,
    pub(super) newest: Option<Stamp>,
    /// How often something was noted since it was looked last whether there are too many cubes.
    noted: usize,
}

impl Dropped {
    /// The limit of a cube that is there, or not.
    pub(super) fn limit(&self, at: BlockIndex, is_there: bool) -> Option<Stamp> {
        let floor = self.floor.filter(|_| !is_there);
        self.cubes.get(&at).copied().max(floor)
    }

    /// Something with this stamp is gone from a cube.
    pub(super) fn note(&mut self, at: BlockIndex, newest: Stamp) {
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
    pub(super) fn thin(&mut self, is_there: impl Fn(&BlockIndex) -> bool) {
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
