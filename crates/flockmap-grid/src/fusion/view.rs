//! The fused map as a planner reads it.

mod staging;

use std::sync::Arc;

use rustc_hash::FxHashMap;

use super::region::{BLOCK_BYTES_MAX, Region, region_of};
use crate::changes::bounding_box;
use crate::memory::table_bytes;
use crate::{BlockIndex, Changes, Plane, Resolution, State, StateBlock, Voxel, VoxelBox, voxel_bit};

/// The fused map at one moment. Made by [`super::Fusion::view`] in O(1); stays as it is while the map goes
/// on. The next write after a view was made copies the touched regions of 64³ voxels, at most 80 kB each.
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
    regions: Arc<FxHashMap<BlockIndex, Arc<Region>>>,
    /// Of all regions.
    region_bytes: usize,
    blocks: usize,
    /// Blocks in which something was known. They are kept so that [`Self::changed_since`] can name them.
    emptied: usize,
    version: u64,
    /// Since this version every block that was emptied is among those kept.
    emptied_since: u64,
}

/// The most that a block takes: it is alone in its region, and the table of regions is filled to 7/16.
pub(super) const VIEW_BLOCK_BYTES: usize =
    BLOCK_BYTES_MAX + (size_of::<(BlockIndex, Arc<Region>)>() + 1) * 16 / 7;

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
            region_bytes: 0,
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

    /// Bytes that the map holds, as asked of the allocator. O(1). Views share them; a view that is kept while
    /// the map goes on takes as much again at most.
    pub fn memory_bytes(&self) -> usize {
        self.region_bytes + table_bytes(self.regions.len(), size_of::<(BlockIndex, Arc<Region>)>())
    }

    /// State of a voxel. One hash look-up.
    pub fn state(&self, voxel: Voxel) -> State {
        self.block(voxel.block()).map_or(State::Unknown, |block| block.get(voxel_bit(voxel)))
    }

    /// State at a point in metres, in the frame of this robot's map. Unknown where there are no voxels.
    pub fn state_at(&self, point: [f64; 3]) -> State {
        self.resolution.voxel_at(point).map_or(State::Unknown, |voxel| self.state(voxel))
    }

    /// States of a block, `None` if nothing in it is known.
    pub fn block(&self, index: BlockIndex) -> Option<&StateBlock> {
        let block = self.regions.get(&region_of(index))?.block(index)?;
        (!block.is_empty()).then_some(block)
    }

    /// All blocks in which something is known, in no order.
    pub fn blocks(&self) -> impl Iterator<Item = (BlockIndex, &StateBlock)> {
        let all = self.regions.iter().flat_map(|(at, region)| region.blocks(*at));
        all.map(|(index, block)| (index, &block.states)).filter(|(_, states)| !states.is_empty())
    }

    /// The blocks that share voxels with a box and in which something is known, in no order. O(blocks of the box,
    /// or of the regions of 64³ voxels that it meets, whichever are fewer): for a box that is larger than the map
    /// as for the map.
    pub fn blocks_in(&self, region: &VoxelBox) -> impl Iterator<Item = (BlockIndex, &StateBlock)> + use<'_> {
        let [low, high] = [region.min().block(), region.max().block()];
        let [first, last] = [region_of(low), region_of(high)];
        let regions: Vec<(BlockIndex, &Region)> = if count_between(first, last) < self.regions.len() as u128 {
            between(first, last).filter_map(|at| Some((at, self.regions.get(&at)?.as_ref()))).collect()
        } else {
            let all = self.regions.iter().map(|(at, region)| (*at, region.as_ref()));
            all.filter(|(at, _)| is_between(*at, first, last)).collect()
        };
        let blocks = regions.into_iter().flat_map(move |(at, region)| region.blocks_between(at, low, high));
        blocks.filter(|(_, states)| !states.is_empty())
    }

    /// The smallest box that holds every known voxel; `None` if there is none. O(blocks).
    pub fn bounding_box(&self) -> Option<VoxelBox> {
        bounding_box(self.blocks())
    }

    /// Number of blocks in which something is known. O(1).
    pub const fn block_count(&self) -> usize {
        self.blocks - self.emptied
    }

    /// Every known voxel of a box with its state, in ascending order of blocks. Cost as of [`Self::blocks_in`].
    pub fn voxels_in(&self, region: &VoxelBox) -> impl Iterator<Item = (Voxel, State)> + use<> {
        let blocks = self.blocks_in(region).map(|(index, block)| (index, *block)).collect();
        Changes::from_blocks(blocks).within(region).into_voxels()
    }

    /// Every known voxel with its state, in ascending order of blocks.
    pub fn voxels(&self) -> impl Iterator<Item = (Voxel, State)> + use<> {
        Changes::from_blocks(self.blocks().map(|(index, block)| (index, *block)).collect()).into_voxels()
    }

    /// Number of Free and of Occupied voxels. O(blocks).
    pub fn count(&self) -> (usize, usize) {
        let ones = |plane: &Plane| plane.iter().map(|w| w.count_ones() as usize).sum::<usize>();
        self.blocks()
            .fold((0, 0), |(free, occupied), (_, b)| (free + ones(b.free()), occupied + ones(b.occupied())))
    }

    /// Blocks that changed after [`Self::version`] had this value, ascending; those of which nothing is known
    /// any more too. `None` if that is not known any more: then everything may have changed. It is known for
    /// as long as few blocks were emptied (an alignment changed, an origin was muted, the mapper had no room):
    /// up to an eighth of all. O(regions of 64³ voxels, and blocks of those that changed).
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
        let regions = self.regions.iter().filter(move |(_, region)| region.version() > version);
        let blocks = regions.flat_map(|(at, region)| region.blocks(*at));
        let blocks = blocks.map(|(index, block)| (index, block.version));
        let is_known = began.max(version) >= self.emptied_since;
        is_known.then(|| blocks.filter(move |(_, changed)| *changed > version))
    }

    /// Follows the straight line between two points (metres) to the first voxel that is Occupied, or Unknown if
    /// `through_unknown` is false. A point outside of the voxel limits ends as Unknown at the start.
    pub fn cast_ray(&self, from: [f64; 3], to: [f64; 3], through_unknown: bool) -> RayEnd {
        let side = self.resolution.metres();
        let (Some(start), Some(end)) = (self.resolution.voxel_at(from), self.resolution.voxel_at(to)) else {
            return RayEnd::Unknown { voxel: Voxel::default(), distance_m: 0.0 };
        };
        let d: [f64; 3] = core::array::from_fn(|axis| to[axis] - from[axis]);
        let length = d.iter().map(|d| d * d).sum::<f64>().sqrt();
        let mut at = [start.x, start.y, start.z];
        let to = [end.x, end.y, end.z];
        // Share of the ray at which it next crosses a face of each axis.
        let mut next: [f64; 3] = core::array::from_fn(|axis| {
            let face = f64::from(at[axis] + i32::from(d[axis] > 0.0)) * side;
            if d[axis] == 0.0 { f64::INFINITY } else { (face - from[axis]) / d[axis] }
        });
        let mut entered = 0.0;
        let steps: u32 = at.iter().zip(to).map(|(a, b)| a.abs_diff(b)).sum();
        // A block is looked up when the ray comes into it.
        let (mut index, mut block) = (start.block(), self.block(start.block()));
        for _ in 0..=steps {
            let voxel = Voxel::new(at[0], at[1], at[2]);
            let distance_m = entered * length;
            if index != voxel.block() {
                (index, block) = (voxel.block(), self.block(voxel.block()));
            }
            match block.map_or(State::Unknown, |block| block.get(voxel_bit(voxel))) {
                State::Occupied => return RayEnd::Occupied { voxel, distance_m },
                State::Unknown if !through_unknown => return RayEnd::Unknown { voxel, distance_m },
                _ => {}
            }
            let axis = (0..3).min_by(|a, b| next[*a].total_cmp(&next[*b])).unwrap_or(0);
            entered = next[axis].clamp(0.0, 1.0);
            at[axis] += if d[axis] > 0.0 { 1 } else { -1 };
            next[axis] += side / d[axis].abs();
        }
        RayEnd::Clear
    }

    /// Sets all voxels of a block: what is known, and what is not. O(1), and the copy of a region where a view
    /// of it is alive.
    pub fn set_block(&mut self, index: BlockIndex, states: &StateBlock) {
        self.write(index, &[u64::MAX; 8], states);
        self.forget_emptied();
    }

    /// Sets the voxels of `mask` to those of `states`.
    pub(super) fn write(&mut self, index: BlockIndex, mask: &Plane, states: &StateBlock) {
        let old = self.block(index).copied().unwrap_or_default();
        let keep: Plane = core::array::from_fn(|z| !mask[z]);
        let mut new = old.masked(&keep);
        new.overlay(&states.masked(mask));
        if new == old {
            return;
        }
        self.set_states(index, new);
    }

    /// Sets the states of a block, which counts as changed.
    fn set_states(&mut self, index: BlockIndex, states: StateBlock) {
        self.version += 1;
        let regions = Arc::make_mut(&mut self.regions);
        let region = regions.entry(region_of(index)).or_default();
        self.region_bytes -= region.memory_bytes();
        let region = Arc::make_mut(region);
        let before = region.set(index, states, self.version);
        self.region_bytes += region.memory_bytes();
        self.blocks += usize::from(before.is_none());
        self.emptied += usize::from(states.is_empty());
        self.emptied -= usize::from(before.is_some_and(|before| before.is_empty()));
    }

    /// Lets go of emptied blocks if there are many. O(blocks) then.
    pub(super) fn forget_emptied(&mut self) {
        if self.emptied <= self.blocks / EMPTIED_PART {
            return;
        }
        let regions = Arc::make_mut(&mut self.regions);
        regions.retain(|_, region| {
            if region.has_emptied() {
                self.region_bytes -= region.memory_bytes();
                let region = Arc::make_mut(region);
                region.forget_emptied();
                self.region_bytes += region.memory_bytes();
            }
            !region.is_empty()
        });
        regions.shrink_to_fit();
        self.blocks -= self.emptied;
        self.emptied = 0;
        self.emptied_since = self.version;
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
