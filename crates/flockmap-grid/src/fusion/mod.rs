//! Fusion: own observations and the layers of all others, aligned into one map; the newest stamp wins (Sec.
//! IV-C).

mod align;
mod config;
mod contribution;
mod dropped;
mod dropping;
mod fused;
mod origins;
mod part;
mod reach;
mod rebuild;
mod received;
mod region;
mod rigid;
mod room;
mod set;
mod settings;
mod sources;
mod submaps;
mod view;
mod work;

use std::borrow::Cow;
use std::collections::BTreeSet;

use crate::{
    BlockIndex, Changes, Layer, Mapper, Plane, Resolution, RobotId, ScanReport, Snapshot, Stamp, Stream,
    SubmapId,
};
pub use config::FusionConfig;
pub use dropped::Dropped;
use dropped::Dropping;
use fused::Fused;
use reach::merge;
use rebuild::Rebuild;
use settings::Settings;
use sources::Sources;
pub use view::{MapView, RayEnd};

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
///
/// What is set for an origin, or forgotten, comes into force when the map has been made by it, which
/// [`Fusion::work`] does a part at a time: the map is never half made. Until then all queries speak of what was in
/// force before.
pub struct Fusion {
    config: FusionConfig,
    resolution: Resolution,
    sources: Sources,
    /// The map as it is, and by which settings it was made.
    shown: Fused,
    /// The map by other settings, while it is being made.
    next: Option<Rebuild>,
    /// What was set last.
    wanted: Settings,
    /// Origins for which something was set that neither the map nor the one that is being made has.
    due: BTreeSet<RobotId>,
    /// Streams of which submaps were moved likewise.
    due_submaps: BTreeSet<Stream>,
    /// They are to wait.
    holds_moves: bool,
    refreshed: u64,
    dropping: Dropping,
}

impl Fusion {
    /// Without any layer. `own` is this robot's stream of this run: its layer is kept for the others, while
    /// the fused map takes the own part from the mapper, where it is fresher.
    pub fn new(own: Stream, resolution: Resolution, config: FusionConfig) -> Self {
        let settings = Settings::new(own.origin, resolution, &config);
        Self {
            config,
            resolution,
            sources: Sources::new(own),
            shown: Fused::new(settings.clone(), MapView::new(resolution)),
            next: None,
            wanted: settings,
            due: BTreeSet::new(),
            due_submaps: BTreeSet::new(),
            holds_moves: false,
            refreshed: 0,
            dropping: Dropping::default(),
        }
    }

    /// The fused map as it is now. O(1).
    pub fn view(&self) -> MapView {
        self.shown.view.clone()
    }

    /// The fused map.
    pub const fn map(&self) -> &MapView {
        &self.shown.view
    }

    /// The layer of a stream.
    pub fn layer(&self, stream: Stream) -> Option<&Layer> {
        self.sources.get(stream).map(|source| &source.layer)
    }

    /// All layers in ascending order of their streams.
    pub fn layers(&self) -> impl Iterator<Item = (Stream, &Layer)> {
        self.sources.iter().map(|(stream, source)| (stream, &source.layer))
    }

    /// Takes in what the mapper made of a scan.
    pub fn own_scan(&mut self, mapper: &Mapper, report: &ScanReport) {
        let own = self.sources.own;
        let submap = self.wanted.submap(own, mapper.submap());
        self.note_near(report.sensor.map(|sensor| submap.transform(sensor)));
        self.refresh(mapper, |fused| fused.reach_own(own, mapper, &report.touched));
        // Of later submaps `moved` says what was forgotten.
        if mapper.submap() == SubmapId::FIRST || self.shown.settings.is_unmoved(own) {
            let forgotten: Vec<_> = report.forgotten.iter().map(|index| (*index, [u64::MAX; 8])).collect();
            let of = |_: &(BlockIndex, Plane)| Some(SubmapId::FIRST);
            // The map that is being made began as the one that is shown.
            let reached =
                merge(self.maps().flat_map(|fused| fused.reach_by(own, true, &forgotten, of)).collect());
            self.refresh(mapper, |_| Cow::Borrowed(&reached));
        }
        self.refresh_moved(mapper, &report.moved);
        self.shown.view.forget_emptied();
    }

    /// Takes changes into the layer of a stream, and from there into the fused map. `stamp` is on the clock
    /// of the origin, `now` on the own one. In the layer the stamp stands as it is; among layers, and beside
    /// what the robot sees itself, what came now counts as made now at the latest, to a quarter of a second.
    /// Returns how many voxels of the layer were taken over (older ones are not).
    ///
    /// At the limit what is far and old goes for it, or it goes itself where it is farther and older than all that is
    /// there: [`Self::take_dropped`] says what.
    ///
    /// # Errors
    /// [`FusionError`] if there is no room, and nothing that could go for it; nothing is changed then.
    pub fn apply(
        &mut self,
        mapper: &Mapper,
        stream: Stream,
        changes: &Changes,
        stamp: Stamp,
        now: Stamp,
    ) -> Result<usize, FusionError> {
        // Its sensor is noted when it has been applied.
        let room = self.make_room(mapper, stream, || core::iter::once(changes), 1);
        if Self::is_full(room)? {
            let mut parts = vec![(stamp, changes.clone())];
            self.make_room_by_dropping(mapper, stream, &mut parts, 1, now)?;
            let changes = parts.pop().map(|(_, changes)| changes).unwrap_or_default();
            return Ok(
                self.take_over(mapper, stream, (Some(stamp), now), |layer| layer.apply(&changes, stamp))
            );
        }
        Ok(self.take_over(mapper, stream, (Some(stamp), now), |layer| layer.apply(changes, stamp)))
    }

    /// The same for a snapshot, or a chunk of one: every voxel has its own stamp. `is_rest`: it has all packages of
    /// which something is lacking here ([`Layer::lost_upto`]), so that what was dropped comes back.
    ///
    /// # Errors
    /// [`FusionError`], as for [`Self::apply`].
    pub fn apply_snapshot(
        &mut self,
        mapper: &Mapper,
        stream: Stream,
        state: &Snapshot,
        is_rest: bool,
        now: Stamp,
    ) -> Result<usize, FusionError> {
        let parts = || state.parts.iter().map(|(_, part)| part);
        let mut state = Cow::Borrowed(state);
        if Self::is_full(self.make_room(mapper, stream, parts, state.sensors.len()))? {
            let Snapshot { region, mut parts, mut sensors } = state.into_owned();
            self.make_room_by_dropping(mapper, stream, &mut parts, sensors.len(), now)?;
            if parts.is_empty() {
                sensors.clear();
            }
            state = Cow::Owned(Snapshot { region, parts, sensors });
        }
        let newest = state.parts.iter().map(|(stamp, _)| *stamp).max();
        Ok(self.take_over(mapper, stream, (newest, now), |layer| match is_rest {
            true => layer.apply_rest(&state),
            false => layer.apply_snapshot(&state),
        }))
    }

    /// Before something of a snapshot is taken over whose sender had dropped something, nothing newer than
    /// `lost_upto`, and which brings packages that are not held: takes out what it may make outdated without saying
    /// so, and forgets from then on nothing of that. O(voxels of the layer).
    pub fn begin_part(&mut self, mapper: &Mapper, stream: Stream, lost_upto: Stamp) {
        if self.sources.get(stream).is_none() && self.sources.is_full(self.config.streams_max) {
            return;
        }
        let known = self.sources.change(stream, |source| source.layer.begin_part(lost_upto));
        self.show_without(mapper, stream, &known);
    }

    /// All that was lacking of a layer has come.
    pub fn end_lack(&mut self, stream: Stream) {
        if self.sources.get(stream).is_some() {
            self.sources.change(stream, |source| source.layer.end_lack());
        }
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
        let clock_offset_micros = self.wanted.origin(stream.origin).clock_offset_micros;
        let newest = newest.filter(|_| stream != self.sources.own);
        let ((taken, ignored), is_made_otherwise) = self.sources.change(stream, |source| {
            let changed = newest.is_some_and(|stamp| source.received.note(stamp, now, clock_offset_micros));
            let before = source.layer.ignored();
            let taken = apply(&mut source.layer);
            ((taken, source.layer.ignored() > before), changed)
        });
        if ignored {
            // It is lacking as what was dropped before is.
            self.note_dropped(stream, 0, Stamp(i64::MIN));
        }
        if is_made_otherwise {
            // As after another clock offset: what was fused stays until it is made anew.
            self.maps_mut().for_each(|fused| {
                fused.outdated.insert(stream.origin);
            });
            self.due.insert(stream.origin);
        }
        let moved = self.note_taken(stream, &taken);
        if !flockmap_mutation::is(flockmap_mutation::Mutation::FusionSkipped) {
            self.refresh_taken(mapper, stream, &taken, &moved);
        }
        taken.iter().flat_map(|(_, mask)| mask).map(|word| word.count_ones() as usize).sum()
    }

    /// Notes where the sensor was in a batch of a stream, if there is a layer of it: [`Layer::note_sensor`].
    pub fn note_sensor(&mut self, stream: Stream, stamp: Stamp, sensor: [i32; 3]) {
        if self.sources.get(stream).is_some() {
            self.sources.change(stream, |source| source.layer.note_sensor(stamp, sensor));
        }
    }

    /// The own stream is another one from now on, without a layer; that of the former one is forgotten, and let go of
    /// by [`Self::work`].
    pub fn begin_run(&mut self, own: Stream) {
        let former = self.sources.own;
        self.settings_mut().for_each(|settings| settings.rename(former, own));
        if self.due_submaps.remove(&former) {
            self.due_submaps.insert(own);
        }
        self.sources.begin_run(own);
    }

    /// How many blocks of the fused map, and of the one that is being made, were worked out so far: what calls cost.
    pub const fn refreshed(&self) -> u64 {
        self.refreshed
    }

    /// The map as it is, and the one that is being made.
    fn maps(&self) -> impl Iterator<Item = &Fused> {
        core::iter::once(&self.shown).chain(self.next.as_ref().map(|next| &next.fused))
    }

    fn maps_mut(&mut self) -> impl Iterator<Item = &mut Fused> {
        core::iter::once(&mut self.shown).chain(self.next.as_mut().map(|next| &mut next.fused))
    }

    /// Works out anew what is reached in each map.
    fn refresh<'a>(&mut self, mapper: &Mapper, reached: impl Fn(&Fused) -> Cow<'a, [(BlockIndex, Plane)]>) {
        let reached: Vec<_> = self.maps().map(reached).collect();
        self.refresh_each(mapper, &reached);
    }

    /// Works out anew what was reached in each map: the shown one, and the next one if there is one.
    fn refresh_each(&mut self, mapper: &Mapper, reached: &[impl AsRef<[(BlockIndex, Plane)]>]) {
        let next = self.next.as_mut().map(|next| &mut next.fused);
        for (fused, targets) in core::iter::once(&mut self.shown).chain(next).zip(reached) {
            self.refreshed += targets.as_ref().len() as u64;
            fused.refresh(&self.sources, mapper, targets.as_ref());
        }
    }
}

#[cfg(test)]
mod tests;
