//! The blocks of the fused map in a cube of 8 × 8 × 8 blocks: what is copied when a map is written to while a
//! view of it is alive.

use crate::block::bits;
use crate::{BlockIndex, Plane, StateBlock, Voxel, plane_within, set_bits, voxel_bit};

/// Blocks in ascending order of their places, each 136 bytes, and which places they are of: a block is found
/// by counting those before it. A layer of them lies together in memory, as slices of a map are read. To put a
/// new one in moves those behind it: on average some 10 kB in a region of 512.
#[derive(Clone, Debug, Default)]
pub(super) struct Region {
    /// A bit for each place at which there is a block. Places are counted as the voxels of a block are.
    places: Plane,
    /// Blocks in the layers below each.
    below: [u16; 8],
    blocks: Vec<ViewBlock>,
    /// Of the block that changed last.
    version: u64,
}

/// The states of a block, and the version of the map with which they came.
#[derive(Clone, Debug)]
pub(super) struct ViewBlock {
    pub states: StateBlock,
    pub version: u64,
}

/// The most that a block takes which is alone in its region, beside the table of regions.
pub(super) const BLOCK_BYTES_MAX: usize = size_of::<ViewBlock>() * 9 / 8 + REGION_BYTES;
/// A region on the heap, beside its blocks.
const REGION_BYTES: usize = 2 * size_of::<usize>() + size_of::<Region>();

/// The region of a block.
pub(super) fn region_of(index: BlockIndex) -> BlockIndex {
    as_voxel(index).block()
}

impl Region {
    /// Of the block that changed last.
    pub(super) const fn version(&self) -> u64 {
        self.version
    }

    /// Bytes on the heap: at most [`BLOCK_BYTES_MAX`] for each block, so none if there is none.
    pub(super) fn memory_bytes(&self) -> usize {
        if self.is_empty() { 0 } else { REGION_BYTES + self.blocks.capacity() * size_of::<ViewBlock>() }
    }

    /// The states of the block at this index, of which the region is that of [`region_of`].
    pub(super) fn block(&self, index: BlockIndex) -> Option<&StateBlock> {
        self.rank(index).ok().map(|rank| &self.blocks[rank].states)
    }

    /// The version at which a block changed last.
    pub(super) fn changed_at(&self, index: BlockIndex) -> Option<u64> {
        self.rank(index).ok().map(|rank| self.blocks[rank].version)
    }

    /// All blocks in ascending order of their places. `at` is the region's own index.
    pub(super) fn blocks(&self, at: BlockIndex) -> impl Iterator<Item = (BlockIndex, &ViewBlock)> {
        set_bits(&self.places).map(move |place| index_of(at, place)).zip(&self.blocks)
    }

    /// The blocks from `low` to `high` in the same order.
    pub(super) fn blocks_between(
        &self,
        at: BlockIndex,
        low: BlockIndex,
        high: BlockIndex,
    ) -> impl Iterator<Item = (BlockIndex, &StateBlock)> {
        let [low, high] = [as_voxel(low).highest(at.voxel(0)), as_voxel(high).lowest(at.voxel(511))];
        let within = plane_within(at, low, high);
        (0..8).filter(move |z| within[*z] != 0).flat_map(move |z| {
            let blocks = &self.blocks[usize::from(self.below[z])..];
            let inside = move |(place, _): &(usize, _)| within[z] >> place & 1 == 1;
            let found = bits(self.places[z]).zip(blocks).filter(inside);
            found.map(move |(place, block)| (index_of(at, z * 64 + place), &block.states))
        })
    }

    /// Sets the states of a block; returns those that it had if it was there.
    pub(super) fn set(&mut self, index: BlockIndex, states: StateBlock, version: u64) -> Option<StateBlock> {
        self.version = version;
        let block = ViewBlock { states, version };
        match self.rank(index) {
            Ok(rank) => Some(core::mem::replace(&mut self.blocks[rank], block).states),
            Err(rank) => {
                if self.blocks.len() == self.blocks.capacity() {
                    self.blocks.reserve_exact(self.blocks.len() / 8 + 1);
                }
                self.blocks.insert(rank, block);
                let place = voxel_bit(as_voxel(index));
                self.places[place / 64] |= 1 << (place % 64);
                self.below[place / 64 + 1..].iter_mut().for_each(|below| *below += 1);
                None
            }
        }
    }

    /// Lets go of the blocks of which nothing is known.
    pub(super) fn forget_emptied(&mut self) {
        let mut blocks = self.blocks.iter();
        let mut kept = Plane::default();
        for place in set_bits(&self.places) {
            if blocks.next().is_some_and(|block| !block.states.is_empty()) {
                kept[place / 64] |= 1 << (place % 64);
            }
        }
        self.blocks.retain(|block| !block.states.is_empty());
        self.blocks.shrink_to_fit();
        self.places = kept;
        let mut below = 0;
        for (layer, places) in self.below.iter_mut().zip(&self.places) {
            *layer = below;
            below += places.count_ones() as u16;
        }
    }

    /// Whether there is a block of which nothing is known.
    pub(super) fn has_emptied(&self) -> bool {
        self.blocks.iter().any(|block| block.states.is_empty())
    }

    /// Whether there is no block.
    pub(super) const fn is_empty(&self) -> bool {
        self.blocks.is_empty()
    }

    /// Where a block is among the blocks, or where it would be.
    fn rank(&self, index: BlockIndex) -> Result<usize, usize> {
        let place = voxel_bit(as_voxel(index));
        let (places, bit) = (self.places[place / 64], 1 << (place % 64));
        let rank = usize::from(self.below[place / 64]) + (places & (bit - 1)).count_ones() as usize;
        if places & bit == 0 { Err(rank) } else { Ok(rank) }
    }
}

/// A region is of blocks what a block is of voxels.
const fn as_voxel(index: BlockIndex) -> Voxel {
    Voxel::new(index.x, index.y, index.z)
}

const fn index_of(region: BlockIndex, place: usize) -> BlockIndex {
    let Voxel { x, y, z } = region.voxel(place);
    BlockIndex { x, y, z }
}
