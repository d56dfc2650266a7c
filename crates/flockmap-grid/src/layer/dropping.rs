//! A layer that drops cubes for want of room.

use super::cube::first_of;
use super::dropped::Dropped;
use super::{Layer, Place};
use crate::{BlockIndex, Plane, Sheet, Stamp};

/// Whether a cube is never dropped for others: what a stream says of its submaps, on which the place of all else depends.
/// It is little. Where there is no room for it either, it is refused.
pub(crate) const fn is_kept(at: BlockIndex) -> bool {
    Sheet::of(first_of(at)).is_none()
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
        self.left_in_copies += self.cubes.values().map(Place::bytes_in_copies).sum::<u64>();
        let mut dropped = core::mem::take(&mut self.dropped);
        dropped.floor = dropped.floor.max(Some(lost_upto));
        dropped.newest = dropped.newest.max(Some(lost_upto));
        let Self { newest, ignored, left_in_copies, .. } = *self;
        *self = Self { dropped, newest, ignored, left_in_copies, ..Self::new(&self.unpacked) };
        if let Some(state) = newer {
            self.apply_rest(&state);
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
        let place = self.cubes.remove(&at);
        if let Some(Place::Packed(packed)) = &place {
            self.unpacked.forget(packed);
        }
        self.left_in_copies += place.as_ref().map_or(0, Place::bytes_in_copies);
        match place {
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
