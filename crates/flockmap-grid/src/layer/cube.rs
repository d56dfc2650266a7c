//! A cube of 4 × 4 × 4 blocks of a layer: what is packed and unpacked at once.

use super::block::LayerBlock;
use crate::{BlockIndex, Stamp};

/// Blocks along a side of a cube.
pub(super) const CUBE_SIDE: usize = 4;

/// The blocks of a cube that are there, in ascending order of their places.
#[derive(PartialEq, Debug, Default)]
pub(crate) struct Cube {
    /// A bit for each place at which there is a block: `z·16 + y·4 + x` of its place in the cube.
    places: u64,
    blocks: Vec<LayerBlock>,
}

/// Bytes of a block in a cube, beside its stamps. The list grows by an eighth.
pub(super) const CUBE_BLOCK_BYTES: usize = size_of::<LayerBlock>();

/// The cube of a block, by its lowest block divided by the side.
pub(crate) const fn cube_of(index: BlockIndex) -> BlockIndex {
    BlockIndex { x: index.x >> 2, y: index.y >> 2, z: index.z >> 2 }
}

/// The lowest block of a cube.
pub(crate) const fn first_of(at: BlockIndex) -> BlockIndex {
    BlockIndex { x: at.x << 2, y: at.y << 2, z: at.z << 2 }
}

pub(super) const fn place_of(index: BlockIndex) -> u32 {
    ((index.z & 3) << 4 | (index.y & 3) << 2 | (index.x & 3)) as u32
}

impl Clone for Cube {
    /// With as much room: it takes as many bytes.
    fn clone(&self) -> Self {
        let mut blocks = Vec::with_capacity(self.blocks.capacity());
        blocks.extend_from_slice(&self.blocks);
        Self { places: self.places, blocks }
    }
}

impl Cube {
    /// Of blocks at these places, in their order.
    pub(super) const fn from_parts(places: u64, blocks: Vec<LayerBlock>) -> Self {
        Self { places, blocks }
    }

    pub(super) const fn places(&self) -> u64 {
        self.places
    }

    /// In ascending order of their places.
    pub(super) fn parts(&self) -> &[LayerBlock] {
        &self.blocks
    }

    pub(super) fn block(&self, index: BlockIndex) -> Option<&LayerBlock> {
        self.rank(index).ok().map(|rank| &self.blocks[rank])
    }

    /// All blocks with their indices. `at` is the cube's own index.
    pub(super) fn blocks(&self, at: BlockIndex) -> impl Iterator<Item = (BlockIndex, &LayerBlock)> {
        places(self.places).map(move |place| index_of(at, place)).zip(&self.blocks)
    }

    /// The block of an index, made if need be for something with this stamp.
    pub(super) fn entry(&mut self, index: BlockIndex, stamp: Stamp) -> &mut LayerBlock {
        let rank = self.rank(index).unwrap_or_else(|rank| {
            if self.blocks.len() == self.blocks.capacity() {
                self.blocks.reserve_exact(spare_of(self.blocks.len()));
            }
            self.blocks.insert(rank, LayerBlock::new(stamp));
            self.places |= 1 << place_of(index);
            rank
        });
        &mut self.blocks[rank]
    }

    /// Bytes on the heap. O(blocks).
    pub(super) fn memory_bytes(&self) -> usize {
        let stamps: usize = self.blocks.iter().map(|block| block.stamps.memory_bytes()).sum();
        self.list_bytes() + stamps
    }

    /// Number of blocks.
    pub(super) const fn len(&self) -> usize {
        self.blocks.len()
    }

    /// Bytes of the list of blocks.
    pub(super) const fn list_bytes(&self) -> usize {
        self.blocks.capacity() * CUBE_BLOCK_BYTES
    }

    /// The most that a list takes that grew to so many blocks one by one.
    pub(super) const fn list_bytes_max(blocks: usize) -> usize {
        if blocks == 0 { 0 } else { (blocks + spare_of(blocks)) * CUBE_BLOCK_BYTES }
    }

    /// The most by which so many further blocks make it grow, beside their stamps; while it grows, it is there
    /// twice.
    pub(super) fn growth_max(&self, further: usize) -> usize {
        let len = self.blocks.len() + further;
        if len <= self.blocks.capacity() { 0 } else { Self::list_bytes_max(len) }
    }

    /// Where a block is among the blocks, or where it would be.
    fn rank(&self, index: BlockIndex) -> Result<usize, usize> {
        let bit = 1u64 << place_of(index);
        let rank = (self.places & (bit - 1)).count_ones() as usize;
        if self.places & bit == 0 { Err(rank) } else { Ok(rank) }
    }
}

const fn spare_of(len: usize) -> usize {
    len / 8 + 1
}

/// The places that are set, ascending.
pub(super) fn places(mut left: u64) -> impl Iterator<Item = u32> {
    core::iter::from_fn(move || {
        let place = left.trailing_zeros();
        (left != 0).then(|| {
            left &= left - 1;
            place
        })
    })
}

const fn index_of(cube: BlockIndex, place: u32) -> BlockIndex {
    let place = place as i32;
    BlockIndex { x: cube.x << 2 | place & 3, y: cube.y << 2 | place >> 2 & 3, z: cube.z << 2 | place >> 4 }
}
