//! Places of voxels as one number.

use crate::{BlockIndex, Voxel};

/// The part of the map that the rays of a scan can reach: block 0 0 0 of the table, and bits per axis.
#[derive(Clone, Copy, Default, Debug)]
pub(super) struct Window {
    corner: BlockIndex,
    /// Which bits of a place belong to x, y, z.
    pub(super) masks: [u32; 3],
    bits: [u32; 3],
}

impl Window {
    /// The smallest window that holds the blocks from `low` to `high`.
    pub(super) fn new(low: BlockIndex, high: BlockIndex) -> Self {
        let bits_for = |low: i32, high: i32| 32 - ((high - low) as u32).leading_zeros();
        let bits = [bits_for(low.x, high.x), bits_for(low.y, high.y), bits_for(low.z, high.z)];
        let mut masks = [0b111, 0b111 << 3, 0b111 << 6];
        let mut shift = 9;
        for (mask, bits) in masks.iter_mut().zip(bits) {
            *mask |= ((1u32 << bits) - 1) << shift;
            shift += bits;
        }
        Self { corner: low, masks, bits }
    }

    pub(super) fn blocks(&self) -> usize {
        1 << (self.bits[0] + self.bits[1] + self.bits[2])
    }

    pub(super) fn place(&self, voxel: Voxel) -> [u32; 3] {
        let c = self.corner.corner();
        let (x, y, z) = ((voxel.x - c.x) as u32, (voxel.y - c.y) as u32, (voxel.z - c.z) as u32);
        let [bx, by, _] = self.bits;
        [
            (x & 7) | (x >> 3) << 9,
            (y & 7) << 3 | (y >> 3) << (9 + bx),
            (z & 7) << 6 | (z >> 3) << (9 + bx + by),
        ]
    }

    pub(super) fn block(&self, index: u32) -> BlockIndex {
        let [bx, by, bz] = self.bits;
        let field = |shift: u32, bits: u32| ((index >> shift) & ((1 << bits) - 1)) as i32;
        BlockIndex::new(
            self.corner.x + field(0, bx),
            self.corner.y + field(bx, by),
            self.corner.z + field(bx + by, bz),
        )
    }
}
