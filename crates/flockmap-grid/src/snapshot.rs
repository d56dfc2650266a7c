//! The state of a region as it is now, in place of the history of its changes.

use crate::block::set_bits;
use crate::{BlockIndex, Changes, Stamp, State, StateBlock, VoxelBox};

/// What a layer holds in a box: every known voxel with its state and the stamp that it got it at.
/// Sent when too many packages are missing ("the current OGM as it is", Sec. IV-B of the paper).
///
/// Voxels of the region that are in no part are Unknown. A part takes 144 bytes for each of its blocks,
/// however few voxels it has there; [`SnapshotVoxels`] says the same of a whole layer in less.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Snapshot {
    /// The box that this speaks of.
    pub region: VoxelBox,
    /// The known voxels, grouped by stamp: stamps ascending, voxel sets disjoint and all inside `region`.
    pub parts: Vec<(Stamp, Changes)>,
    /// From where parts were seen, in sixteenths of a voxel: those of which it is known, stamps ascending. A
    /// codec may make use of it; it is no part of what the state says.
    pub sensors: Vec<(Stamp, [i32; 3])>,
}

/// A [`Snapshot`] in 8 bytes for each voxel, 12 for each block and 28 for each stamp, of which the parts are
/// made one after the other.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct SnapshotVoxels {
    region: VoxelBox,
    /// Ascending.
    stamps: Vec<Stamp>,
    /// Ascending.
    blocks: Vec<BlockIndex>,
    /// Ascending: from the highest bit 27 bits of number of the stamp, 27 bits of number of the block, 9 bits
    /// of place in the block, and whether it is Occupied.
    voxels: Vec<u64>,
    sensors: Vec<(Stamp, [i32; 3])>,
}

const PLACE_SHIFT: u32 = 1;
const BLOCK_SHIFT: u32 = PLACE_SHIFT + 9;
const STAMP_SHIFT: u32 = BLOCK_SHIFT + NUMBER_BITS;
const NUMBER_BITS: u32 = 27;
const NUMBER_MASK: u64 = (1 << NUMBER_BITS) - 1;

impl SnapshotVoxels {
    /// `blocks` and `stamps` ascend; `voxels` gives each known voxel once: number of its stamp, number of its
    /// block, place in the block, state. `None` if there are more than 2²⁷ blocks or stamps.
    pub(crate) fn new(
        region: VoxelBox,
        stamps: Vec<Stamp>,
        blocks: Vec<BlockIndex>,
        voxels_max: usize,
        voxels: impl Iterator<Item = (u32, u32, usize, State)>,
        sensors: Vec<(Stamp, [i32; 3])>,
    ) -> Option<Self> {
        if stamps.len() > 1 << NUMBER_BITS || blocks.len() > 1 << NUMBER_BITS {
            return None;
        }
        let mut all = Vec::with_capacity(voxels_max);
        all.extend(voxels.map(|(stamp, block, place, state)| {
            u64::from(stamp) << STAMP_SHIFT
                | u64::from(block) << BLOCK_SHIFT
                | (place as u64) << PLACE_SHIFT
                | u64::from(state == State::Occupied)
        }));
        // In place: an ordinary sort would hold half of it once more.
        all.sort_unstable();
        Some(Self { region, stamps, blocks, voxels: all, sensors })
    }

    /// Of a state that keeps the rules of [`Snapshot`]. `None` if it has more than 2²⁷ blocks or stamps.
    pub fn from_state(state: &Snapshot) -> Option<Self> {
        let stamps: Vec<Stamp> = state.parts.iter().map(|(stamp, _)| *stamp).collect();
        let all = || state.parts.iter().flat_map(|(_, part)| part.blocks());
        let mut blocks: Vec<BlockIndex> = all().map(|(index, _)| *index).collect();
        blocks.sort_unstable();
        blocks.dedup();
        let count = all().map(|(_, block)| block.known_count() as usize).sum();
        let places_of = blocks.clone();
        let voxels = (0..).zip(&state.parts).flat_map(|(stamp, (_, part))| {
            let places_of = &places_of;
            part.blocks().iter().flat_map(move |(index, block)| {
                let number = places_of.partition_point(|other| other < index) as u32;
                set_bits(&block.known()).map(move |place| (stamp, number, place, block.get(place)))
            })
        });
        Self::new(state.region, stamps, blocks, count, voxels, state.sensors.clone())
    }

    /// The box that this speaks of.
    pub const fn region(&self) -> VoxelBox {
        self.region
    }

    /// Number of known voxels.
    pub fn len(&self) -> usize {
        self.voxels.len()
    }

    /// Whether nothing is known.
    pub fn is_empty(&self) -> bool {
        self.voxels.is_empty()
    }

    /// As [`Snapshot::sensors`].
    pub fn sensors(&self) -> &[(Stamp, [i32; 3])] {
        &self.sensors
    }

    /// The parts of the [`Snapshot`], each made when it is asked for.
    pub fn parts(&self) -> impl Iterator<Item = (Stamp, Changes)> + '_ {
        self.voxels.chunk_by(|a, b| a >> STAMP_SHIFT == b >> STAMP_SHIFT).map(|part| self.part(part))
    }

    /// The parts again, of one run of blocks after the other: so many that they have `voxels_max` voxels or
    /// one block. Takes 8 bytes more for each voxel.
    pub fn runs(&self, voxels_max: usize) -> impl Iterator<Item = Vec<(Stamp, Changes)>> + '_ {
        let in_block_order = |voxel: &u64| voxel & ((1 << STAMP_SHIFT) - 1);
        let mut rest = self.voxels.clone();
        // Backwards, since they are taken from the end.
        rest.sort_unstable_by_key(|voxel| core::cmp::Reverse(in_block_order(voxel)));
        core::iter::from_fn(move || {
            let mut start = rest.len();
            for of_block in rest
                .chunk_by(|a, b| in_block_order(a) >> BLOCK_SHIFT == in_block_order(b) >> BLOCK_SHIFT)
                .rev()
            {
                let is_first = start == rest.len();
                if !is_first && rest.len() - start + of_block.len() > voxels_max {
                    break;
                }
                start -= of_block.len();
            }
            let mut run = rest.split_off(start);
            run.sort_unstable();
            let parts = run.chunk_by(|a, b| a >> STAMP_SHIFT == b >> STAMP_SHIFT);
            (!run.is_empty()).then(|| parts.map(|part| self.part(part)).collect())
        })
    }

    /// What voxels of one stamp say.
    fn part(&self, voxels: &[u64]) -> (Stamp, Changes) {
        let stamp = voxels.first().map_or(0, |voxel| voxel >> STAMP_SHIFT);
        let mut blocks: Vec<(BlockIndex, StateBlock)> = Vec::new();
        for of_block in voxels.chunk_by(|a, b| a >> BLOCK_SHIFT == b >> BLOCK_SHIFT) {
            let mut block = StateBlock::default();
            for voxel in of_block {
                let state = if voxel & 1 == 1 { State::Occupied } else { State::Free };
                block.set((voxel >> PLACE_SHIFT & 511) as usize, state);
            }
            let number = of_block.first().map_or(0, |voxel| voxel >> BLOCK_SHIFT & NUMBER_MASK);
            blocks.push((self.blocks[number as usize], block));
        }
        (self.stamps[stamp as usize], Changes::from_blocks(blocks))
    }

    /// Blocks with known voxels, or more.
    pub fn block_count(&self) -> usize {
        self.blocks.len()
    }

    /// Blocks of all parts, counted together.
    pub fn part_blocks(&self) -> usize {
        self.voxels.chunk_by(|a, b| a >> BLOCK_SHIFT == b >> BLOCK_SHIFT).count()
    }

    /// The same with all parts made.
    pub fn to_state(&self) -> Snapshot {
        Snapshot { region: self.region, parts: self.parts().collect(), sensors: self.sensors.clone() }
    }
}
