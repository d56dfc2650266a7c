//! What is known from one origin.

mod block;
mod cold;
mod cube;
mod discarded;
mod dropped;
mod dropping;
mod memory;
mod packed;
mod packing;
mod sensors;
mod snapshots;
mod stamps;
mod sweep;

use std::borrow::Cow;
use std::collections::VecDeque;
use std::sync::Arc;

use rustc_hash::FxHashMap;

use crate::block::set_bits;
use crate::unpacked::{Packed, Unpacked};
use crate::{BlockIndex, Changes, Plane, Snapshot, Stamp, State, StateBlock, Voxel, voxel_bit};
use block::LayerBlock;
use cube::Cube;
pub(crate) use cube::{cube_of, first_of};
pub use discarded::DiscardedLayer;
use dropped::Dropped;
pub(crate) use dropping::is_kept;
pub use memory::LAYER_BLOCK_BYTES_MAX;
pub(crate) use packed::PackedCube;
pub(crate) use sensors::SENSOR_BYTES;
use sensors::Sensors;
pub use snapshots::SnapshotReader;

/// State and stamp of every voxel that one stream has published, in the frame of its origin.
///
/// Every voxel keeps the state with the newest stamp (Sec. IV-C of the paper). So packages may be applied in any
/// order and any number of times, and every robot that has applied the same ones holds the same layer.
///
/// Blocks lie in cubes of 4³. A cube that nothing was applied to for a while is packed, to a tenth of a byte or two
/// for each voxel of a scanned place, its stamp included; it is unpacked when it is read or something is applied to
/// it. A copy of a layer shares all cubes until one of the two changes them: it takes O(cubes).
#[derive(Clone, Debug, Default)]
pub struct Layer {
    cubes: FxHashMap<BlockIndex, Place>,
    newest: Option<Stamp>,
    blocks: usize,
    voxels: usize,
    /// Of cubes that are open, and how many bytes these take on the heap.
    open: usize,
    open_bytes: usize,
    packed_bytes: usize,
    /// Each open cube once, with a value that its `touched` had: those first to which nothing was applied for longest,
    /// nearly.
    queue: VecDeque<(u64, BlockIndex)>,
    /// How often blocks were changed.
    changed: u64,
    unpacked: Arc<Unpacked<PackedCube>>,
    sensors: Sensors,
    dropped: Dropped,
    /// Voxels that were ignored, since something newer may have been dropped.
    ignored: u64,
    /// [`Self::bytes_left_in_copies`].
    left_in_copies: u64,
}

/// A cube of blocks where it lies. Copies of a layer share it until one of them changes it.
#[derive(Clone, Debug)]
enum Place {
    Open(Arc<Open>),
    Packed(Arc<PackedCube>),
}

#[derive(Clone, Debug, Default)]
struct Open {
    cube: Cube,
    /// [`Layer::changed`] when something was applied to it last.
    touched: u64,
}

/// By what something comes that is taken over.
#[derive(Clone, Copy, PartialEq, Eq)]
enum By {
    /// A batch: what was there before remains known.
    Batch,
    Snapshot,
    /// A snapshot that brings back what was dropped.
    Rest,
}

/// An open cube beside its blocks, and the two counts of who shares it.
const OPEN_BYTES: usize = size_of::<Open>() + 2 * size_of::<usize>();

/// A later batch has changed a block already, or a snapshot has: what it was before is not known any more.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
#[error("block {block:?} holds states as new as {newest:?}: what was known before {stamp:?} is gone")]
pub struct BaseSuperseded {
    /// The block.
    pub block: BlockIndex,
    /// Newest stamp in it.
    pub newest: Stamp,
    /// What was asked for: the states before this.
    pub stamp: Stamp,
}

impl Layer {
    /// Nothing is known. `unpacked` are cubes that were unpacked to be read, of other layers too.
    pub(crate) fn new(unpacked: &Arc<Unpacked<PackedCube>>) -> Self {
        Self { unpacked: Arc::clone(unpacked), ..Self::default() }
    }

    /// Takes over each change that is newer than what is known of its voxel. At equal stamps the known one
    /// stays, unless the new one is Occupied. Returns the blocks and voxels that it took over. O(changes).
    pub fn apply(&mut self, changes: &Changes, stamp: Stamp) -> Vec<(BlockIndex, Plane)> {
        let taken = self.take_over(changes, stamp, By::Batch);
        self.note_changed(changes.blocks().len());
        taken
    }

    /// The same for every voxel of a snapshot, each with its own stamp. Returns the blocks and voxels that it
    /// took over, a block once for each stamp. O(voxels).
    pub fn apply_snapshot(&mut self, state: &Snapshot) -> Vec<(BlockIndex, Plane)> {
        self.take_over_snapshot(state, By::Snapshot)
    }

    /// The same for a snapshot of as many packages as anything is lacking of, or more: what it says comes back also
    /// where something was dropped.
    pub(crate) fn apply_rest(&mut self, state: &Snapshot) -> Vec<(BlockIndex, Plane)> {
        self.take_over_snapshot(state, By::Rest)
    }

    /// How many voxels were ignored so far, since something newer may have been dropped.
    pub(crate) const fn ignored(&self) -> u64 {
        self.ignored
    }

    fn take_over_snapshot(&mut self, state: &Snapshot, by: By) -> Vec<(BlockIndex, Plane)> {
        let taken = state.parts.iter().flat_map(|(stamp, part)| self.take_over(part, *stamp, by)).collect();
        // After the voxels: the sensor of a batch of which nothing stands may be forgotten at once.
        self.note_sensors(&state.sensors);
        self.note_changed(state.parts.iter().map(|(_, part)| part.blocks().len()).sum());
        taken
    }

    fn take_over(&mut self, changes: &Changes, stamp: Stamp, by: By) -> Vec<(BlockIndex, Plane)> {
        let mut taken = Vec::with_capacity(changes.blocks().len());
        self.sensors.note_stamp(stamp);
        for (index, new) in changes.blocks() {
            let mut new = Cow::Borrowed(new);
            if by != By::Rest
                && self.limit_of(cube_of(*index)).is_some_and(|limit| stamp <= limit)
                && !flockmap_mutation::is(flockmap_mutation::Mutation::LateTakenOver)
            {
                // Where a voxel is known, nothing newer was dropped.
                let known = self.block(*index).map_or([0; 8], |states| states.known());
                let left = new.masked(&known);
                self.ignored += u64::from(new.known_count() - left.known_count());
                if left.is_empty() {
                    continue;
                }
                new = Cow::Owned(left);
            }
            let changed = self.changed;
            let open = self.open(cube_of(*index));
            open.touched = changed;
            let (list, blocks) = (open.cube.list_bytes(), open.cube.len());
            let block = open.cube.entry(*index, stamp);
            let (stamps, known) = (block.stamps.memory_bytes(), block.states.known_count() as usize);
            let mask = block.take_over(&new, stamp, by == By::Batch);
            let grown = block.stamps.memory_bytes();
            // Nothing ever becomes Unknown.
            let new_voxels = block.states.known_count() as usize - known;
            let (list_grown, blocks_grown) = (open.cube.list_bytes(), open.cube.len());
            // The stamps of a block that is new count from nothing.
            let before = if blocks_grown > blocks { 0 } else { stamps };
            self.open_bytes = self.open_bytes + list_grown - list + grown - before;
            self.blocks += blocks_grown - blocks;
            self.voxels += new_voxels;
            self.open += blocks_grown - blocks;
            if mask != [0; 8] {
                taken.push((*index, mask));
            }
        }
        self.newest = self.newest.max((!changes.is_empty()).then_some(stamp));
        taken
    }

    /// State of a voxel. A cube that is packed is unpacked for it: some 15 µs for each of its blocks, if it was not
    /// read just before.
    pub fn state(&self, voxel: Voxel) -> State {
        self.get(voxel).map_or(State::Unknown, |(state, _)| state)
    }

    /// State of a voxel and when it was set. `None` if it is Unknown. Cost as of [`Self::state`].
    pub fn get(&self, voxel: Voxel) -> Option<(State, Stamp)> {
        self.with_block(voxel.block(), |block| block.get(voxel_bit(voxel))).flatten()
    }

    /// The states of a block, `None` if nothing in it is known. Cost as of [`Self::state`].
    pub fn block(&self, index: BlockIndex) -> Option<StateBlock> {
        self.with_block(index, |block| block.states)
    }

    /// The newest stamp of a block. Cost as of [`Self::state`].
    pub(crate) fn newest_of(&self, index: BlockIndex) -> Option<Stamp> {
        self.with_block(index, |block| block.stamps.newest())
    }

    /// The states of blocks of which something is known, with their numbers in the list. What follows each other in a
    /// cube is looked up once.
    pub(crate) fn blocks_at<'a>(
        &'a self,
        indices: impl Iterator<Item = BlockIndex> + 'a,
    ) -> impl Iterator<Item = (usize, StateBlock)> + 'a {
        let mut last = None;
        indices.enumerate().filter_map(move |(number, index)| {
            let at = cube_of(index);
            let place = match last {
                Some((cube, place)) if cube == at => place,
                _ => self.cubes.get(&at),
            };
            last = Some((at, place));
            Some((number, self.with_block_in(place?, index, |block| block.states)?))
        })
    }

    /// Reads a block that is there.
    fn with_block<T>(&self, index: BlockIndex, read: impl FnOnce(&LayerBlock) -> T) -> Option<T> {
        self.with_block_in(self.cubes.get(&cube_of(index))?, index, read)
    }

    fn with_block_in<T>(
        &self,
        place: &Place,
        index: BlockIndex,
        read: impl FnOnce(&LayerBlock) -> T,
    ) -> Option<T> {
        match place {
            Place::Open(open) => open.cube.block(index).map(read),
            Place::Packed(packed) if packed.has(index) => self.unpacked.read(packed).block(index).map(read),
            Place::Packed(_) => None,
        }
    }

    /// All cubes with their places in the table, unpacked one by one.
    fn cubes(&self) -> impl Iterator<Item = (BlockIndex, Cow<'_, Cube>)> {
        self.cubes.iter().map(|(at, place)| (*at, place.read()))
    }

    /// The states of a block as they were before the batch that ended at `stamp`, whether packages of that
    /// batch have been applied meanwhile or not; `None` if nothing was known. This is what packages of the
    /// batch are coded against.
    ///
    /// # Errors
    /// [`BaseSuperseded`] if something newer has been applied to the block, or a snapshot that says more of
    /// it than was known, or if something of it may have been dropped.
    pub fn block_before(
        &self,
        index: BlockIndex,
        stamp: Stamp,
    ) -> Result<Option<StateBlock>, BaseSuperseded> {
        Ok(self.known_before(index, stamp)?.map(|(states, _)| states))
    }

    /// As [`Self::block_before`], with the newest stamp in the block as it is now: at most `stamp`.
    ///
    /// # Errors
    /// [`BaseSuperseded`], as there.
    pub fn known_before(
        &self,
        index: BlockIndex,
        stamp: Stamp,
    ) -> Result<Option<(StateBlock, Stamp)>, BaseSuperseded> {
        if let Some(limit) = self.limit_of(cube_of(index)) {
            // What was known may be gone.
            return Err(BaseSuperseded { block: index, newest: limit, stamp });
        }
        let known = self.with_block(index, |block| block.known_before(stamp)).transpose();
        known.map_err(|newest| BaseSuperseded { block: index, newest, stamp })
    }

    /// All blocks, in no order. Packed cubes are unpacked one by one.
    pub fn blocks(&self) -> impl Iterator<Item = (BlockIndex, StateBlock)> {
        self.cubes().flat_map(|(at, cube)| {
            let blocks = cube.blocks(at).map(|(index, block)| (index, block.states));
            blocks.collect::<Vec<_>>()
        })
    }

    /// The indices of all cubes, in no order. O(cubes).
    pub(crate) fn cube_indices(&self) -> impl Iterator<Item = BlockIndex> {
        self.cubes.keys().copied()
    }

    /// The blocks of a cube with what of them is known. Cost as of [`Self::state`].
    pub(crate) fn known_in_cube(&self, at: BlockIndex) -> Vec<(BlockIndex, Plane)> {
        let known =
            |cube: &Cube| cube.blocks(at).map(|(index, block)| (index, block.states.known())).collect();
        match self.cubes.get(&at) {
            None => Vec::new(),
            Some(Place::Open(open)) => known(&open.cube),
            Some(Place::Packed(packed)) => known(&self.unpacked.read(packed)),
        }
    }

    /// Every known voxel with its state, block by block in ascending order. O(n log n) in blocks.
    pub fn voxels(&self) -> impl Iterator<Item = (Voxel, State)> {
        Changes::from_blocks(self.blocks().collect()).into_voxels()
    }

    /// Number of known voxels. O(1).
    pub const fn len(&self) -> usize {
        self.voxels
    }

    /// Whether nothing is known.
    pub const fn is_empty(&self) -> bool {
        self.blocks == 0
    }

    /// Number of blocks.
    pub const fn block_count(&self) -> usize {
        self.blocks
    }

    /// Number of blocks that are packed.
    pub const fn packed_count(&self) -> usize {
        self.blocks - self.open
    }

    /// The newest stamp applied.
    pub const fn newest(&self) -> Option<Stamp> {
        self.newest
    }

    /// A number that is equal for layers with equal states and stamps, on every machine, and (very likely)
    /// different for others. O(voxels).
    pub fn digest(&self) -> u64 {
        // A sum does not depend on the order of the blocks.
        let blocks = self.cubes().flat_map(|(at, cube)| cube.blocks(at).map(hash_of).collect::<Vec<_>>());
        blocks.fold(0, u64::wrapping_add)
    }
}

/// Of a block with its states and stamps.
fn hash_of((index, block): (BlockIndex, &LayerBlock)) -> u64 {
    let mut hash = mix(0x666c_6f63_6b6d_6170, (index.x as u32 as u64) << 32 | index.y as u32 as u64);
    hash = mix(hash, index.z as u32 as u64);
    for word in block.states.free().iter().chain(block.states.occupied()) {
        hash = mix(hash, *word);
    }
    for bit in set_bits(&block.states.known()) {
        hash = mix(hash, block.stamps.get(bit).0 as u64);
    }
    hash
}

impl Place {
    /// The cube to be read, unpacked if need be.
    fn read(&self) -> Cow<'_, Cube> {
        match self {
            Self::Open(open) => Cow::Borrowed(&open.cube),
            Self::Packed(packed) => Cow::Owned(packed.unpack()),
        }
    }

    /// The newest stamp of all blocks.
    fn newest(&self) -> Option<Stamp> {
        match self {
            Self::Open(open) => open.cube.parts().iter().map(|block| block.stamps.newest()).max(),
            Self::Packed(packed) => Some(packed.newest()),
        }
    }

    /// Bytes that copies of the layer keep of it when it leaves the layer, or is changed there; 0 if there is none.
    fn bytes_in_copies(&self) -> u64 {
        let bytes = match self {
            Self::Open(open) if Arc::strong_count(open) > 1 => OPEN_BYTES + open.cube.memory_bytes(),
            Self::Packed(packed) if Arc::strong_count(packed) > 1 => packed.memory_bytes(),
            _ => 0,
        };
        bytes as u64
    }

    /// No voxel is older. O(blocks) of what is open.
    fn oldest(&self) -> Stamp {
        match self {
            Self::Open(open) => {
                let blocks = open.cube.parts().iter();
                blocks.map(|block| block.stamps.oldest()).min().unwrap_or_default()
            }
            Self::Packed(packed) => packed.oldest(),
        }
    }
}

/// SplitMix64's finaliser over the sum of both.
fn mix(hash: u64, word: u64) -> u64 {
    let mut z = hash.rotate_left(23) ^ word.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests;
