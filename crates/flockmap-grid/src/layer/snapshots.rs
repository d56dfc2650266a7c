//! Snapshots of a layer.

use rustc_hash::FxHashMap;

use super::Layer;
use crate::block::set_bits;
use crate::changes::bounding_box;
use crate::snapshot::SnapshotVoxels;
use crate::{BlockIndex, Snapshot, Stamp, StateBlock, VoxelBox};

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

    /// The same in 8 bytes for each voxel: of the whole layer, or what is newer than a stamp. Takes no more
    /// while it works, beside 16 bytes for each block and each stamp. `None` if that is nothing, or more than
    /// 2²⁷ blocks or stamps. O(n log n) in voxels.
    pub fn snapshot_voxels(&self, newer_than: Option<Stamp>) -> Option<SnapshotVoxels> {
        let is_wanted = |stamp: Stamp| newer_than.is_none_or(|limit| stamp > limit);
        let wanted = || {
            let cubes = self.cubes.iter().filter(|(_, place)| place.newest().is_some_and(is_wanted));
            cubes.map(|(at, place)| (*at, place.read()))
        };
        let mut blocks: Vec<BlockIndex> =
            Vec::with_capacity(if newer_than.is_none() { self.blocks } else { 0 });
        let mut number_of = FxHashMap::<Stamp, u32>::default();
        let (mut region, mut count, mut last) = (None::<VoxelBox>, 0, None);
        for (at, cube) in wanted() {
            for (index, block) in cube.blocks(at).filter(|(_, block)| is_wanted(block.stamps.newest())) {
                let mut known = [0; 8];
                for bit in set_bits(&block.states.known()) {
                    let stamp = block.stamps.get(bit);
                    if !is_wanted(stamp) {
                        continue;
                    }
                    if last != Some(stamp) {
                        number_of.insert(stamp, 0);
                        last = Some(stamp);
                    }
                    known[bit / 64] |= 1 << (bit % 64);
                    count += 1;
                }
                let part = bounding_box(core::iter::once((index, &StateBlock::new(known, [0; 8]))));
                region = match (region, part) {
                    (Some(a), Some(b)) => Some(a.union(&b)),
                    (a, b) => a.or(b),
                };
                blocks.push(index);
            }
        }
        blocks.sort_unstable();
        let mut stamps: Vec<Stamp> = number_of.keys().copied().collect();
        stamps.sort_unstable();
        for (number, stamp) in (0..).zip(&stamps) {
            number_of.insert(*stamp, number);
        }
        let sensors = stamps.iter().filter_map(|stamp| Some((*stamp, *self.sensors.get(stamp)?))).collect();
        let region = region?;
        let places_of = blocks.clone();
        let voxels = wanted().flat_map(|(at, cube)| {
            let mut of_cube = Vec::new();
            let mut last = (Stamp(0), None);
            for (index, block) in cube.blocks(at) {
                let Ok(number) = places_of.binary_search(&index) else { continue };
                for bit in set_bits(&block.states.known()) {
                    let stamp = block.stamps.get(bit);
                    if !is_wanted(stamp) {
                        continue;
                    }
                    let of_stamp = match last {
                        (same, Some(of_stamp)) if same == stamp => of_stamp,
                        _ => number_of.get(&stamp).copied().unwrap_or(0),
                    };
                    last = (stamp, Some(of_stamp));
                    of_cube.push((of_stamp, number as u32, bit, block.states.get(bit)));
                }
            }
            of_cube
        });
        SnapshotVoxels::new(region, stamps, blocks, count, voxels, sensors)
    }
}
