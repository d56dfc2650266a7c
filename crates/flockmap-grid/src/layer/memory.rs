//! What a layer takes, and how much more it may take.

use rustc_hash::FxHashMap;

use super::cube::{CUBE_BLOCK_BYTES, Cube, cube_of};
use super::stamps::BlockStamps;
use super::{Layer, OPEN_BYTES, Place};
use crate::memory::table_bytes;
use crate::unpacked::Packed;
use crate::{BlockIndex, Changes};

/// Most bytes that one block of a layer can take: 512 voxels that changed last in 512 different batches, alone in
/// its cube.
pub const LAYER_BLOCK_BYTES_MAX: usize = table_bytes(1, PLACE_BYTES)
    + OPEN_BYTES
    + 2 * CUBE_BLOCK_BYTES
    + BlockStamps::bytes_of(usize::MAX)
    + 4 * QUEUE_BYTES;
/// An open cube in the queue, which doubles.
const QUEUE_BYTES: usize = size_of::<(u64, BlockIndex)>();
/// A cube in the table.
const PLACE_BYTES: usize = size_of::<(BlockIndex, Place)>();

impl Layer {
    /// Bytes that the layer holds, as asked of the allocator. O(1).
    pub fn memory_bytes(&self) -> usize {
        let beside = table_bytes(self.cubes.capacity(), PLACE_BYTES) + self.sensors.memory_bytes();
        beside
            + self.dropped.memory_bytes()
            + self.open_bytes
            + self.packed_bytes
            + self.queue.capacity() * QUEUE_BYTES
    }

    /// Bytes of what left the layer or was changed there while a copy of it kept it, counted up: by how much this has grown
    /// since a copy was made, the copy keeps alone at most. O(1).
    pub const fn bytes_left_in_copies(&self) -> u64 {
        self.left_in_copies
    }

    /// Bytes that it may hold at most while and after so many blocks are added to it, beside their stamps. O(1).
    pub fn memory_bytes_with(&self, blocks: usize) -> usize {
        // Each in a cube of its own.
        let of_cube = OPEN_BYTES + 2 * CUBE_BLOCK_BYTES;
        self.memory_bytes() + self.table_growth(blocks) + self.queue_growth(blocks) + blocks * of_cube
    }

    /// The most by which taking over these changes, each with a stamp of its own, can make it grow, in bytes
    /// (sensors not counted), and by how many blocks. O(blocks), and blocks of packed cubes that are met.
    pub(crate) fn growth_max<'a>(&self, parts: impl Iterator<Item = &'a Changes>) -> (usize, usize) {
        let mut stamps_of = FxHashMap::<BlockIndex, usize>::default();
        for (index, _) in parts.flat_map(Changes::blocks) {
            *stamps_of.entry(*index).or_default() += 1;
        }
        // By cube: how many blocks are new.
        let mut cubes = FxHashMap::<BlockIndex, usize>::default();
        let (mut bytes, mut new_blocks) = (0, 0);
        for (index, stamps) in stamps_of {
            let new = cubes.entry(cube_of(index)).or_default();
            let growth = self.with_block(index, |block| block.stamps.growth_max(stamps));
            bytes += growth.unwrap_or_else(|| {
                *new += 1;
                new_blocks += 1;
                BlockStamps::bytes_of(stamps)
            });
        }
        let (mut new_cubes, mut opened) = (0, 0);
        for (at, new) in cubes {
            bytes += match self.cubes.get(&at) {
                Some(Place::Open(open)) => open.cube.growth_max(new),
                Some(Place::Packed(packed)) => {
                    opened += 1;
                    OPEN_BYTES + packed.open_bytes() + Cube::list_bytes_max(packed.len() + new)
                }
                None => {
                    new_cubes += 1;
                    OPEN_BYTES + Cube::list_bytes_max(new)
                }
            };
        }
        (bytes + self.table_growth(new_cubes) + self.queue_growth(new_cubes + opened), new_blocks)
    }

    /// While the queue grows, the old one is there too.
    fn queue_growth(&self, cubes: usize) -> usize {
        let then = self.queue.len() + cubes;
        if then > self.queue.capacity() { then.next_power_of_two().max(4) * QUEUE_BYTES } else { 0 }
    }

    /// While a table grows, the old one is there too.
    fn table_growth(&self, cubes: usize) -> usize {
        // From one of which cubes were taken out, there may be more room than it shows.
        let now = table_bytes(self.cubes.capacity(), PLACE_BYTES);
        let then = table_bytes(self.cubes.len() + cubes, PLACE_BYTES);
        if then > now { then } else { 0 }
    }
}
