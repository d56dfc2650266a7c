//! The mapper: scans in, or states from elsewhere, occupancy out, and which voxels have changed since they were last
//! published.

mod block;
mod config;
mod memory;
mod rays;
mod revisit;
mod states;
mod submaps;
mod take;

use rustc_hash::FxHashMap;

use crate::memory::table_bytes;
use crate::{BlockIndex, Plane, Pose, Scan, Stamp, State, StateBlock, Voxel, voxel_bit};
use block::MapBlock;
use config::Rules;
pub use config::{ConfigError, LOG_ODDS_UNITS_PER_NAT, MapperConfig, Preset};
pub use memory::MAP_BLOCK_BYTES;
use memory::{ENTRY_BYTES, FarKey, PENDING_BYTES};
use rays::{Ray, RayCounts};
pub(crate) use revisit::OwnBlocks;
pub use submaps::MovedBlock;
use submaps::Submaps;

/// A robot's own occupancy map, made from its own scans (paper Alg. 1, line 6 to 12).
///
/// Block-sparse: a hash map of blocks of 8³ voxels, 2.3 kB each. What was never observed costs nothing.
pub struct Mapper {
    config: MapperConfig,
    rules: Rules,
    blocks: FxHashMap<BlockIndex, Box<MapBlock>>,
    /// Blocks with changes, or that had some; the flag in `is_pending` keeps each in here once.
    pending_blocks: FxHashMap<BlockIndex, u32>,
    pending: usize,
    /// Room in the tables of blocks and of blocks with changes. Tables never shrink.
    table_places: [usize; 2],
    counts: RayCounts,
    rays: Vec<Ray>,
    /// Where the sensor was last, or what stood for it, in metres.
    place: Option<[f64; 3]>,
    /// Stamp of scan, or update with states, number `i + 1`.
    scan_stamps: Vec<Stamp>,
    submaps: Submaps,
}

/// A sphere in the frame of the map, in metres.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Sphere {
    /// Its centre.
    pub centre: [f64; 3],
    /// Its radius.
    pub radius: f64,
}

/// What became of a scan, or of an update with states, which has no rays.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct ScanReport {
    /// When it counts as made.
    pub stamp: Stamp,
    /// Where the sensor was, in metres in the frame of the map; of states without that, what stands for it, if anything
    /// was touched.
    pub sensor: Option<[f64; 3]>,
    /// Blocks with touched voxels, and which.
    pub touched: Vec<(BlockIndex, Plane)>,
    /// Voxels that are Free or Occupied now and were not before this scan.
    pub changed: Vec<(BlockIndex, StateBlock)>,
    /// Blocks that were forgotten under the byte cap, or not even taken in, ascending.
    pub forgotten: Vec<BlockIndex>,
    /// Blocks in which what was known is not any more, or not in the same submap.
    pub moved: Vec<MovedBlock>,
    /// Rays that ended with a hit.
    pub hits: usize,
    /// Rays that were cut, or came back with nothing: they carve free space only.
    pub cut: usize,
    /// Points that were ignored: not finite, too near, or too far out for voxel indices.
    pub ignored: usize,
    /// Points that were ignored since they lie on a team-mate.
    pub masked: usize,
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
            config,
            rules,
            blocks: FxHashMap::default(),
            pending_blocks: FxHashMap::default(),
            pending: 0,
            table_places: [0; 2],
            counts: RayCounts::default(),
            rays: Vec::new(),
            place: None,
            scan_stamps: Vec::new(),
            submaps: Submaps::default(),
        })
    }

    /// Its configuration.
    pub const fn config(&self) -> &MapperConfig {
        &self.config
    }

    /// Takes in one scan made at `T_map_sensor`. Points inside one of the spheres of `teammates` are ignored,
    /// so that a robot in sight does not become an obstacle. With a pose that is none, or beyond the grid
    /// ([`Pose::check`]), the whole scan is ignored.
    ///
    /// Cost: about one nanosecond a voxel passed by a ray; memory for what is touched for the first time.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    pub fn insert(&mut self, scan: &Scan, T_map_sensor: &Pose, teammates: &[Sphere]) -> ScanReport {
        self.insert_at(scan.stamp, scan, T_map_sensor, teammates)
    }

    /// The same with another stamp in place of the scan's own.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    pub fn insert_at(
        &mut self,
        stamp: Stamp,
        scan: &Scan,
        T_map_sensor: &Pose,
        teammates: &[Sphere],
    ) -> ScanReport {
        let mut report = ScanReport { stamp, ..ScanReport::default() };
        if T_map_sensor.check(self.config.resolution).is_err() {
            report.ignored = scan.points.len() + scan.no_returns.len();
            return report;
        }
        self.place = Some(T_map_sensor.translation());
        report.sensor = self.place;
        let scale = 1.0 / self.config.resolution.metres();
        let start = T_map_sensor.translation().map(|v| v * scale);
        self.collect_rays(scan, T_map_sensor, teammates, start, scale, &mut report);
        let number = self.next_scan_number(stamp);
        // Out of the way, so that the map can be changed by what they say.
        let mut counts = core::mem::take(&mut self.counts);
        counts.cast(start, &self.rays);
        let nearer_than = self.forget_far_blocks(start, counts.indices(), &mut report);
        for mut counts in counts.blocks() {
            if nearer_than.is_some_and(|end| far_key(start, counts.index) >= end) {
                counts.clear();
                continue;
            }
            let rules = self.rules;
            if self.is_over(counts.index) {
                let kept = counts.copy();
                if !self.revisit(counts.index, &mut report, |block| block.update(&rules, number, &mut counts))
                {
                    continue;
                }
                counts.put_back(kept);
            }
            self.change(counts.index, &mut report, |block| block.update(&rules, number, &mut counts));
        }
        self.counts = counts;
        self.note_tables();
        report
    }

    /// Lets a block be changed, made if it is not there, and notes what came of it: `change` says which voxels it
    /// touched.
    fn change(
        &mut self,
        index: BlockIndex,
        report: &mut ScanReport,
        change: impl FnOnce(&mut MapBlock) -> Plane,
    ) {
        let submaps = &mut self.submaps;
        let block =
            self.blocks.entry(index).or_insert_with(|| Box::new(submaps.new_block(index, &mut report.moved)));
        submaps.note_touched(index, block, &mut report.moved);
        let before = *block.states();
        let touched = change(block);
        if *block.states() != before {
            report.changed.push((index, block.states().minus(&before)));
            let changed = block.changes().known_count();
            let known = self.pending_blocks.entry(index).or_insert(0);
            self.pending = self.pending + changed as usize - *known as usize;
            *known = changed;
        }
        if touched != [0; 8] {
            report.touched.push((index, touched));
        }
    }

    /// Nothing was taken out since the tables grew, if they did.
    fn note_tables(&mut self) {
        self.table_places = [
            self.table_places[0].max(self.blocks.capacity()),
            self.table_places[1].max(self.pending_blocks.capacity()),
        ];
    }

    /// State of a voxel.
    pub fn state(&self, voxel: Voxel) -> State {
        self.blocks.get(&voxel.block()).map_or(State::Unknown, |block| block.states().get(voxel_bit(voxel)))
    }

    /// Log-odds of a voxel in nats, `None` if no ray has touched it.
    pub fn log_odds(&self, voxel: Voxel) -> Option<f64> {
        let units = self.blocks.get(&voxel.block())?.log_odds(voxel_bit(voxel))?;
        Some(f64::from(units) / LOG_ODDS_UNITS_PER_NAT)
    }

    /// The states of a block, `None` if nothing in it was ever observed.
    pub fn block(&self, index: BlockIndex) -> Option<&StateBlock> {
        self.blocks.get(&index).map(|block| block.states())
    }

    /// All blocks, in no order.
    pub fn blocks(&self) -> impl Iterator<Item = (BlockIndex, &StateBlock)> {
        self.blocks.iter().map(|(index, block)| (*index, block.states()))
    }

    /// Stamp of the last scan or update with states that touched a voxel; `None` if none did, or longer ago than
    /// 32,768 of them.
    pub fn last_seen(&self, voxel: Voxel) -> Option<Stamp> {
        let number = self.blocks.get(&voxel.block())?.seen(voxel_bit(voxel));
        self.scan_stamps.get(usize::from(number).checked_sub(1)?).copied()
    }

    /// Bytes that the map holds, as asked of the allocator: its blocks and their tables. At most
    /// [`MapperConfig::memory_bytes_max`]. What the last scans needed comes on top, see there. O(1).
    pub fn memory_bytes(&self) -> usize {
        self.block_count() * size_of::<MapBlock>()
            + table_bytes(self.table_places[0], ENTRY_BYTES)
            + table_bytes(self.table_places[1], PENDING_BYTES)
    }

    /// Number of blocks.
    pub fn block_count(&self) -> usize {
        self.blocks.len()
    }

    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    fn collect_rays(
        &mut self,
        scan: &Scan,
        T_map_sensor: &Pose,
        teammates: &[Sphere],
        start: [f64; 3],
        scale: f64,
        report: &mut ScanReport,
    ) {
        let rotation = T_map_sensor.rotation_rows().map(|row| row.map(|v| v * scale));
        let (range, range_min) = (self.config.range_m * scale, self.config.range_min_m * scale);
        let half_box = self.config.update_box_m.map(|half| half.map(|h| h * scale));
        let lowest_cut_end = self.config.drop_cut_rays_below_m.map(|z| z * scale);
        let masks: Vec<([f64; 3], f64)> =
            teammates.iter().map(|s| (s.centre.map(|c| c * scale), (s.radius * scale).powi(2))).collect();
        self.rays.clear();
        self.rays.reserve_exact(scan.points.len() + scan.no_returns.len());
        let returns = scan.points.iter().map(|p| (p, true));
        for (point, returned) in returns.chain(scan.no_returns.iter().map(|p| (p, false))) {
            let p = point.map(f64::from);
            let d: [f64; 3] = core::array::from_fn(|axis| {
                rotation[axis][0] * p[0] + rotation[axis][1] * p[1] + rotation[axis][2] * p[2]
            });
            let length = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
            // Written so that a NaN is ignored.
            if !(length >= range_min && length < f64::INFINITY) {
                report.ignored += 1;
                continue;
            }
            let end: [f64; 3] = core::array::from_fn(|axis| start[axis] + d[axis]);
            if returned
                && masks.iter().any(|(c, radius2)| {
                    (0..3).map(|axis| (end[axis] - c[axis]).powi(2)).sum::<f64>() <= *radius2
                })
            {
                report.masked += 1;
                continue;
            }
            let mut part = if length > range { range / length } else { 1.0 };
            if let Some(half) = half_box {
                for axis in 0..3 {
                    if (d[axis] * part).abs() > half[axis] {
                        part = half[axis] / d[axis].abs();
                    }
                }
            }
            let is_hit = returned && part == 1.0;
            let end =
                if part == 1.0 { end } else { core::array::from_fn(|axis| start[axis] + d[axis] * part) };
            if !is_hit && lowest_cut_end.is_some_and(|z| end[2] < z) {
                report.ignored += 1;
                continue;
            }
            if is_hit {
                report.hits += 1;
            } else {
                report.cut += 1;
            }
            self.rays.push(Ray { end, is_hit });
        }
    }

    /// Numbers the scan. Numbers are 16 bits: when they run out, the older half is forgotten.
    fn next_scan_number(&mut self, stamp: Stamp) -> u16 {
        const HALF: u16 = 1 << 15;
        if self.scan_stamps.len() == usize::from(u16::MAX) {
            self.scan_stamps.drain(..usize::from(HALF));
            for block in self.blocks.values_mut() {
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
        let new = touched.filter(|index| !self.blocks.contains_key(index));
        let all = self.blocks.keys().copied().chain(new);
        let mut far: Vec<FarKey> = Vec::with_capacity(self.blocks.len() + touched_count);
        far.extend(all.map(|index| far_key(start, index)));
        if far.len() <= blocks_max {
            return None;
        }
        let keep = (blocks_max - blocks_max / 10).max(1);
        let (_, &mut end, _) = far.select_nth_unstable(keep);
        for (_, index) in &far[keep..] {
            if let Some(block) = self.blocks.remove(index) {
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
