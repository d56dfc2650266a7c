//! Snapshots of a layer.

use core::cmp::Ordering;
use std::collections::{BTreeMap, BinaryHeap};

use super::sensors::SENSOR_BYTES;
use super::{Layer, Place};
use crate::block::set_bits;
use crate::snapshot::SnapshotVoxels;
use crate::{BlockIndex, Plane, Snapshot, Stamp, StateBlock};

impl Layer {
    /// The whole layer with its stamps, such that applying its parts to an empty layer gives this one. `None`
    /// if nothing is known. O(voxels). Takes 144 bytes for each block of each stamp; see
    /// [`Self::snapshot_voxels`].
    pub fn snapshot(&self) -> Option<Snapshot> {
        self.snapshot_voxels(None).map(|voxels| voxels.to_state())
    }

    /// The voxels with a stamp newer than this one, such that applying its parts to a layer that knows all up
    /// to `stamp` gives this one. `None` if there are none. O(voxels).
    pub fn snapshot_since(&self, stamp: Stamp) -> Option<Snapshot> {
        self.snapshot_voxels(Some(stamp)).map(|voxels| voxels.to_state())
    }

    /// The same in 2 bytes for each voxel, see [`SnapshotVoxels`]: of the whole layer, or what is newer than a
    /// stamp. `None` if that is nothing, or more than 2³² blocks. O(voxels).
    pub fn snapshot_voxels(&self, newer_than: Option<Stamp>) -> Option<SnapshotVoxels> {
        self.read_snapshot(newer_than).finish()
    }

    /// The same, to be read in pieces: the layer as it is now, whatever becomes of it meanwhile. O(cubes +
    /// sensors), and 32 bytes for each cube.
    pub fn read_snapshot(&self, newer_than: Option<Stamp>) -> SnapshotReader {
        self.read_cubes(newer_than, |_, place| {
            newer_than.is_none_or(|limit| place.newest().is_some_and(|at| at > limit))
        })
    }

    /// The same of some cubes.
    pub(super) fn read_cubes(
        &self,
        newer_than: Option<Stamp>,
        is_wanted: impl Fn(BlockIndex, &Place) -> bool,
    ) -> SnapshotReader {
        let cubes = self.cubes.iter().filter(|(at, place)| is_wanted(**at, place));
        let unread =
            cubes.map(|(at, place)| Unread { oldest: place.oldest(), at: *at, place: place.clone() });
        SnapshotReader {
            newer_than,
            upto: None,
            unread: unread.collect::<Vec<_>>().into(),
            done: Vec::new(),
            sensors: self.sensors.by_stamp().clone(),
            groups: Vec::new(),
            voxels: SnapshotVoxels::default(),
        }
    }
}

/// The state of a layer as it was when this was made, which is read in pieces while the layer goes on. It shares the
/// cubes of the layer; those that the layer changes or forgets meanwhile stay as long as it does. Beside that it takes what
/// [`SnapshotVoxels`] take.
#[derive(Debug, Default)]
pub struct SnapshotReader {
    newer_than: Option<Stamp>,
    /// Of what is newer nothing is read any more.
    upto: Option<Stamp>,
    /// Still to be read, those with the oldest stamps first.
    unread: BinaryHeap<Unread>,
    /// Kept in case that all is read again.
    done: Vec<Unread>,
    sensors: BTreeMap<Stamp, [i32; 3]>,
    /// Kept from block to block: what it says of each stamp, Free and Occupied.
    groups: Vec<(Stamp, [Plane; 2])>,
    voxels: SnapshotVoxels,
}

/// A cube to be read.
#[derive(Debug)]
struct Unread {
    /// No voxel of it is older.
    oldest: Stamp,
    at: BlockIndex,
    place: Place,
}

impl Ord for Unread {
    /// The one that is read first is the greatest.
    fn cmp(&self, other: &Self) -> Ordering {
        (other.oldest, other.at).cmp(&(self.oldest, self.at))
    }
}

impl PartialOrd for Unread {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Unread {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Unread {}

impl SnapshotReader {
    /// Reads whole cubes, of at most 64 blocks, until it has read `blocks_max` blocks or all. Returns the number of
    /// blocks read; 0 if there are no more. Some 20 µs for each.
    pub fn step(&mut self, blocks_max: usize) -> usize {
        let mut read = 0;
        while read < blocks_max
            && self.unread.peek().is_some_and(|next| self.upto.is_none_or(|upto| next.oldest <= upto))
            && let Some(next) = self.unread.pop()
        {
            let (at, cube) = (next.at, next.place.read());
            for (index, block) in cube.blocks(at) {
                self.groups.clear();
                let (mut last, mut of_last) = (None, 0);
                for bit in set_bits(&block.states.known()) {
                    let stamp = block.stamps.get(bit);
                    if self.newer_than.is_some_and(|limit| stamp <= limit)
                        || self.upto.is_some_and(|upto| stamp > upto)
                    {
                        continue;
                    }
                    if last != Some(stamp) {
                        last = Some(stamp);
                        of_last = self.groups.iter().rposition(|(of, _)| *of == stamp).unwrap_or_else(|| {
                            self.groups.push((stamp, [[0; 8]; 2]));
                            self.groups.len() - 1
                        });
                    }
                    let is_occupied = block.states.occupied()[bit / 64] >> (bit % 64) & 1 == 1;
                    self.groups[of_last].1[usize::from(is_occupied)][bit / 64] |= 1 << (bit % 64);
                }
                let groups = self.groups.iter();
                self.voxels.add_block(
                    index,
                    groups.map(|(stamp, [free, occupied])| (*stamp, StateBlock::new(*free, *occupied))),
                );
            }
            read += cube.len();
            drop(cube);
            self.done.push(next);
        }
        read
    }

    /// Lets go of what is newest until what is left is small enough, and reads nothing as new any more; but what has the
    /// oldest stamp stays. So the state becomes what of it is not newer than [`Self::upto`].
    pub fn keep_oldest(&mut self, is_small: impl Fn(&SnapshotVoxels) -> bool) {
        while !is_small(&self.voxels) && self.voxels.has_newer() {
            let newest = self.voxels.drop_newest();
            self.upto = newest.map(|stamp| stamp.plus_micros(-1));
        }
    }

    /// Lets go of what is newer than a stamp.
    pub fn keep_upto(&mut self, upto: Stamp) {
        while self.voxels.newest().is_some_and(|newest| newest > upto) {
            self.voxels.drop_newest();
        }
        self.upto = Some(self.upto.map_or(upto, |before| before.min(upto)));
    }

    /// `None`: all of the state is read, or will be. Else what is not newer.
    pub const fn upto(&self) -> Option<Stamp> {
        self.upto
    }

    /// Cubes that are still to be read, in which there may be something.
    pub fn cubes(&self) -> usize {
        self.unread.len()
    }

    /// What was read so far, but for sensors.
    pub const fn read(&self) -> &SnapshotVoxels {
        &self.voxels
    }

    /// All that was read, after the rest is read too. `None` if that is nothing, or more than 2³² blocks.
    pub fn finish(mut self) -> Option<SnapshotVoxels> {
        self.take()
    }

    /// The same; then it can be read [once more](Self::restart).
    pub fn take(&mut self) -> Option<SnapshotVoxels> {
        while self.step(usize::MAX) > 0 {}
        let mut voxels = core::mem::take(&mut self.voxels);
        voxels.set_sensors(&self.sensors);
        voxels.complete()
    }

    /// Reads the same state once more: all of it, or what is newer than a stamp. O(cubes).
    pub fn restart(&mut self, newer_than: Option<Stamp>) {
        self.done.append(&mut core::mem::take(&mut self.unread).into_vec());
        let is_wanted =
            |cube: &Unread| newer_than.is_none_or(|limit| cube.place.newest().is_some_and(|at| at > limit));
        let (unread, done): (Vec<_>, Vec<_>) =
            core::mem::take(&mut self.done).into_iter().partition(is_wanted);
        (self.unread, self.done) = (unread.into(), done);
        (self.voxels, self.upto, self.newer_than) = (SnapshotVoxels::default(), None, newer_than);
    }

    /// Bytes that it takes beside what was read and what it shares with the layer. O(1).
    pub fn memory_bytes(&self) -> usize {
        (self.unread.capacity() + self.done.capacity()) * size_of::<Unread>()
            + self.sensors.len() * SENSOR_BYTES
    }
}
