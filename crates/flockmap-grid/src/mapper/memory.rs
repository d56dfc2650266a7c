//! The most that a mapper holds, reckoned from its options.

use super::block::MapBlock;
use super::config::{MapperConfig, RaysWalked};
use super::ray::Ray;
use super::rays::TURN;
use super::submaps::MovedBlock;
use crate::{BLOCK_SIDE, BLOCK_VOXELS, BlockIndex, Plane, Stamp, StateBlock};

/// The most bytes that one block of the map takes of the byte cap: itself, and its places in the table of
/// blocks and in that of blocks with changes. A table is filled to no less than 7/32 while blocks come and
/// go.
pub const MAP_BLOCK_BYTES: usize =
    size_of::<MapBlock>() + LISTED_BYTES * 9 / 4 + (ENTRY_BYTES + 1 + PENDING_BYTES + 1) * 32 / 7;
/// What a scan can take for a moment, for each block that it touches, beside the counts: its numbers and places, the
/// work that it is, and what is reported of it, by the thread that updates it and by the scan.
const SCAN_BLOCK_BYTES: usize = 16 + 24 + 32 + (2 * REPORT_BYTES + 4) + FORGET_BYTES;
/// For each thread: the numbers of blocks in lists that double.
const NUMBERS_BYTES: usize = 4 * 3 * size_of::<u32>();
/// In the report.
const REPORT_BYTES: usize =
    size_of::<(BlockIndex, Plane)>() + size_of::<(BlockIndex, StateBlock)>() + MOVED_BYTES;
/// In the list of what may be forgotten, and in the report of it.
const FORGET_BYTES: usize = size_of::<FarKey>() + size_of::<BlockIndex>() + MOVED_BYTES;
/// In the list of blocks that were in another submap; moved to a new place while it grows.
const MOVED_BYTES: usize = 3 * size_of::<MovedBlock>();
/// For each of its points: the ray, and its place in the order; each is made anew when a larger scan comes.
const POINT_BYTES: usize = 2 * (size_of::<Ray>() + size_of::<u32>());
/// For each thread: points that it takes more than another one, and how many rays there are of each length, and
/// what the pool of threads needs.
const THREAD_BYTES: usize = 2 * TURN * POINT_BYTES + 2 * 1_501 * size_of::<u32>() + (16 << 10);
/// Stamps of scans, as long as voxels refer to them; moved to a new place while the list grows.
const SCAN_STAMPS_BYTES: usize = (1 << 16) * size_of::<Stamp>() * 3 / 2;

/// A block in its table, and in the list of blocks.
pub(super) const ENTRY_BYTES: usize = size_of::<(BlockIndex, u32)>();
pub(super) const LISTED_BYTES: usize = size_of::<(BlockIndex, Box<MapBlock>)>();
/// A block in the table of those with changes.
pub(super) const PENDING_BYTES: usize = size_of::<(BlockIndex, u32)>();

/// By which blocks are farther from the sensor than others: the square of the distance in blocks, and the index.
pub(super) type FarKey = (i64, BlockIndex);

impl MapperConfig {
    /// The most bytes that a mapper holds on the heap at any moment, as asked of the allocator, with scans of
    /// so many points: the map, and what it needs to take one in. A scan touches a block only if a ray runs
    /// through it, so a sensor in the open comes near to this, and one between walls takes a small part of
    /// it.
    pub fn memory_max(&self, points: usize) -> usize {
        // Blocks from end to end of two rays in opposite directions, and one more since they need not begin
        // at a face.
        let side =
            (2.0 * self.range_m / self.resolution.metres() / f64::from(BLOCK_SIDE)).ceil() as usize + 2;
        let (blocks, window) = (side.saturating_pow(3), side.next_power_of_two().saturating_pow(3));
        // Of rays that pass and of rays that end: a list a quarter too large, moved to a new place while it grows.
        let in_lists = |bytes: usize| (blocks.saturating_mul(2 * bytes * 9 / 4), 2 * size_of::<u32>());
        let (lists, of_window) = match self.rules().map(|rules| rules.rays_max) {
            Ok(0..=1) => (blocks.saturating_mul(64 * 9 / 4), 64 + size_of::<u32>()),
            Ok(2..=255) => in_lists(BLOCK_VOXELS),
            _ => in_lists(2 * BLOCK_VOXELS),
        };
        let (ends, ends_of_window) = match self.rays {
            RaysWalked::All => (0, 0),
            RaysWalked::OnePerEndVoxel => {
                (blocks.saturating_mul(64 * 9 / 4 + NUMBERS_BYTES / 4), size_of::<u32>())
            }
        };
        let of_thread = lists
            .saturating_add(ends)
            .saturating_add(window.saturating_mul(of_window + ends_of_window))
            .saturating_add(blocks.saturating_mul(NUMBERS_BYTES) + THREAD_BYTES);
        self.memory_bytes_max.max(MAP_BLOCK_BYTES)
            + blocks.saturating_mul(SCAN_BLOCK_BYTES)
            + of_thread.saturating_mul(self.threads)
            + self.blocks_max() * FORGET_BYTES
            + points.saturating_mul(POINT_BYTES)
            + SCAN_STAMPS_BYTES
    }

    /// Most blocks of the map.
    pub(super) fn blocks_max(&self) -> usize {
        (self.memory_bytes_max / MAP_BLOCK_BYTES).max(1)
    }
}
