//! The blocks of the fused map in a cube of 8 × 8 × 8 blocks: what is copied when a map is written to while a
//! view of it is alive.

use crate::block::bits;
use crate::{BlockIndex, Plane, StateBlock, Voxel, plane_within, set_bits, voxel_bit};

/// Blocks along a side of a region.
pub(super) const REGION_SIDE: usize = 8;

/// Blocks in ascending order of their places, each 136 bytes, and which places they are of: a block is found
/// by counting those before it. A layer of them lies together in memory, as slices of a map are read. To put a
/// new one in moves those behind it: on average some 10 kB in a region of 512.
#[derive(Clone, PartialEq, Debug, Default)]
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
#[derive(Clone, PartialEq, Debug)]
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
    /// Of blocks at these places, in their order. `version` is of the block that changed last, of those also that were
    /// let go.
    pub(super) fn from_parts(places: Plane, blocks: Vec<ViewBlock>, version: u64) -> Self {
        Self { places, below: below(&places), blocks, version }
    }

    /// A bit for each place at which there is a block.
    pub(super) const fn places(&self) -> &Plane {
        &self.places
    }

    /// In ascending order of their places.
    pub(super) fn parts(&self) -> &[ViewBlock] {
        &self.blocks
    }

    /// Of the block that changed last.
    pub(super) const fn version(&self) -> u64 {
        self.version
    }

    /// Bytes on the heap: at most [`BLOCK_BYTES_MAX`] for each block, so none if there is none.
    pub(super) fn memory_bytes(&self) -> usize {
        if self.is_empty() { 0 } else { bytes_of(self.blocks.capacity()) }
    }

    /// The states of the block at this index, of which the region is that of [`region_of`].
    pub(super) fn block(&self, index: BlockIndex) -> Option<&StateBlock> {
        self.rank(index).ok().map(|rank| &self.blocks[rank].states)
    }

    /// The version at which a block changed last.
    pub(super) fn changed_at(&self, index: BlockIndex) -> Option<u64> {
        self.rank(index).ok().map(|rank| self.blocks[rank].version)
    }

    /// The numbers of the blocks from `low` to `high` among all, ascending, with their indices. `at` is the region's
    /// own index.
    pub(super) fn ranks_between(
        &self,
        at: BlockIndex,
        low: BlockIndex,
        high: BlockIndex,
    ) -> impl Iterator<Item = (usize, BlockIndex)> + use<> {
        let [low, high] = [as_voxel(low).highest(at.voxel(0)), as_voxel(high).lowest(at.voxel(511))];
        let (within, places, below) = (plane_within(at, low, high), self.places, self.below);
        (0..8).filter(move |z| within[*z] != 0).flat_map(move |z| {
            let ranks = usize::from(below[z])..;
            let inside = move |(place, _): &(usize, _)| within[z] >> place & 1 == 1;
            let found = bits(places[z]).zip(ranks).filter(inside);
            found.map(move |(place, rank)| (rank, index_of(at, z * 64 + place)))
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
                let place = place_of(index);
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
        (self.places, self.below) = (kept, below(&kept));
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
        let place = place_of(index);
        let (places, bit) = (self.places[place / 64], 1 << (place % 64));
        let rank = usize::from(self.below[place / 64]) + (places & (bit - 1)).count_ones() as usize;
        if places & bit == 0 { Err(rank) } else { Ok(rank) }
    }
}

/// The blocks at these places, in ascending order. `at` is the region's own index.
pub(super) fn indices(at: BlockIndex, places: &Plane) -> impl Iterator<Item = BlockIndex> + use<> {
    set_bits(places).map(move |place| index_of(at, place))
}

/// The place of a block in its region, counted as the voxels of a block are.
pub(super) const fn place_of(index: BlockIndex) -> usize {
    voxel_bit(as_voxel(index))
}

/// Bytes of a region with room for so many blocks.
pub(super) const fn bytes_of(blocks: usize) -> usize {
    REGION_BYTES + blocks * size_of::<ViewBlock>()
}

/// Places in the layers below each.
fn below(places: &Plane) -> [u16; 8] {
    let mut all = 0;
    places.map(|layer| {
        let below = all;
        all += layer.count_ones() as u16;
        below
    })
}

/// A region is of blocks what a block is of voxels.
const fn as_voxel(index: BlockIndex) -> Voxel {
    Voxel::new(index.x, index.y, index.z)
}

const fn index_of(region: BlockIndex, place: usize) -> BlockIndex {
    let Voxel { x, y, z } = region.voxel(place);
    BlockIndex { x, y, z }
}
