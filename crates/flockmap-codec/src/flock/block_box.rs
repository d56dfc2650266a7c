//! Boxes of whole blocks.

use flockmap_grid::{BLOCK_SIDE, BlockIndex, VOXEL_LIMIT, Voxel, VoxelBox};

use crate::limits::BOX_VOXELS_MAX;

/// Sixteenths of a voxel along a side of a block.
pub(crate) const BLOCK_UNITS: i64 = 128;

/// Most blocks in the box of a package.
pub(crate) const BOX_BLOCKS_MAX: u128 = (BOX_VOXELS_MAX / 512) as u128;

/// A box of blocks: the lowest and the highest.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct BlockBox {
    pub(crate) min: [i32; 3],
    pub(crate) max: [i32; 3],
}

impl BlockBox {
    pub(crate) fn of(block: BlockIndex) -> Self {
        let at = [block.x, block.y, block.z];
        Self { min: at, max: at }
    }

    /// The smallest box that holds both.
    pub(crate) fn union(self, other: Self) -> Self {
        Self {
            min: core::array::from_fn(|a| self.min[a].min(other.min[a])),
            max: core::array::from_fn(|a| self.max[a].max(other.max[a])),
        }
    }

    /// The blocks that a box touches.
    pub(crate) fn around(region: &VoxelBox) -> Self {
        Self::of(region.min().block()).union(Self::of(region.max().block()))
    }

    /// The blocks that a box is made of, `None` if it cuts one.
    pub(crate) fn of_voxels(region: &VoxelBox) -> Option<Self> {
        let of = Self::around(region);
        (of.voxels()? == *region).then_some(of)
    }

    /// The same box in voxels, `None` beyond the limits of the grid.
    pub(crate) fn voxels(self) -> Option<VoxelBox> {
        let corner = |at: [i32; 3]| BlockIndex::new(at[0], at[1], at[2]).corner();
        // At its end the grid cuts a block.
        let max = corner(self.max);
        let last = [max.x, max.y, max.z].map(|at| at.saturating_add(BLOCK_SIDE - 1).min(VOXEL_LIMIT));
        VoxelBox::spanning(corner(self.min), Voxel::new(last[0], last[1], last[2]))
    }

    /// Its middle, in sixteenths of a voxel.
    pub(crate) fn middle(self) -> [i64; 3] {
        core::array::from_fn(|a| (i64::from(self.min[a]) + i64::from(self.max[a]) + 1) * BLOCK_UNITS / 2)
    }

    pub(crate) fn size(self) -> [u64; 3] {
        core::array::from_fn(|a| (i64::from(self.max[a]) - i64::from(self.min[a]) + 1) as u64)
    }

    pub(crate) fn volume(self) -> u128 {
        self.size().iter().map(|side| u128::from(*side)).product()
    }
}

/// Places in a list for the blocks of a box and for those round it.
#[derive(Clone, Copy, Default, Debug)]
pub(crate) struct Places {
    /// The lowest block that has a place.
    min: [i32; 3],
    /// From one place to the next along each axis.
    pub(crate) steps: [usize; 3],
    /// How many there are.
    pub(crate) count: usize,
}

impl Places {
    /// `region` has at most [`BOX_BLOCKS_MAX`] blocks.
    pub(crate) fn round(region: BlockBox) -> Self {
        let [x, y, z] = region.size().map(|side| side as usize + 2);
        Self { min: region.min.map(|min| min.saturating_sub(1)), steps: [1, x, x * y], count: x * y * z }
    }

    /// Where a block has its place, if it has one.
    pub(crate) fn of(&self, block: BlockIndex) -> usize {
        let at = [block.x, block.y, block.z];
        (0..3).map(|a| at[a].wrapping_sub(self.min[a]) as u32 as usize * self.steps[a]).sum()
    }
}
