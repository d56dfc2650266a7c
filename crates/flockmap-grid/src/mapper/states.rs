//! States from a mapper elsewhere, set in place of what scans would have made of them.

use super::block::MapBlock;
use super::{Mapper, ScanReport, far_key};
use crate::block::plane_within;
use crate::{
    BlockIndex, Plane, State, StateBlock, States, StatesError, StatesUpdate, Voxel, VoxelBox, set_bits,
    voxel_bit,
};

impl Mapper {
    /// Takes in states of voxels that a mapper elsewhere found.
    ///
    /// A voxel that is set to Free or Occupied has the log-odds at which scans stop counting, `p_min` or
    /// `p_max`; one that is set to Unknown has none, as if never touched. So scans that come later count from
    /// there, as they do on a voxel that was seen for long: with the values of ROG-Map 54 rays must pass before an
    /// Occupied voxel is not so any more. And states that come later set what scans have made, whatever that was. A
    /// robot that has both should know that neither is averaged with the other: who spoke last is right.
    ///
    /// The byte cap holds as for scans: the blocks farthest from the sensor are forgotten, or not even made.
    ///
    /// Where the place of the sensor is not given, one stands for it, in the report too: that of before, drawn after
    /// the mean of the voxels that are touched, on a rope of half of `range_m`. A sensor that looks ahead is behind
    /// what it sees, and with the mean itself the codec needs half as many bytes again.
    ///
    /// O(n) for a box of n voxels, and O(n log n) for n single ones.
    ///
    /// # Errors
    /// [`StatesError`] says what was wrong; nothing is changed then.
    pub fn insert_states(&mut self, update: &StatesUpdate<'_>) -> Result<ScanReport, StatesError> {
        update.check(self.config.resolution)?;
        let mut report = ScanReport { stamp: update.stamp, ..ScanReport::default() };
        let said = Said::new(&update.states);
        let (mut touched, mut middle) = (said.blocks(), Mean::default());
        touched.retain(|index| {
            let (states, mask) = said.within(*index, self.block(*index));
            // What was never known cannot be taken back.
            let is_touched = mask != [0; 8] && (!states.is_empty() || self.blocks.contains(*index));
            if is_touched && update.sensor.is_none() {
                middle.add(*index, &mask);
            }
            is_touched
        });
        let metres = self.config.resolution.metres();
        let seen_from = || {
            let mean = middle.get()?.map(|at| at * metres);
            Some(drawn(self.place.unwrap_or(mean), mean, self.config.range_m / 2.0))
        };
        report.sensor = update.sensor.or_else(seen_from);
        self.place = report.sensor.or(self.place);
        let Some(sensor) = report.sensor.filter(|_| !touched.is_empty()) else { return Ok(report) };
        let start = sensor.map(|at| at / metres);
        let number = self.next_scan_number(update.stamp);
        let nearer_than = self.forget_far_blocks(start, touched.iter().copied(), &mut report);
        for index in touched {
            if nearer_than.is_some_and(|end| far_key(start, index) >= end) {
                continue;
            }
            let (states, mask) = said.within(index, self.block(index));
            let rules = self.rules;
            let set = |block: &mut MapBlock| {
                block.set(&rules, number, &states, &mask);
                mask
            };
            if !self.is_over(index) || self.revisit(index, &mut report, set) {
                self.change(index, &mut report, set);
            }
        }
        self.note_tables();
        Ok(report)
    }
}

/// Where a place comes to that is drawn after another one on a rope.
fn drawn(place: [f64; 3], after: [f64; 3], rope: f64) -> [f64; 3] {
    let back: [f64; 3] = core::array::from_fn(|axis| place[axis] - after[axis]);
    let length = back.iter().map(|d| d * d).sum::<f64>().sqrt();
    let part = if length > rope { rope / length } else { 1.0 };
    core::array::from_fn(|axis| after[axis] + back[axis] * part)
}

/// What an update says, block by block.
enum Said<'a> {
    Voxels {
        voxels: &'a [(Voxel, State)],
        /// The block of each and its place in the list, ascending.
        sorted: Vec<(BlockIndex, u32)>,
    },
    Box {
        region: VoxelBox,
        states: &'a [State],
        clear_unknown: bool,
    },
}

impl<'a> Said<'a> {
    fn new(states: &States<'a>) -> Self {
        match *states {
            States::Voxels(voxels) => {
                let places = voxels.iter().zip(0..).map(|((voxel, _), place)| (voxel.block(), place));
                let mut sorted: Vec<(BlockIndex, u32)> = places.collect();
                sorted.sort_unstable();
                Self::Voxels { voxels, sorted }
            }
            States::Box { region, states, clear_unknown } => Self::Box { region, states, clear_unknown },
        }
    }

    /// The blocks that it speaks of.
    fn blocks(&self) -> Vec<BlockIndex> {
        match self {
            Self::Voxels { sorted, .. } => {
                let groups = sorted.chunk_by(|a, b| a.0 == b.0);
                groups.filter_map(|group| Some(group.first()?.0)).collect()
            }
            Self::Box { region, .. } => region.blocks().collect(),
        }
    }

    /// What it says of a block that was `before`, and of which voxels.
    fn within(&self, index: BlockIndex, before: Option<&StateBlock>) -> (StateBlock, Plane) {
        let (mut states, mut mask) = (StateBlock::default(), [0; 8]);
        match self {
            Self::Voxels { voxels, sorted } => {
                let first = sorted.partition_point(|(block, _)| *block < index);
                for (_, place) in sorted[first..].iter().take_while(|(block, _)| *block == index) {
                    let (voxel, state) = voxels[*place as usize];
                    let bit = voxel_bit(voxel);
                    states.set(bit, state);
                    mask[bit >> 6] |= 1u64 << (bit & 63);
                }
            }
            Self::Box { region, states: all, clear_unknown } => {
                let Some(part) = region.intersection(&index.voxel_box()) else { return (states, mask) };
                states = read_box(region, all, &part);
                let (known, before) = (states.known(), before.copied().unwrap_or_default());
                mask = plane_within(index, part.min(), part.max());
                for z in 0..8 {
                    let differs =
                        (states.free()[z] ^ before.free()[z]) | (states.occupied()[z] ^ before.occupied()[z]);
                    mask[z] &= differs & if *clear_unknown { !0 } else { known[z] };
                }
            }
        }
        (states, mask)
    }
}

/// The part of a box that lies in one block.
fn read_box(region: &VoxelBox, states: &[State], part: &VoxelBox) -> StateBlock {
    let [width, depth, _] = region.size().map(|side| side as usize);
    let (low, high, min) = (part.min(), part.max(), region.min());
    let (mut free, mut occupied) = ([0u64; 8], [0u64; 8]);
    for z in low.z..=high.z {
        for y in low.y..=high.y {
            let row =
                ((z - min.z) as usize * depth + (y - min.y) as usize) * width + (low.x - min.x) as usize;
            let first = voxel_bit(Voxel::new(low.x, y, z));
            let (word, first) = (first >> 6, first & 63);
            for (k, state) in states[row..row + part.size()[0] as usize].iter().enumerate() {
                free[word] |= u64::from(*state == State::Free) << (first + k);
                occupied[word] |= u64::from(*state == State::Occupied) << (first + k);
            }
        }
    }
    StateBlock::new(free, occupied)
}

/// The mean of voxels.
#[derive(Default)]
struct Mean {
    /// Of their indices.
    sum: [i64; 3],
    count: i64,
}

impl Mean {
    fn add(&mut self, index: BlockIndex, voxels: &Plane) {
        for bit in set_bits(voxels) {
            let voxel = index.voxel(bit);
            for (sum, at) in self.sum.iter_mut().zip([voxel.x, voxel.y, voxel.z]) {
                *sum += i64::from(at);
            }
            self.count += 1;
        }
    }

    /// In voxels, if there is one.
    fn get(&self) -> Option<[f64; 3]> {
        (self.count > 0).then(|| self.sum.map(|sum| sum as f64 / self.count as f64 + 0.5))
    }
}
