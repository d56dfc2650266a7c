//! The fused map as a planner reads it.

mod packed;
mod rays;
mod regions;
mod staging;

use std::sync::Arc;

use super::region::{indices, region_of};
use crate::changes::bounding_box;
use crate::unpacked::Unpacked;
use crate::{BlockIndex, Changes, Plane, Resolution, State, StateBlock, Voxel, VoxelBox, voxel_bit};
use packed::PackedRegion;
use regions::{Place, REGION_BLOCK_BYTES_MAX, Reading, Regions};

/// The fused map at one moment. Made by [`super::Fusion::view`] in O(1); stays as it is while the map goes
/// on. The next write after a view was made copies the touched regions of 64³ voxels, at most 80 kB each.
///
/// A region to which nothing was written for long is packed, to a quarter of the bytes or less. What is packed is the same
/// to the bit, and is unpacked when it is read or written to: some 7 µs for each of its blocks, if it was not read just
/// before. The map and all its views share what was unpacked last. Who reads a box block by block asks for the map with
/// that box open ([`Self::open_in`]).
///
/// A map of a robot is written to by its fusion alone. Who gets states from somewhere else makes a view of
/// its own:
///
/// ```
/// use flockmap_grid::{BlockIndex, MapView, Resolution, State, StateBlock, Voxel};
///
/// let mut map = MapView::new(Resolution::from_metres(0.1).unwrap());
/// let mut block = StateBlock::default();
/// block.set(0, State::Occupied);
/// map.set_block(BlockIndex::new(1, 0, 0), &block);
/// let view = map.clone(); // O(1)
/// assert_eq!(view.state(Voxel::new(8, 0, 0)), State::Occupied);
/// assert_eq!(view.changed_since(0), Some(vec![BlockIndex::new(1, 0, 0)]));
/// ```
#[derive(Clone, Debug)]
pub struct MapView {
    resolution: Resolution,
    regions: Arc<Regions>,
    unpacked: Arc<Unpacked<PackedRegion>>,
    blocks: usize,
    /// Blocks in which something was known. They are kept so that [`Self::changed_since`] can name them.
    emptied: usize,
    version: u64,
    /// Since this version every block that was emptied is among those kept.
    emptied_since: u64,
}

/// The most that a block takes.
pub(super) const VIEW_BLOCK_BYTES: usize = REGION_BLOCK_BYTES_MAX;

/// Of all blocks, at most this part are kept that were emptied.
const EMPTIED_PART: usize = 8;

/// Where a ray through the map ended, see [`MapView::cast_ray`].
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum RayEnd {
    /// It met an Occupied voxel.
    Occupied {
        /// The voxel.
        voxel: Voxel,
        /// Metres from the start to where the ray enters the voxel.
        distance_m: f64,
    },
    /// It met an Unknown voxel.
    Unknown {
        /// The voxel.
        voxel: Voxel,
        /// Metres from the start to where the ray enters the voxel.
        distance_m: f64,
    },
    /// It reached its end.
    Clear,
}

impl MapView {
    /// A map of which nothing is known, at version 0.
    pub fn new(resolution: Resolution) -> Self {
        Self {
            resolution,
            regions: Arc::default(),
            unpacked: Arc::default(),
            blocks: 0,
            emptied: 0,
            version: 0,
            emptied_since: 0,
        }
    }

    /// Side of a voxel.
    pub const fn resolution(&self) -> Resolution {
        self.resolution
    }

    /// Goes up with every change of the map.
    pub const fn version(&self) -> u64 {
        self.version
    }

    /// Bytes that the map holds, as asked of the allocator. O(1). Views share them; a view that is kept while the map goes
    /// on takes as much again at most, with what of it was open when it was made. What was unpacked to be read comes on
    /// top: [`UNPACKED_BYTES_MAX`](crate::UNPACKED_BYTES_MAX) at most.
    pub fn memory_bytes(&self) -> usize {
        self.regions.memory_bytes()
    }

    /// State of a voxel. One hash look-up where the map is open.
    pub fn state(&self, voxel: Voxel) -> State {
        self.with_block(voxel.block(), |block| block.get(voxel_bit(voxel))).unwrap_or(State::Unknown)
    }

    /// State at a point in metres, in the frame of this robot's map. Unknown where there are no voxels.
    pub fn state_at(&self, point: [f64; 3]) -> State {
        self.resolution.voxel_at(point).map_or(State::Unknown, |voxel| self.state(voxel))
    }

    /// States of a block, `None` if nothing in it is known.
    pub fn block(&self, index: BlockIndex) -> Option<StateBlock> {
        self.with_block(index, |block| *block).filter(|block| !block.is_empty())
    }

    /// States of blocks, in their order; of those of which nothing is known, none are. A region that is packed is unpacked
    /// once.
    pub fn states_of(&self, indices: &[BlockIndex]) -> Vec<StateBlock> {
        let mut order: Vec<usize> = (0..indices.len()).collect();
        order.sort_unstable_by_key(|at| region_of(indices[*at]));
        let mut states = vec![StateBlock::default(); indices.len()];
        for of_region in order.chunk_by(|a, b| region_of(indices[*a]) == region_of(indices[*b])) {
            let region = self.region(region_of(indices[of_region[0]]));
            for at in of_region {
                let block = region.as_ref().and_then(|region| region.block(indices[*at]));
                states[*at] = block.copied().unwrap_or_default();
            }
        }
        states
    }

    /// All blocks in which something is known, in no order.
    pub fn blocks(&self) -> impl Iterator<Item = (BlockIndex, StateBlock)> {
        let all = self.regions.iter().flat_map(|(at, place)| {
            // Not kept: who reads all of a map would have what others read forgotten.
            let region = place.read_once(&self.unpacked);
            indices(at, region.places())
                .enumerate()
                .map(move |(rank, index)| (index, region.parts()[rank].states))
        });
        all.filter(|(_, states)| !states.is_empty())
    }

    /// The blocks that share voxels with a box and in which something is known, in no order. O(blocks of the box,
    /// or of the regions of 64³ voxels that it meets, whichever are fewer): for a box that is larger than the map
    /// as for the map.
    pub fn blocks_in(&self, region: &VoxelBox) -> impl Iterator<Item = (BlockIndex, StateBlock)> + use<'_> {
        let [low, high] = [region.min().block(), region.max().block()];
        let blocks = self.regions_between(low, high).into_iter().flat_map(move |(at, place)| {
            let region = place.read(&self.unpacked);
            region.ranks_between(at, low, high).map(move |(rank, index)| (index, region.parts()[rank].states))
        });
        blocks.filter(|(_, states)| !states.is_empty())
    }

    /// Calls `found` with the same blocks, where they lie: for who has much to read.
    pub fn for_each_in(&self, region: &VoxelBox, mut found: impl FnMut(BlockIndex, &StateBlock)) {
        let [low, high] = [region.min().block(), region.max().block()];
        for (at, place) in self.regions_between(low, high) {
            let region = place.read(&self.unpacked);
            for (rank, index) in region.ranks_between(at, low, high) {
                let states = &region.parts()[rank].states;
                if !states.is_empty() {
                    found(index, states);
                }
            }
        }
    }

    /// The same map with nothing packed that shares voxels with a box, for who reads that block by block. O(1) if
    /// nothing is packed there, else O(regions of 64³ voxels, blocks of the box).
    pub fn open_in(&self, region: &VoxelBox) -> Self {
        let places = self.regions_between(region.min().block(), region.max().block());
        let packed = places.into_iter().filter(|(_, place)| matches!(place, Place::Packed(_)));
        let opened: Vec<_> = packed.map(|(at, place)| (at, place.opened(&self.unpacked))).collect();
        let mut map = self.clone();
        if !opened.is_empty() {
            Arc::make_mut(&mut map.regions).replace(opened);
        }
        map
    }

    /// The smallest box that holds every known voxel; `None` if there is none. O(blocks that are not packed, regions of
    /// 64³ voxels that are).
    pub fn bounding_box(&self) -> Option<VoxelBox> {
        let boxes = self.regions.iter().filter_map(|(at, place)| match place {
            Place::Open { region, .. } => {
                let blocks = indices(at, region.places()).zip(region.parts());
                bounding_box(blocks.map(|(index, block)| (index, block.states.known())))
            }
            Place::Packed(packed) => packed.bounding_box(),
        });
        boxes.reduce(|a, b| a.union(&b))
    }

    /// Number of blocks in which something is known. O(1).
    pub const fn block_count(&self) -> usize {
        self.blocks - self.emptied
    }

    /// Number of blocks that are packed. O(1).
    pub fn packed_count(&self) -> usize {
        self.blocks - self.regions.open_count()
    }

    /// Packs all that is open. O(open blocks).
    pub fn pack(&mut self) {
        Arc::make_mut(&mut self.regions).pack();
    }

    /// Every known voxel of a box with its state, in ascending order of blocks. Cost as of [`Self::blocks_in`].
    pub fn voxels_in(&self, region: &VoxelBox) -> impl Iterator<Item = (Voxel, State)> + use<> {
        let blocks = self.blocks_in(region).collect();
        Changes::from_blocks(blocks).within(region).into_voxels()
    }

    /// Every known voxel with its state, in ascending order of blocks.
    pub fn voxels(&self) -> impl Iterator<Item = (Voxel, State)> + use<> {
        Changes::from_blocks(self.blocks().collect()).into_voxels()
    }

    /// Number of Free and of Occupied voxels. O(blocks that are not packed, regions of 64³ voxels that are).
    pub fn count(&self) -> (usize, usize) {
        let ones = |plane: &Plane| plane.iter().map(|w| w.count_ones() as usize).sum::<usize>();
        self.regions.iter().fold((0, 0), |(free, occupied), (_, place)| match place {
            Place::Open { region, .. } => region
                .parts()
                .iter()
                .map(|block| &block.states)
                .fold((free, occupied), |(free, occupied), b| {
                    (free + ones(b.free()), occupied + ones(b.occupied()))
                }),
            Place::Packed(packed) => {
                let [more_free, more_occupied] = packed.counts().map(|count| count as usize);
                (free + more_free, occupied + more_occupied)
            }
        })
    }

    /// Blocks that changed after [`Self::version`] had this value, ascending; those of which nothing is known
    /// any more too. `None` if that is not known any more: then everything may have changed. It is known for
    /// as long as few blocks were emptied (an alignment changed, an origin was muted, the mapper had no room):
    /// up to an eighth of all. O(regions of 64³ voxels, and blocks of those that changed); nothing is unpacked.
    pub fn changed_since(&self, version: u64) -> Option<Vec<BlockIndex>> {
        let mut changed: Vec<BlockIndex> = self.versions_since(version)?.map(|(index, _)| index).collect();
        changed.sort_unstable();
        Some(changed)
    }

    /// The same in no order, with the version at which each block changed last. Who takes them over in
    /// ascending order of versions, as many at a time as it likes, has the map as it was at the newest version
    /// but for what changed later.
    pub fn versions_since(&self, version: u64) -> Option<impl Iterator<Item = (BlockIndex, u64)> + '_> {
        self.versions_since_beginning(version, version)
    }

    /// The same for one that began with nothing when the map was at version `began`, and has since taken over
    /// what changed up to `version`, 0 at first: of blocks that were emptied and let go before it began, it has
    /// never heard.
    pub fn versions_since_beginning(
        &self,
        began: u64,
        version: u64,
    ) -> Option<impl Iterator<Item = (BlockIndex, u64)> + '_> {
        let regions = self.regions.iter().filter(move |(_, place)| place.version() > version);
        let blocks = regions.flat_map(|(at, place)| place.versions(at));
        let is_known = began.max(version) >= self.emptied_since;
        is_known.then(|| blocks.filter(move |(_, changed)| *changed > version))
    }

    /// Sets all voxels of a block: what is known, and what is not. O(1), and the copy of a region where a view
    /// of it is alive.
    pub fn set_block(&mut self, index: BlockIndex, states: &StateBlock) {
        self.write(index, &[u64::MAX; 8], states);
        self.forget_emptied();
    }

    /// Sets the voxels of `mask` to those of `states`.
    pub(super) fn write(&mut self, index: BlockIndex, mask: &Plane, states: &StateBlock) {
        self.change(index, |old| {
            let keep: Plane = core::array::from_fn(|z| !mask[z]);
            let mut new = old.masked(&keep);
            new.overlay(&states.masked(mask));
            (new != old).then_some(new)
        });
    }

    /// Changes the states of a block, which counts as changed unless they stay.
    fn change(&mut self, index: BlockIndex, change: impl FnOnce(StateBlock) -> Option<StateBlock>) {
        let regions = Arc::make_mut(&mut self.regions);
        if let Some((before, states)) = regions.write(index, self.version + 1, &self.unpacked, change) {
            self.version += 1;
            self.blocks += usize::from(before.is_none());
            self.emptied += usize::from(states.is_empty());
            self.emptied -= usize::from(before.is_some_and(|before| before.is_empty()));
        }
    }

    /// Lets go of emptied blocks if there are many. O(blocks) then; nothing is unpacked.
    pub(super) fn forget_emptied(&mut self) {
        if self.emptied <= self.blocks / EMPTIED_PART {
            return;
        }
        Arc::make_mut(&mut self.regions).forget_emptied();
        self.blocks -= self.emptied;
        self.emptied = 0;
        self.emptied_since = self.version;
    }

    #[cfg(test)]
    pub(super) fn check_counts(&self) {
        self.regions.check_counts();
    }

    /// A region to be read.
    fn region(&self, at: BlockIndex) -> Option<Reading<'_>> {
        Some(self.regions.get(at)?.read(&self.unpacked))
    }

    /// Reads a block where it lies; `None` if it is not there. Nothing may be known of one that is there.
    #[inline]
    pub fn with_block<T>(&self, index: BlockIndex, read: impl FnOnce(&StateBlock) -> T) -> Option<T> {
        match self.regions.get(region_of(index))? {
            Place::Open { region, .. } => region.block(index).map(read),
            Place::Packed(packed) if packed.is_known(index) => {
                self.unpacked.read(packed).block(index).map(read)
            }
            Place::Packed(_) => None,
        }
    }

    /// The regions of the blocks from `low` to `high`.
    fn regions_between(&self, low: BlockIndex, high: BlockIndex) -> Vec<(BlockIndex, &Place)> {
        let [first, last] = [region_of(low), region_of(high)];
        if count_between(first, last) < self.regions.len() as u128 {
            between(first, last).filter_map(|at| Some((at, self.regions.get(at)?))).collect()
        } else {
            self.regions.iter().filter(|(at, _)| is_between(*at, first, last)).collect()
        }
    }
}

/// The indices from `low` to `high`, z fastest.
fn between(low: BlockIndex, high: BlockIndex) -> impl Iterator<Item = BlockIndex> {
    (low.x..=high.x).flat_map(move |x| {
        (low.y..=high.y).flat_map(move |y| (low.z..=high.z).map(move |z| BlockIndex { x, y, z }))
    })
}

fn count_between(low: BlockIndex, high: BlockIndex) -> u128 {
    [(low.x, high.x), (low.y, high.y), (low.z, high.z)]
        .map(|(low, high)| u128::from(high.abs_diff(low)) + 1)
        .into_iter()
        .product()
}

fn is_between(index: BlockIndex, low: BlockIndex, high: BlockIndex) -> bool {
    (low.x..=high.x).contains(&index.x)
        && (low.y..=high.y).contains(&index.y)
        && (low.z..=high.z).contains(&index.z)
}
