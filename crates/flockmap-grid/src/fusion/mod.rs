//! Fusion: own observations and the layers of all others, aligned into one map; the newest stamp wins (Sec.
//! IV-C).

mod align;
mod origins;
mod received;
mod region;
mod rigid;
mod view;

use core::cmp::Reverse;
use std::collections::BTreeMap;
use std::sync::Arc;

use crate::layer::{SENSOR_BYTES, Unpacked};
use crate::{
    BlockIndex, Changes, Layer, Mapper, Plane, Pose, PoseError, Resolution, RobotId, ScanReport, Snapshot,
    Stamp, State, StateBlock, Stream, Voxel, set_bits,
};
use align::Alignment;
use received::Received;
use view::VIEW_BLOCK_BYTES;
pub use view::{MapView, RayEnd};

/// How layers become one map.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema))]
#[cfg_attr(feature = "serde", serde(default, deny_unknown_fields))]
pub struct FusionConfig {
    /// A robot's own observation of a voxel wins over a team-mate's that is newer by up to this much.
    /// Microseconds; default 1 s.
    #[cfg_attr(feature = "serde", serde(rename = "own_priority_ms", with = "crate::units::Times::<1_000>"))]
    pub own_priority_micros: i64,
    /// Most bytes that the layers of all other streams may hold together, with what they add to the fused
    /// map; what goes beyond is refused. A block of 8³ voxels takes 0.5 to 1.5 kB as a rule while it is
    /// changed, and 11 kB if each of its voxels changed last in another batch; 0.1 kB, when nothing near it has
    /// changed for long. One merge may go beyond by what it adds to the fused map in new places, at most
    /// 64 MiB. Default 512 MiB.
    #[cfg_attr(feature = "serde", serde(rename = "layers_mb", with = "crate::units::Mebibytes"))]
    pub layer_bytes_max: usize,
    /// The same for the layer of the own stream: what of the own map was published. Default 256 MiB.
    #[cfg_attr(feature = "serde", serde(rename = "own_layer_mb", with = "crate::units::Mebibytes"))]
    pub own_layer_bytes_max: usize,
    /// Most streams that are kept. Default 256.
    #[cfg_attr(feature = "serde", serde(skip))]
    pub streams_max: usize,
}

impl Default for FusionConfig {
    fn default() -> Self {
        Self {
            own_priority_micros: 1_000_000,
            layer_bytes_max: 512 << 20,
            own_layer_bytes_max: 256 << 20,
            streams_max: 256,
        }
    }
}

/// Blocks of the fused map that a new block of a layer in another frame is taken to add, before it is there
/// and they are counted.
const REACHED_BLOCKS: usize = 4;

/// Blocks of the fused map that are worked out together: enough that what they have in common is looked at
/// once, few enough that what is noted of them, half a kilobyte each, stays small.
const REFRESHED_AT_ONCE: usize = 2_048;

/// Why changes were not taken into a layer.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FusionError {
    /// The layers of others would hold too much.
    #[error(
        "the layers of others hold {held} bytes, and with {more} more would exceed layer_bytes_max ({max})"
    )]
    LayersFull {
        /// Bytes held.
        held: usize,
        /// What may be added to them.
        more: usize,
        /// The limit.
        max: usize,
    },
    /// The own layer would hold too much.
    #[error(
        "the own layer holds {held} bytes, and with {more} more would exceed own_layer_bytes_max ({max})"
    )]
    OwnLayerFull {
        /// Bytes held.
        held: usize,
        /// What may be added to them.
        more: usize,
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
    sources: BTreeMap<Stream, Source>,
    /// Of the sources of others.
    layer_bytes: usize,
    origins: BTreeMap<RobotId, Origin>,
    /// Of origins for which nothing was set.
    unset: Origin,
    /// Cubes of layers, for who reads them.
    unpacked: Arc<Unpacked>,
    view: MapView,
    refreshed: u64,
}

/// What came of a stream.
#[derive(Default)]
struct Source {
    /// The same on every robot that has applied the same, with the stamps of the origin.
    layer: Layer,
    /// When it came here. Of the own stream nothing is noted: the mapper says what was seen when.
    received: Received,
}

impl Source {
    fn memory_bytes(&self) -> usize {
        self.layer.memory_bytes() + self.received.memory_bytes()
    }
}

/// What is set for the layers of an origin.
#[derive(Clone, Debug)]
struct Origin {
    pose: Pose,
    alignment: Alignment,
    clock_offset_micros: i64,
    /// Something was fused with another offset.
    has_other_offsets: bool,
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
            sources: BTreeMap::new(),
            layer_bytes: 0,
            origins: BTreeMap::new(),
            unset: Origin::new(resolution),
            unpacked: Arc::default(),
            refreshed: 0,
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
        self.sources.get(&stream).map(|source| &source.layer)
    }

    /// All layers in ascending order of their streams.
    pub fn layers(&self) -> impl Iterator<Item = (Stream, &Layer)> {
        self.sources.iter().map(|(stream, source)| (*stream, &source.layer))
    }

    /// Takes in what the mapper made of a scan.
    pub fn own_scan(&mut self, mapper: &Mapper, report: &ScanReport) {
        self.refresh(mapper, &report.touched);
        let forgotten: Vec<_> = report.forgotten.iter().map(|index| (*index, [u64::MAX; 8])).collect();
        self.refresh(mapper, &forgotten);
        self.view.forget_emptied();
    }

    /// Takes changes into the layer of a stream, and from there into the fused map. `stamp` is on the clock
    /// of the origin, `now` on the own one. In the layer the stamp stands as it is; among layers, and beside
    /// what the robot sees itself, what came now counts as made now at the latest, to a quarter of a second.
    /// Returns how many voxels of the layer were taken over (older ones are not).
    ///
    /// # Errors
    /// [`FusionError`] if the layers would grow beyond their limits; nothing is changed then.
    pub fn apply(
        &mut self,
        mapper: &Mapper,
        stream: Stream,
        changes: &Changes,
        stamp: Stamp,
        now: Stamp,
    ) -> Result<usize, FusionError> {
        // Its sensor is noted when it has been applied.
        self.make_room(mapper, stream, || core::iter::once(changes), 1)?;
        Ok(self.take_over(mapper, stream, (Some(stamp), now), |layer| layer.apply(changes, stamp)))
    }

    /// The same for a snapshot, or a chunk of one: every voxel has its own stamp.
    ///
    /// # Errors
    /// [`FusionError`] if the layers would grow beyond their limits; nothing is changed then.
    pub fn apply_snapshot(
        &mut self,
        mapper: &Mapper,
        stream: Stream,
        state: &Snapshot,
        now: Stamp,
    ) -> Result<usize, FusionError> {
        let parts = || state.parts.iter().map(|(_, part)| part);
        self.make_room(mapper, stream, parts, state.sensors.len())?;
        let newest = state.parts.iter().map(|(stamp, _)| *stamp).max();
        Ok(self.take_over(mapper, stream, (newest, now), |layer| layer.apply_snapshot(state)))
    }

    /// Bytes that the layers of others hold, with what of the fused map the own map does not account for. O(1).
    pub fn memory_bytes_of_others(&self, mapper: &Mapper) -> usize {
        self.layer_bytes + self.view.memory_bytes().saturating_sub(mapper.block_count() * VIEW_BLOCK_BYTES)
    }

    /// Packs layers if they would not fit else: the layer of a stream is to take these changes over.
    fn make_room<'a, P: Iterator<Item = &'a Changes>>(
        &mut self,
        mapper: &Mapper,
        stream: Stream,
        parts: impl Fn() -> P,
        sensors: usize,
    ) -> Result<(), FusionError> {
        match self.check_room(mapper, stream, parts(), sensors) {
            Err(FusionError::LayersFull { .. } | FusionError::OwnLayerFull { .. }) => {
                let is_own = stream == self.own;
                let sources = self.sources.iter_mut().filter(|(other, _)| (**other == self.own) == is_own);
                for (_, source) in sources {
                    let before = source.memory_bytes();
                    source.layer.make_room();
                    if !is_own {
                        self.layer_bytes = self.layer_bytes + source.memory_bytes() - before;
                    }
                }
                self.check_room(mapper, stream, parts(), sensors)
            }
            result => result,
        }
    }

    /// Whether the layer of a stream may take these changes over, each with a stamp of its own, and so many
    /// sensors.
    fn check_room<'a>(
        &self,
        mapper: &Mapper,
        stream: Stream,
        parts: impl Iterator<Item = &'a Changes>,
        sensors: usize,
    ) -> Result<(), FusionError> {
        let source = self.sources.get(&stream);
        if source.is_none() && self.sources.len() >= self.config.streams_max {
            return Err(FusionError::StreamsFull(stream, self.config.streams_max));
        }
        let nothing = Source::default();
        let Source { layer, received } = source.unwrap_or(&nothing);
        let (growth, new_blocks) = layer.growth_max(parts);
        let layer_growth = growth + sensors * SENSOR_BYTES;
        if stream == self.own {
            let (held, max) = (layer.memory_bytes(), self.config.own_layer_bytes_max);
            let is_within = held + layer_growth <= max;
            return is_within.then_some(()).ok_or(FusionError::OwnLayerFull {
                held,
                more: layer_growth,
                max,
            });
        }
        let origin = self.origin(stream.origin);
        let reached = match (origin.is_muted, origin.alignment.is_identity()) {
            (true, _) => 0,
            (false, true) => new_blocks,
            (false, false) => new_blocks * REACHED_BLOCKS,
        };
        let (held, max) = (self.memory_bytes_of_others(mapper), self.config.layer_bytes_max);
        let more = layer_growth + received.growth_max() + reached * VIEW_BLOCK_BYTES;
        if held + more <= max { Ok(()) } else { Err(FusionError::LayersFull { held, more, max }) }
    }

    /// Lets a layer take something over that came now, up to this stamp, and brings what it took into the
    /// fused map. Returns the number of voxels.
    fn take_over(
        &mut self,
        mapper: &Mapper,
        stream: Stream,
        (newest, now): (Option<Stamp>, Stamp),
        apply: impl FnOnce(&mut Layer) -> Vec<(BlockIndex, Plane)>,
    ) -> usize {
        let clock_offset_micros = self.origin(stream.origin).clock_offset_micros;
        let newest = newest.filter(|_| stream != self.own);
        let (taken, is_made_otherwise) = self.change_source(stream, |source| {
            let changed = newest.is_some_and(|stamp| source.received.note(stamp, now, clock_offset_micros));
            (apply(&mut source.layer), changed)
        });
        let origin = self.origin(stream.origin);
        if is_made_otherwise {
            self.rebuild(mapper);
        } else if stream != self.own
            && !origin.is_muted
            && !flockmap_mutation::is(flockmap_mutation::Mutation::FusionSkipped)
        {
            let reached = origin.alignment.reach(&taken);
            self.refresh(mapper, &reached);
        }
        taken.iter().flat_map(|(_, mask)| mask).map(|word| word.count_ones() as usize).sum()
    }

    /// Changes a source, and the count of bytes with it.
    fn change_source<T>(&mut self, stream: Stream, change: impl FnOnce(&mut Source) -> T) -> T {
        let nothing = || Source { layer: Layer::new(&self.unpacked), received: Received::default() };
        let source = self.sources.entry(stream).or_insert_with(nothing);
        let before = source.memory_bytes();
        let result = change(source);
        if stream != self.own {
            self.layer_bytes = self.layer_bytes + source.memory_bytes() - before;
        }
        result
    }

    /// Notes where the sensor was in a batch of a stream, if there is a layer of it: [`Layer::note_sensor`].
    pub fn note_sensor(&mut self, stream: Stream, stamp: Stamp, sensor: [i32; 3]) {
        if self.sources.contains_key(&stream) {
            self.change_source(stream, |source| source.layer.note_sensor(stamp, sensor));
        }
    }

    /// The own stream is another one from now on, without a layer; that of the former one is forgotten.
    pub fn begin_run(&mut self, own: Stream) {
        self.sources.remove(&self.own);
        self.own = own;
    }

    /// Forgets the layer of a stream; and with the last one of an origin how far its clock is off, unless it
    /// has an alignment or is muted.
    pub fn forget(&mut self, mapper: &Mapper, stream: Stream) {
        if let Some(source) = self.sources.remove(&stream) {
            if stream != self.own {
                self.layer_bytes -= source.memory_bytes();
            }
            self.rebuild(mapper);
        }
        // Else the list of origins would grow with every robot that ever came by.
        let origin = self.origin(stream.origin);
        let is_plain = origin.alignment.is_identity() && !origin.is_muted;
        if is_plain && !self.sources.keys().any(|other| other.origin == stream.origin) {
            self.origins.remove(&stream.origin);
        }
    }

    /// Says how an origin's frame lies in this robot's frame. Nothing has to be sent again: the fused map is
    /// made anew from the layers. What comes to lie beyond the end of the grid is left out. O(voxels of all
    /// layers), O(1) if there are none of it or it lies so already.
    ///
    /// # Errors
    /// [`PoseError`] if it is no pose, or brings the origin of the frame beyond the grid; nothing is changed
    /// then.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    pub fn set_alignment(
        &mut self,
        mapper: &Mapper,
        origin: RobotId,
        T_own_origin: &Pose,
    ) -> Result<(), PoseError> {
        T_own_origin.check(self.resolution)?;
        if self.origin(origin).pose == *T_own_origin {
            return Ok(());
        }
        let alignment = Alignment::new(T_own_origin, self.resolution);
        let set = self.origin_mut(origin);
        (set.pose, set.alignment) = (*T_own_origin, alignment);
        self.rebuild_for(mapper, origin);
        Ok(())
    }

    /// Says how far this robot's clock is ahead of an origin's: own time = origin's time + offset. Microseconds.
    /// Only what is fused from now on is compared with it, until the next [`Self::rebuild`].
    pub fn set_clock_offset(&mut self, origin: RobotId, micros: i64) {
        let set = self.origin_mut(origin);
        set.has_other_offsets |= set.clock_offset_micros != micros;
        set.clock_offset_micros = micros;
    }

    /// The same for what is fused already too: where something was fused with another offset, the map is made anew.
    /// O(voxels of all layers), O(1) where nothing was.
    pub fn apply_clock_offset(&mut self, mapper: &Mapper, origin: RobotId, micros: i64) {
        self.set_clock_offset(origin, micros);
        if self.origin(origin).has_other_offsets {
            self.rebuild_for(mapper, origin);
        }
    }

    /// Leaves an origin's layers out of the fused map, or takes them in again. They are kept in any case.
    /// O(voxels of all layers), O(1) if there are none of it or it is so already.
    pub fn set_muted(&mut self, mapper: &Mapper, origin: RobotId, is_muted: bool) {
        if self.origin(origin).is_muted != is_muted {
            self.origin_mut(origin).is_muted = is_muted;
            self.rebuild_for(mapper, origin);
        }
    }

    /// Makes the fused map anew, if there are layers of this origin: what it is set to has changed.
    fn rebuild_for(&mut self, mapper: &Mapper, origin: RobotId) {
        if self.sources.keys().any(|stream| stream.origin == origin && *stream != self.own) {
            self.rebuild(mapper);
        } else {
            self.origin_mut(origin).has_other_offsets = false;
        }
    }

    /// Makes the fused map anew from the mapper and all layers: what comes out as it was is no change.
    /// O(voxels).
    pub fn rebuild(&mut self, mapper: &Mapper) {
        let mut reached: BTreeMap<BlockIndex, Plane> = mapper.blocks().map(|(i, b)| (i, b.known())).collect();
        for (index, states) in self.view.blocks() {
            let all = reached.entry(index).or_default();
            *all = core::array::from_fn(|z| all[z] | states.known()[z]);
        }
        for (_, origin, source) in self.heard() {
            let known: Vec<_> = source.layer.blocks().map(|(index, block)| (index, block.known())).collect();
            for (index, mask) in origin.alignment.reach(&known).iter() {
                let all = reached.entry(*index).or_default();
                *all = core::array::from_fn(|z| all[z] | mask[z]);
            }
        }
        self.refresh(mapper, &reached.into_iter().collect::<Vec<_>>());
        self.view.forget_emptied();
        self.origins.values_mut().for_each(|origin| origin.has_other_offsets = false);
    }

    /// How many blocks of the fused map were worked out so far: what calls cost.
    pub const fn refreshed(&self) -> u64 {
        self.refreshed
    }

    fn origin(&self, id: RobotId) -> &Origin {
        self.origins.get(&id).unwrap_or(&self.unset)
    }

    fn origin_mut(&mut self, id: RobotId) -> &mut Origin {
        self.origins.entry(id).or_insert_with(|| self.unset.clone())
    }

    /// The sources that have a say in the fused map.
    fn heard(&self) -> impl Iterator<Item = (RobotId, &Origin, &Source)> {
        let others = self.sources.iter().filter(|(stream, _)| **stream != self.own);
        others
            .map(|(stream, source)| (stream.origin, self.origin(stream.origin), source))
            .filter(|(_, origin, _)| !origin.is_muted)
    }

    /// Works out voxels anew. What just one source knows is copied, 64 voxels at a time; only voxels that
    /// several know are compared one by one.
    fn refresh(&mut self, mapper: &Mapper, targets: &[(BlockIndex, Plane)]) {
        self.refreshed += targets.len() as u64;
        for targets in targets.chunks(REFRESHED_AT_ONCE) {
            let mut fused: Vec<_> = targets
                .iter()
                .map(|(index, mask)| {
                    mapper.block(*index).map_or_else(StateBlock::default, |b| b.masked(mask))
                })
                .collect();
            let mut contested = vec![[0u64; 8]; targets.len()];
            for (_, origin, source) in self.heard() {
                origin.blocks(&source.layer, targets, |number, source| {
                    let (fused, contested) = (&mut fused[number], &mut contested[number]);
                    let (known, new) = (fused.known(), source.known());
                    for z in 0..8 {
                        contested[z] |= known[z] & new[z];
                    }
                    fused.overlay(&source.masked(&core::array::from_fn(|z| !known[z])));
                });
            }
            for (((index, mask), mut fused), contested) in targets.iter().zip(fused).zip(contested) {
                if contested != [0; 8] {
                    for bit in set_bits(&contested) {
                        fused.set(bit, self.winner(mapper, index.voxel(bit)));
                    }
                }
                self.view.write(*index, mask, &fused);
            }
        }
    }

    /// The state that was observed last on this robot's clock; of those observed together, Occupied.
    fn winner(&self, mapper: &Mapper, voxel: Voxel) -> State {
        match self.last_observation(mapper, voxel) {
            None => State::Unknown,
            Some((true, _)) => State::Occupied,
            Some((false, _)) => State::Free,
        }
    }

    /// Whether it was Occupied, and whose it is; of those that say the same at the same time, the own robot's,
    /// then that of the lowest id.
    fn last_observation(&self, mapper: &Mapper, voxel: Voxel) -> Option<(bool, RobotId)> {
        let own = mapper.state(voxel);
        let own_stamp = mapper.last_seen(voxel).unwrap_or(Stamp(i64::MIN));
        let own = (own != State::Unknown).then(|| {
            let stamp = own_stamp.plus_micros(self.config.own_priority_micros);
            (stamp, own == State::Occupied, true, Reverse(self.own.origin))
        });
        let source = self.heard().filter_map(|(id, origin, source)| {
            let (state, stamp) = origin.look_up(&source.layer, voxel)?;
            let made = source.received.made(stamp, origin.clock_offset_micros);
            Some((made, state == State::Occupied, id == self.own.origin, Reverse(id)))
        });
        source.chain(own).max().map(|(_, is_occupied, _, Reverse(id))| (is_occupied, id))
    }
}

impl Origin {
    fn new(resolution: Resolution) -> Self {
        let pose = Pose::IDENTITY;
        let alignment = Alignment::new(&pose, resolution);
        Self { pose, alignment, clock_offset_micros: 0, has_other_offsets: false, is_muted: false }
    }

    /// What a layer says of voxels in the own frame, block by block, with the number of the target.
    fn blocks(
        &self,
        layer: &Layer,
        targets: &[(BlockIndex, Plane)],
        mut source: impl FnMut(usize, StateBlock),
    ) {
        if !self.alignment.is_identity() {
            return self.alignment.blocks(layer, targets, source);
        }
        for (number, (index, mask)) in targets.iter().enumerate() {
            if let Some(block) = layer.block(*index) {
                source(number, block.masked(mask));
            }
        }
    }

    fn look_up(&self, layer: &Layer, voxel: Voxel) -> Option<(State, Stamp)> {
        if self.alignment.is_identity() { layer.get(voxel) } else { self.alignment.look_up(layer, voxel) }
    }
}

#[cfg(test)]
mod tests;
