//! The mapper: scans in, or states from elsewhere, occupancy out, and which voxels have changed since they were last
//! published.

mod block;
mod blocks;
mod casting;
mod collect;
mod config;
mod group;
mod insert;
mod memory;
mod ray;
mod rays;
mod report;
mod revisit;
mod states;
mod submaps;
mod take;
mod tally;
mod window;
mod workers;

use rustc_hash::FxHashMap;

use crate::memory::table_bytes;
use crate::{BlockIndex, Plane, Stamp, State, StateBlock, Voxel, voxel_bit};
use block::MapBlock;
use blocks::Blocks;
use casting::Casting;
use config::Rules;
pub use config::{ConfigError, LOG_ODDS_UNITS_PER_NAT, MapperConfig, Preset, RaysWalked};
pub use memory::MAP_BLOCK_BYTES;
use memory::{ENTRY_BYTES, FarKey, LISTED_BYTES, PENDING_BYTES};
pub use report::{ScanReport, Sphere};
pub(crate) use revisit::OwnBlocks;
pub use submaps::MovedBlock;
use submaps::Submaps;

/// A robot's own occupancy map, made from its own scans (paper Alg. 1, line 6 to 12).
///
/// Block-sparse: a hash map of blocks of 8³ voxels, 2.3 kB each. What was never observed costs nothing.
pub struct Mapper {
    config: MapperConfig,
    rules: Rules,
    blocks: Blocks,
    /// Blocks with changes, or that had some; the flag in `is_pending` keeps each in here once.
    pending_blocks: FxHashMap<BlockIndex, u32>,
    pending: usize,
    /// Room in the table of blocks, the list of them, and the table of blocks with changes. They never shrink.
    table_places: [usize; 3],
    casting: Casting,
    /// Where the sensor was last, or what stood for it, in metres.
    place: Option<[f64; 3]>,
    /// Stamp of scan, or update with states, number `i + 1`.
    scan_stamps: Vec<Stamp>,
    submaps: Submaps,
}

/// Which changes to take.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Which {
    /// All of them.
    All,
    /// Only voxels that are Occupied now.
    Occupied,
    /// Only voxels that are Free now.
    Free,
}

impl Mapper {
    /// An empty map.
    ///
    /// # Errors
    /// [`ConfigError`] says which value cannot work and what was expected.
    pub fn new(config: MapperConfig) -> Result<Self, ConfigError> {
        let rules = config.rules()?;
        Ok(Self {
            blocks: Blocks::default(),
            pending_blocks: FxHashMap::default(),
            pending: 0,
            table_places: [0; 3],
            casting: Casting::new(&rules, config.threads),
            place: None,
            scan_stamps: Vec::new(),
            submaps: Submaps::default(),
            config,
            rules,
        })
    }

    /// Its configuration.
    pub const fn config(&self) -> &MapperConfig {
        &self.config
    }

    /// Lets a block be changed, made if it is not there, and notes what came of it: `change` says which voxels it
    /// touched.
    fn change(
        &mut self,
        index: BlockIndex,
        report: &mut ScanReport,
        change: impl FnOnce(&mut MapBlock) -> Plane,
    ) {
        let (block, _) = self.touch(index, report);
        let before = *block.states();
        let touched = change(block);
        if *block.states() != before {
            let (states, changes) = (block.states().minus(&before), block.changes().known_count());
            report.changed.push((index, states));
            self.note_pending(index, changes);
        }
        if touched != [0; 8] {
            report.touched.push((index, touched));
        }
    }

    /// A block that is about to be touched, made if it is not there, and its place in the list of blocks.
    fn touch(&mut self, index: BlockIndex, report: &mut ScanReport) -> (&mut MapBlock, u32) {
        let submaps = &mut self.submaps;
        let (block, place) = self.blocks.entry(index, || submaps.new_block(index, &mut report.moved));
        submaps.note_touched(index, block, &mut report.moved);
        (block, place)
    }

    /// A block has so many changes now.
    fn note_pending(&mut self, index: BlockIndex, changes: u32) {
        let known = self.pending_blocks.entry(index).or_insert(0);
        self.pending = self.pending + changes as usize - *known as usize;
        *known = changes;
    }

    /// Nothing was taken out since the tables grew, if they did.
    fn note_tables(&mut self) {
        let [table, list] = self.blocks.capacity();
        let now = [table, list, self.pending_blocks.capacity()];
        self.table_places = core::array::from_fn(|i| self.table_places[i].max(now[i]));
    }

    /// State of a voxel.
    pub fn state(&self, voxel: Voxel) -> State {
        self.blocks.get(voxel.block()).map_or(State::Unknown, |block| block.states().get(voxel_bit(voxel)))
    }

    /// Log-odds of a voxel in nats, `None` if no ray has touched it.
    pub fn log_odds(&self, voxel: Voxel) -> Option<f64> {
        let units = self.blocks.get(voxel.block())?.log_odds(voxel_bit(voxel))?;
        Some(f64::from(units) / LOG_ODDS_UNITS_PER_NAT)
    }

    /// The states of a block, `None` if nothing in it was ever observed.
    pub fn block(&self, index: BlockIndex) -> Option<&StateBlock> {
        self.blocks.get(index).map(|block| block.states())
    }

    /// All blocks, in no order.
    pub fn blocks(&self) -> impl Iterator<Item = (BlockIndex, &StateBlock)> {
        self.blocks.iter().map(|(index, block)| (index, block.states()))
    }

    /// Stamp of the last scan or update with states that touched a voxel; `None` if none did, or longer ago than
    /// 32,768 of them.
    pub fn last_seen(&self, voxel: Voxel) -> Option<Stamp> {
        let number = self.blocks.get(voxel.block())?.seen(voxel_bit(voxel));
        self.scan_stamps.get(usize::from(number).checked_sub(1)?).copied()
    }

    /// Bytes that the map holds, as asked of the allocator: its blocks and their tables. At most
    /// [`MapperConfig::memory_bytes_max`]. What the last scans needed comes on top, see there. O(1).
    pub fn memory_bytes(&self) -> usize {
        self.block_count() * size_of::<MapBlock>()
            + table_bytes(self.table_places[0], ENTRY_BYTES)
            + self.table_places[1] * LISTED_BYTES
            + table_bytes(self.table_places[2], PENDING_BYTES)
    }

    /// Number of blocks.
    pub fn block_count(&self) -> usize {
        self.blocks.len()
    }

    /// Numbers the scan. Numbers are 16 bits: when they run out, the older half is forgotten.
    fn next_scan_number(&mut self, stamp: Stamp) -> u16 {
        const HALF: u16 = 1 << 15;
        if self.scan_stamps.len() == usize::from(u16::MAX) {
            self.scan_stamps.drain(..usize::from(HALF));
            for block in self.blocks.iter_mut() {
                block.rebase_seen(HALF);
            }
        }
        self.scan_stamps.push(stamp);
        self.scan_stamps.len() as u16
    }

    /// Keeps the byte cap before `touched` blocks are taken in, and makes room in the report for them: forgets
    /// the blocks farthest from `start`, a tenth more than needed so that it does not come to this at every
    /// scan. What is forgotten is no change: the swarm keeps what it received. Returns where the blocks end
    /// that are kept; of those that are touched, the ones beyond are not even made.
    fn forget_far_blocks(
        &mut self,
        start: [f64; 3],
        touched: impl ExactSizeIterator<Item = BlockIndex>,
        report: &mut ScanReport,
    ) -> Option<FarKey> {
        let (blocks_max, touched_count) = (self.config.blocks_max(), touched.len());
        report.touched.reserve_exact(touched_count.min(blocks_max));
        report.changed.reserve_exact(touched_count.min(blocks_max));
        if self.blocks.len() + touched_count <= blocks_max {
            return None;
        }
        let new = touched.filter(|index| !self.blocks.contains(*index));
        let all = self.blocks.iter().map(|(index, _)| index).chain(new);
        let mut far: Vec<FarKey> = Vec::with_capacity(self.blocks.len() + touched_count);
        far.extend(all.map(|index| far_key(start, index)));
        if far.len() <= blocks_max {
            return None;
        }
        let keep = (blocks_max - blocks_max / 10).max(1);
        let (_, &mut end, _) = far.select_nth_unstable(keep);
        for (_, index) in &far[keep..] {
            if let Some(block) = self.blocks.remove(*index) {
                self.submaps.note_forgotten(*index, &block, &mut report.moved);
            }
            if let Some(known) = self.pending_blocks.remove(index) {
                self.pending -= known as usize;
            }
        }
        report.forgotten = far[keep..].iter().map(|(_, index)| *index).collect();
        report.forgotten.sort_unstable();
        Some(end)
    }
}

/// `start`: where the sensor is, in voxels.
fn far_key(start: [f64; 3], index: BlockIndex) -> FarKey {
    let [x, y, z] = start.map(|v| (v / 8.0).floor() as i32);
    (index.distance_squared(BlockIndex { x, y, z }), index)
}
