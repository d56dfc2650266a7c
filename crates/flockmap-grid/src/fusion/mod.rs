//! Fusion: own observations and the layers of all others, aligned into one map; the newest stamp wins (Sec. IV-C).

mod align;
mod view;

use std::collections::BTreeMap;

use crate::layer::LAYER_BLOCK_BYTES_MAX;
use crate::{
    BLOCK_VOXELS, BlockIndex, Changes, Layer, Mapper, Plane, Pose, PresentState, Resolution, RobotId,
    ScanReport, Stamp, State, StateBlock, Stream, Voxel, bit_of,
};
use align::Alignment;
pub use view::{MapView, RayEnd};

/// How layers become one map.
#[derive(Clone, Debug, PartialEq)]
pub struct FusionConfig {
    /// A robot's own observation of a voxel wins over a team-mate's that is newer by up to this much.
    /// Microseconds; default 1 s.
    pub own_priority_micros: i64,
    /// Most blocks of 8³ voxels that the layers of all streams together may hold; what goes beyond is refused.
    /// Worst case 18 kB a block, 0.7 kB as a rule. Default 400,000.
    pub layer_blocks_max: usize,
    /// Most streams that are kept. Default 256.
    pub streams_max: usize,
}

impl Default for FusionConfig {
    fn default() -> Self {
        Self { own_priority_micros: 1_000_000, layer_blocks_max: 400_000, streams_max: 256 }
    }
}

const _: () = assert!(LAYER_BLOCK_BYTES_MAX < 18_000);

/// Why changes were not taken into a layer.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FusionError {
    /// The layers would hold too much.
    #[error("the layers hold {held} blocks and would exceed layer_blocks_max ({max})")]
    LayersFull {
        /// Blocks held.
        held: usize,
        /// The limit.
        max: usize,
    },
    /// Too many streams.
    #[error("{0:?} would exceed streams_max ({1})")]
    StreamsFull(Stream, usize),
}

/// The layers of all streams and the fused map that they make with a robot's own observations.
pub struct Fusion {
    config: FusionConfig,
    own: Stream,
    resolution: Resolution,
    layers: BTreeMap<Stream, Layer>,
    layer_blocks: usize,
    origins: BTreeMap<RobotId, Origin>,
    /// Of origins for which nothing was set.
    unset: Origin,
    view: MapView,
}

/// What is set for the layers of an origin.
#[derive(Clone, Debug)]
struct Origin {
    alignment: Alignment,
    clock_offset_micros: i64,
    is_muted: bool,
}

impl Fusion {
    /// Without any layer. `own` is this robot's stream of this run: its layer is kept for the others, while
    /// the fused map takes the own part from the mapper, where it is fresher.
    pub fn new(own: Stream, resolution: Resolution, config: FusionConfig) -> Self {
        Self {
            config,
            own,
            resolution,
            layers: BTreeMap::new(),
            layer_blocks: 0,
            origins: BTreeMap::new(),
            unset: Origin::new(Alignment::new(&Pose::IDENTITY, resolution)),
            view: MapView::new(resolution),
        }
    }

    /// The fused map as it is now. O(1).
    pub fn view(&self) -> MapView {
        self.view.clone()
    }

    /// The fused map.
    pub const fn map(&self) -> &MapView {
        &self.view
    }

    /// The layer of a stream.
    pub fn layer(&self, stream: Stream) -> Option<&Layer> {
        self.layers.get(&stream)
    }

    /// All layers in ascending order of their streams.
    pub fn layers(&self) -> impl Iterator<Item = (Stream, &Layer)> {
        self.layers.iter().map(|(stream, layer)| (*stream, layer))
    }

    /// Takes in what the mapper made of a scan.
    pub fn own_scan(&mut self, mapper: &Mapper, report: &ScanReport) {
        for (index, touched) in &report.touched {
            self.refresh(mapper, *index, touched);
        }
        for index in &report.forgotten {
            self.refresh(mapper, *index, &[u64::MAX; 8]);
        }
    }

    /// Takes changes into the layer of a stream, and from there into the fused map. `stamp` is on the clock of the
    /// origin. Returns how many voxels of the layer were taken over (older ones are not).
    ///
    /// # Errors
    /// [`FusionError`] if the layers would grow beyond their limits; nothing is changed then.
    pub fn apply(
        &mut self,
        mapper: &Mapper,
        stream: Stream,
        changes: &Changes,
        stamp: Stamp,
    ) -> Result<usize, FusionError> {
        self.check_room(stream, changes)?;
        Ok(self.take_over(mapper, stream, |layer| layer.apply(changes, stamp)))
    }

    /// The same for a present state, or a tile of one: every voxel has its own stamp.
    ///
    /// # Errors
    /// [`FusionError`] if the layers would grow beyond their limits; nothing is changed then.
    pub fn apply_present(
        &mut self,
        mapper: &Mapper,
        stream: Stream,
        state: &PresentState,
    ) -> Result<usize, FusionError> {
        let blocks = state.parts.iter().flat_map(|(_, part)| part.blocks().iter().copied()).collect();
        self.check_room(stream, &Changes::from_blocks(blocks))?;
        Ok(self.take_over(mapper, stream, |layer| layer.apply_present(state)))
    }

    /// Whether the layer of a stream may hold the blocks of these changes.
    fn check_room(&self, stream: Stream, changes: &Changes) -> Result<(), FusionError> {
        if !self.layers.contains_key(&stream) && self.layers.len() >= self.config.streams_max {
            return Err(FusionError::StreamsFull(stream, self.config.streams_max));
        }
        if self.layer_blocks + changes.blocks().len() > self.config.layer_blocks_max {
            let layer = self.layers.get(&stream);
            let is_new = |index| layer.is_none_or(|layer| layer.block(index).is_none());
            let new = changes.blocks().iter().filter(|(index, _)| is_new(*index)).count();
            if self.layer_blocks + new > self.config.layer_blocks_max {
                return Err(FusionError::LayersFull {
                    held: self.layer_blocks,
                    max: self.config.layer_blocks_max,
                });
            }
        }
        Ok(())
    }

    /// Lets a layer take something over, and brings what it took into the fused map. Returns the number of voxels.
    fn take_over(
        &mut self,
        mapper: &Mapper,
        stream: Stream,
        apply: impl FnOnce(&mut Layer) -> Vec<(BlockIndex, Plane)>,
    ) -> usize {
        let layer = self.layers.entry(stream).or_default();
        let before = layer.block_count();
        let taken = apply(layer);
        self.layer_blocks += layer.block_count() - before;
        let origin = self.origin(stream.origin);
        if stream != self.own
            && !origin.is_muted
            && !crate::mutation::is(crate::mutation::Mutation::FusionSkipped)
        {
            for (index, mask) in origin.alignment.reach(&taken).iter() {
                self.refresh(mapper, *index, mask);
            }
        }
        taken.iter().flat_map(|(_, mask)| mask).map(|word| word.count_ones() as usize).sum()
    }

    /// Notes where the sensor was in a cycle of a stream, if there is a layer of it: [`Layer::note_sensor`].
    pub fn note_sensor(&mut self, stream: Stream, stamp: Stamp, sensor: [i32; 3]) {
        if let Some(layer) = self.layers.get_mut(&stream) {
            layer.note_sensor(stamp, sensor);
        }
    }

    /// Forgets the layer of a stream.
    pub fn forget(&mut self, mapper: &Mapper, stream: Stream) {
        if let Some(layer) = self.layers.remove(&stream) {
            self.layer_blocks -= layer.block_count();
            self.rebuild(mapper);
        }
    }

    /// Says how an origin's frame lies in this robot's frame. Nothing has to be sent again: the fused map is made anew
    /// from the layers. O(voxels of all layers).
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    pub fn set_alignment(&mut self, mapper: &Mapper, origin: RobotId, T_own_origin: &Pose) {
        let alignment = Alignment::new(T_own_origin, self.resolution);
        self.origin_mut(origin).alignment = alignment;
        self.rebuild(mapper);
    }

    /// Says how far this robot's clock is ahead of an origin's: own time = origin's time + offset. Microseconds.
    /// Only what is fused from now on is compared with it, until the next [`Self::rebuild`].
    pub fn set_clock_offset(&mut self, origin: RobotId, micros: i64) {
        self.origin_mut(origin).clock_offset_micros = micros;
    }

    /// Leaves an origin's layers out of the fused map, or takes them in again. They are kept either way.
    /// O(voxels of all layers).
    pub fn set_muted(&mut self, mapper: &Mapper, origin: RobotId, is_muted: bool) {
        if self.origin(origin).is_muted != is_muted {
            self.origin_mut(origin).is_muted = is_muted;
            self.rebuild(mapper);
        }
    }

    /// Makes the fused map anew from the mapper and all layers. O(voxels).
    pub fn rebuild(&mut self, mapper: &Mapper) {
        self.view.clear();
        let mut reached: BTreeMap<BlockIndex, Plane> = mapper.blocks().map(|(i, b)| (i, b.known())).collect();
        for (origin, layer) in self.heard() {
            let known: Vec<_> = layer.blocks().map(|(index, block)| (index, block.known())).collect();
            for (index, mask) in origin.alignment.reach(&known).iter() {
                let all = reached.entry(*index).or_default();
                *all = core::array::from_fn(|z| all[z] | mask[z]);
            }
        }
        for (index, mask) in reached {
            self.refresh(mapper, index, &mask);
        }
    }

    fn origin(&self, id: RobotId) -> &Origin {
        self.origins.get(&id).unwrap_or(&self.unset)
    }

    fn origin_mut(&mut self, id: RobotId) -> &mut Origin {
        self.origins.entry(id).or_insert_with(|| self.unset.clone())
    }

    /// The layers that have a say in the fused map.
    fn heard(&self) -> impl Iterator<Item = (&Origin, &Layer)> {
        let others = self.layers.iter().filter(|(stream, _)| **stream != self.own);
        others
            .map(|(stream, layer)| (self.origin(stream.origin), layer))
            .filter(|(origin, _)| !origin.is_muted)
    }

    /// Works out the voxels of `mask` anew. What just one source knows is copied, 64 voxels at a time; only voxels that
    /// several know are compared one by one.
    fn refresh(&mut self, mapper: &Mapper, index: BlockIndex, mask: &Plane) {
        let mut fused = mapper.block(index).map_or_else(StateBlock::default, |block| block.masked(mask));
        let mut contested = [0u64; 8];
        for (origin, layer) in self.heard() {
            let Some(told) = origin.block(layer, index, mask) else { continue };
            let (known, new) = (fused.known(), told.known());
            for z in 0..8 {
                contested[z] |= known[z] & new[z];
            }
            fused.overlay(&told.masked(&core::array::from_fn(|z| !known[z])));
        }
        for (voxel, bit) in voxels_of(index, &contested) {
            fused.set(bit, self.winner(mapper, voxel));
        }
        self.view.write(index, mask, &fused);
    }

    /// The word with the newest stamp on this robot's clock; at equal stamps Occupied.
    fn winner(&self, mapper: &Mapper, voxel: Voxel) -> State {
        let own = mapper.state(voxel);
        let own_stamp = mapper.last_seen(voxel).unwrap_or(Stamp(i64::MIN));
        let own = (own != State::Unknown)
            .then(|| (own_stamp.plus_micros(self.config.own_priority_micros), own == State::Occupied));
        let told = self.heard().filter_map(|(origin, layer)| {
            let (state, stamp) = origin.look_up(layer, voxel)?;
            Some((stamp.plus_micros(origin.clock_offset_micros), state == State::Occupied))
        });
        match told.chain(own).max() {
            None => State::Unknown,
            Some((_, true)) => State::Occupied,
            Some((_, false)) => State::Free,
        }
    }
}

impl Origin {
    fn new(alignment: Alignment) -> Self {
        Self { alignment, clock_offset_micros: 0, is_muted: false }
    }

    /// What a layer says of the voxels of `mask`, in the own frame.
    fn block(&self, layer: &Layer, index: BlockIndex, mask: &Plane) -> Option<StateBlock> {
        if self.alignment.is_identity() {
            return layer.block(index).map(|block| block.masked(mask));
        }
        let mut told = StateBlock::default();
        for (voxel, bit) in voxels_of(index, mask) {
            if let Some((state, _)) = self.alignment.look_up(layer, voxel) {
                told.set(bit, state);
            }
        }
        Some(told)
    }

    fn look_up(&self, layer: &Layer, voxel: Voxel) -> Option<(State, Stamp)> {
        if self.alignment.is_identity() { layer.get(voxel) } else { self.alignment.look_up(layer, voxel) }
    }
}

/// The voxels of a block whose bits are set, with their bit numbers.
fn voxels_of(index: BlockIndex, mask: &Plane) -> impl Iterator<Item = (Voxel, usize)> {
    let corner = index.corner();
    let mask = *mask;
    (0..BLOCK_VOXELS).filter(move |bit| mask[bit / 64] >> (bit % 64) & 1 == 1).map(move |bit| {
        let [x, y, z] = bit_of(bit);
        (Voxel::new(corner.x + x, corner.y + y, corner.z + z), bit)
    })
}

#[cfg(test)]
mod tests;
