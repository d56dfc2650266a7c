//! A snapshot of many voxels in little memory, stamp by stamp or block by block.

use std::collections::BTreeMap;

use super::Snapshot;
use crate::block::set_bits;
use crate::changes::bounding_box;
use crate::{BlockIndex, Changes, Plane, Stamp, State, StateBlock, VoxelBox};

/// A [`Snapshot`] in at most 2 bytes for each voxel, 6 for each block of each stamp, 16 for each block and some 60 for
/// each stamp, and up to a quarter more; of which the parts are made one after the other.
#[derive(Clone, Debug, Default)]
pub struct SnapshotVoxels {
    /// `None` while nothing is known.
    region: Option<VoxelBox>,
    blocks: Vec<BlockIndex>,
    /// How many stamps say something of each of them: 0 if those were let go of.
    uses: Vec<u32>,
    used: usize,
    /// What each stamp says of blocks, by their place in `blocks`.
    parts: BTreeMap<Stamp, Records>,
    sensors: Vec<(Stamp, [i32; 3])>,
    voxels: usize,
    part_blocks: usize,
    /// Of all records.
    record_bytes: usize,
    /// There are more blocks than can be numbered.
    is_too_large: bool,
}

/// Blocks with a number each: two words for the number, one for how many voxels are known, then a word for each of
/// them: its place in the block, and 512 more if it is Occupied. Where that is longer, the words of the planes.
#[derive(Clone, Debug, Default)]
struct Records(Vec<u16>);

/// So many voxels take as much as the planes of all.
const LISTED_MAX: usize = 64;
const OCCUPIED: u16 = 512;
/// A stamp in a map, about.
const PART_BYTES: usize = 60;

impl Records {
    /// Adds a block. Returns by how many bytes it grew.
    fn push(&mut self, number: u32, block: &StateBlock) -> usize {
        let count = block.known_count() as usize;
        let words = 3 + count.min(LISTED_MAX);
        let before = self.0.capacity();
        if self.0.len() + words > before {
            // By a quarter: there are many, and a list that doubles is half empty.
            self.0.reserve_exact(words.max(self.0.len() / 4));
        }
        self.0.extend_from_slice(&[number as u16, (number >> 16) as u16, count as u16]);
        if count > LISTED_MAX {
            for plane in [block.free(), block.occupied()] {
                self.0.extend(plane.iter().flat_map(|word| [0, 16, 32, 48].map(|at| (word >> at) as u16)));
            }
        } else {
            let voxels = set_bits(&block.known());
            self.0.extend(
                voxels.map(|place| {
                    place as u16 | if block.get(place) == State::Occupied { OCCUPIED } else { 0 }
                }),
            );
        }
        (self.0.capacity() - before) * size_of::<u16>()
    }

    fn iter(&self) -> impl Iterator<Item = (u32, StateBlock)> + '_ {
        self.words().map(|(number, words, count)| (number, block_of(words, count)))
    }

    /// The numbers of its blocks, and how many voxels each has.
    fn counts(&self) -> impl Iterator<Item = (u32, usize)> + '_ {
        self.words().map(|(number, _, count)| (number, count))
    }

    fn words(&self) -> impl Iterator<Item = (u32, &[u16], usize)> + '_ {
        let mut rest = self.0.as_slice();
        core::iter::from_fn(move || {
            let ([low, high, count], after) = rest.split_first_chunk()?;
            let (words, after) = after.split_at_checked(usize::from(*count).min(LISTED_MAX))?;
            rest = after;
            Some((u32::from(*low) | u32::from(*high) << 16, words, usize::from(*count)))
        })
    }
}

/// The block that the words of a record with so many voxels say.
fn block_of(words: &[u16], count: usize) -> StateBlock {
    let mut planes: [Plane; 2] = [[0; 8]; 2];
    if count > LISTED_MAX {
        for (word, four) in planes.as_flattened_mut().iter_mut().zip(words.as_chunks::<4>().0) {
            *word = four.iter().rev().fold(0, |word, part| word << 16 | u64::from(*part));
        }
    } else {
        for word in words {
            let place = usize::from(word % OCCUPIED);
            planes[usize::from(*word >= OCCUPIED)][place / 64] |= 1 << (place % 64);
        }
    }
    let [free, occupied] = planes;
    StateBlock::new(free, occupied)
}

impl SnapshotVoxels {
    /// Adds what is known of a block that was not added yet: what each stamp says of it, each stamp once.
    pub(crate) fn add_block(&mut self, index: BlockIndex, said: impl Iterator<Item = (Stamp, StateBlock)>) {
        let Ok(number) = u32::try_from(self.blocks.len()) else {
            self.is_too_large = true;
            return;
        };
        let (mut known, mut uses) = (StateBlock::default(), 0);
        for (stamp, block) in said {
            self.add_record(stamp, number, &block);
            known.overlay(&block);
            uses += 1;
        }
        if let Some(part) = bounding_box(core::iter::once((index, known.known()))) {
            self.region = Some(self.region.map_or(part, |region| region.union(&part)));
            self.blocks.push(index);
            self.uses.push(uses);
            self.used += 1;
        }
    }

    fn add_record(&mut self, stamp: Stamp, number: u32, block: &StateBlock) {
        self.record_bytes += self.parts.entry(stamp).or_default().push(number, block);
        self.voxels += block.known_count() as usize;
        self.part_blocks += 1;
    }

    /// The newest stamp.
    pub(crate) fn newest(&self) -> Option<Stamp> {
        self.parts.last_key_value().map(|(stamp, _)| *stamp)
    }

    /// Whether there is more than one stamp.
    pub(crate) fn has_newer(&self) -> bool {
        self.parts.len() > 1
    }

    /// Lets go of what has the newest stamp. O(voxels of it).
    pub(crate) fn drop_newest(&mut self) -> Option<Stamp> {
        let (stamp, part) = self.parts.pop_last()?;
        self.record_bytes -= part.0.capacity() * size_of::<u16>();
        for (number, voxels) in part.counts() {
            self.voxels -= voxels;
            self.part_blocks -= 1;
            if let Some(uses) = self.uses.get_mut(number as usize) {
                *uses -= 1;
                self.used -= usize::from(*uses == 0);
            }
        }
        Some(stamp)
    }

    /// Keeps those of these sensors that are of its stamps. O(stamps + sensors).
    pub(crate) fn set_sensors(&mut self, sensors: &BTreeMap<Stamp, [i32; 3]>) {
        let is_of_part = |(stamp, _): &(&Stamp, &[i32; 3])| self.parts.contains_key(*stamp);
        self.sensors = sensors.iter().filter(is_of_part).map(|(stamp, at)| (*stamp, *at)).collect();
    }

    /// `None` if it says nothing, or not all.
    pub(crate) fn complete(self) -> Option<Self> {
        (self.region.is_some() && !self.is_too_large).then_some(self)
    }

    /// Of a state that keeps the rules of [`Snapshot`]. `None` if it has more than 2³² blocks.
    pub fn from_state(state: &Snapshot) -> Option<Self> {
        let mut all = Self { region: Some(state.region), sensors: state.sensors.clone(), ..Self::default() };
        let mut numbers = rustc_hash::FxHashMap::<BlockIndex, u32>::default();
        for (stamp, part) in &state.parts {
            for (index, block) in part.blocks() {
                let next = u32::try_from(all.blocks.len()).ok()?;
                let number = *numbers.entry(*index).or_insert_with(|| {
                    all.blocks.push(*index);
                    all.uses.push(0);
                    next
                });
                all.add_record(*stamp, number, block);
                if let Some(uses) = all.uses.get_mut(number as usize) {
                    *uses += 1;
                }
            }
        }
        all.used = all.blocks.len();
        Some(all)
    }

    /// The box that this speaks of.
    pub fn region(&self) -> VoxelBox {
        // Whoever makes one sees to it that there is one.
        self.region.unwrap_or_else(|| BlockIndex::new(0, 0, 0).voxel_box())
    }

    /// Number of known voxels.
    pub const fn len(&self) -> usize {
        self.voxels
    }

    /// Whether nothing is known.
    pub const fn is_empty(&self) -> bool {
        self.voxels == 0
    }

    /// As [`Snapshot::sensors`].
    pub fn sensors(&self) -> &[(Stamp, [i32; 3])] {
        &self.sensors
    }

    /// The parts of the [`Snapshot`], each made when it is asked for.
    pub fn parts(&self) -> impl Iterator<Item = (Stamp, Changes)> + '_ {
        self.parts.iter().map(|(stamp, part)| (*stamp, self.part(part)))
    }

    /// The first part, or the next one after this stamp. O(voxels of the part, log stamps).
    pub fn part_after(&self, stamp: Option<Stamp>) -> Option<(Stamp, Changes)> {
        self.records_after(stamp).map(|(stamp, part)| (stamp, self.part(part)))
    }

    fn records_after(&self, stamp: Option<Stamp>) -> Option<(Stamp, &Records)> {
        use core::ops::Bound::{Excluded, Unbounded};
        let from = stamp.map_or(Unbounded, Excluded);
        self.parts.range((from, Unbounded)).next().map(|(stamp, part)| (*stamp, part))
    }

    fn part(&self, part: &Records) -> Changes {
        let block = |number: u32| self.blocks.get(number as usize).copied();
        let blocks = part.iter().filter_map(|(number, states)| Some((block(number)?, states)));
        Changes::from_blocks(blocks.collect())
    }

    /// The parts again, of one run of blocks after the other: so many that they have `voxels_max` voxels or
    /// one block. Takes as much once more.
    pub fn runs(&self, voxels_max: usize) -> impl Iterator<Item = Vec<(Stamp, Changes)>> + '_ {
        let mut runs = BlockRuns::default();
        while runs.take_in(self).is_some() {}
        core::iter::from_fn(move || runs.next_run(voxels_max))
    }

    /// Blocks with known voxels.
    pub const fn block_count(&self) -> usize {
        self.used
    }

    /// Blocks of all parts, counted together.
    pub const fn part_blocks(&self) -> usize {
        self.part_blocks
    }

    /// Bytes that it holds, about. O(1).
    pub fn memory_bytes(&self) -> usize {
        let block_bytes = size_of::<BlockIndex>() + size_of::<u32>();
        self.blocks.capacity() * block_bytes + self.record_bytes + self.parts.len() * PART_BYTES
    }

    /// The same with all parts made.
    pub fn to_state(&self) -> Snapshot {
        Snapshot { region: self.region(), parts: self.parts().collect(), sensors: self.sensors.clone() }
    }
}

/// What [`SnapshotVoxels`] say, block by block in ascending order in place of stamp by stamp.
#[derive(Debug, Default)]
pub struct BlockRuns {
    /// Ascending; those of which something was taken in.
    stamps: Vec<Stamp>,
    /// What each stamp says of a block, by its place in `stamps`.
    blocks: BTreeMap<BlockIndex, Records>,
}

impl BlockRuns {
    /// Takes in the part after those that were taken in before. Returns its stamp and what it says; `None` if there
    /// are no more. O(voxels of the part).
    pub fn take_in(&mut self, state: &SnapshotVoxels) -> Option<(Stamp, Changes)> {
        let (stamp, part) = state.part_after(self.stamps.last().copied())?;
        let number = self.stamps.len() as u32;
        for (index, block) in part.blocks() {
            self.blocks.entry(*index).or_default().push(number, block);
        }
        self.stamps.push(stamp);
        Some((stamp, part))
    }

    /// The parts of the next blocks, and lets go of them: of as many as have `voxels_max` voxels together, or of one.
    /// `None` if all are gone. After all parts are taken in.
    pub fn next_run(&mut self, voxels_max: usize) -> Option<Vec<(Stamp, Changes)>> {
        let mut run = BTreeMap::<u32, Vec<(BlockIndex, StateBlock)>>::new();
        let mut voxels = 0;
        while let Some(first) = self.blocks.first_entry() {
            voxels += first.get().iter().map(|(_, block)| block.known_count() as usize).sum::<usize>();
            if voxels > voxels_max && !run.is_empty() {
                break;
            }
            let (index, records) = first.remove_entry();
            records.iter().for_each(|(number, block)| run.entry(number).or_default().push((index, block)));
        }
        let parts = run.into_iter().filter_map(|(number, blocks)| {
            Some((*self.stamps.get(number as usize)?, Changes::from_blocks(blocks)))
        });
        let parts: Vec<_> = parts.collect();
        (!parts.is_empty()).then_some(parts)
    }
}
