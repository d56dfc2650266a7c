//! What is set for the layers of each origin.

use std::collections::BTreeMap;

use super::align::Alignment;
use super::config::FusionConfig;
use crate::{Pose, Resolution, RobotId, Sheet, Stream, SubmapId};

/// By which rules layers become a map.
#[derive(Clone, Debug)]
pub(super) struct Settings {
    pub own_priority_micros: i64,
    pub submap_clears_voxels: u8,
    resolution: Resolution,
    origins: BTreeMap<RobotId, Origin>,
    own: RobotId,
    /// Of the own origin, and of others, for which nothing was set.
    unset_own: Origin,
    unset: Origin,
    /// `T_map_submap` by streams: a submap without one lies as the one before it does, the first one as its stream.
    submaps: BTreeMap<Stream, BTreeMap<SubmapId, Pose>>,
}

/// What is set for the layers of an origin.
#[derive(Clone, Debug)]
pub(super) struct Origin {
    pose: Pose,
    alignment: Alignment,
    pub clock_offset_micros: i64,
    pub is_muted: bool,
}

impl Settings {
    pub(super) fn new(own: RobotId, resolution: Resolution, config: &FusionConfig) -> Self {
        let pose = Pose::IDENTITY;
        let alignment = Alignment::new(&pose, resolution);
        let unset_own = Origin { pose, alignment, clock_offset_micros: 0, is_muted: false };
        Self {
            own_priority_micros: config.own_priority_micros,
            submap_clears_voxels: config.submap_clears_voxels,
            resolution,
            origins: BTreeMap::new(),
            own,
            unset: Origin { is_muted: config.mutes_others, ..unset_own.clone() },
            unset_own,
            submaps: BTreeMap::new(),
        }
    }

    /// How a submap lies in the map of its stream.
    pub(super) fn submap(&self, stream: Stream, submap: SubmapId) -> Pose {
        let of_stream = self.submaps.get(&stream);
        let newest = of_stream.and_then(|submaps| submaps.range(..=submap).next_back());
        newest.map_or(Pose::IDENTITY, |(_, pose)| *pose)
    }

    /// Whether it was said of a submap how it lies.
    pub(super) fn has_submap(&self, stream: Stream, submap: SubmapId) -> bool {
        self.submaps.get(&stream).is_some_and(|submaps| submaps.contains_key(&submap))
    }

    pub(super) fn set_submap(&mut self, stream: Stream, submap: SubmapId, pose: Pose) {
        self.submaps.entry(stream).or_default().insert(submap, pose);
    }

    /// The submaps of a stream of which it was said how they lie, ascending.
    pub(super) fn submaps(&self, stream: Stream) -> impl Iterator<Item = (SubmapId, Pose)> {
        self.submaps.get(&stream).into_iter().flatten().map(|(submap, pose)| (*submap, *pose))
    }

    /// Whether all submaps of a stream lie as the stream does.
    pub(super) fn is_unmoved(&self, stream: Stream) -> bool {
        let submaps = self.submaps.get(&stream);
        submaps.is_none_or(|submaps| submaps.values().all(|pose| *pose == Pose::IDENTITY))
    }

    /// The submaps of one stream are those of another one from now on.
    pub(super) fn rename(&mut self, from: Stream, to: Stream) {
        if let Some(submaps) = self.submaps.remove(&from) {
            self.submaps.insert(to, submaps);
        }
    }

    /// As if nothing had been set for the submaps of a stream.
    pub(super) fn forget_submaps(&mut self, stream: Stream) {
        self.submaps.remove(&stream);
    }

    /// How what lies on a sheet in a submap of a stream lies in the fused map; `None` if that is beyond the grid.
    /// `is_own`: it is the own stream, whose map the fused one is.
    pub(super) fn alignment(
        &self,
        stream: Stream,
        is_own: bool,
        submap: SubmapId,
        sheet: Sheet,
    ) -> Option<Alignment> {
        let origin = if is_own { &self.unset_own } else { self.origin(stream.origin) };
        let pose = self.submap(stream, submap);
        if pose == Pose::IDENTITY {
            return Some(origin.alignment().of_sheet(sheet));
        }
        let placed = origin.pose().compose(&pose);
        placed.check(self.resolution).ok()?;
        Some(Alignment::new(&placed, self.resolution).of_sheet(sheet))
    }

    pub(super) fn origin(&self, id: RobotId) -> &Origin {
        self.origins.get(&id).unwrap_or_else(|| self.unset(id))
    }

    pub(super) fn origin_mut(&mut self, id: RobotId) -> &mut Origin {
        let unset = self.unset(id).clone();
        self.origins.entry(id).or_insert(unset)
    }

    fn unset(&self, id: RobotId) -> &Origin {
        if id == self.own { &self.unset_own } else { &self.unset }
    }

    /// Whether nothing is set for an origin but how far its clock is off.
    pub(super) fn is_plain(&self, id: RobotId) -> bool {
        let origin = self.origin(id);
        origin.alignment.is_identity() && origin.is_muted == self.unset(id).is_muted
    }

    /// As if nothing had been set for an origin.
    pub(super) fn forget(&mut self, id: RobotId) {
        self.origins.remove(&id);
    }
}

impl Origin {
    pub(super) fn align(&mut self, pose: &Pose, alignment: &Alignment) {
        (self.pose, self.alignment) = (*pose, alignment.clone());
    }

    pub(super) const fn pose(&self) -> &Pose {
        &self.pose
    }

    pub(super) const fn alignment(&self) -> &Alignment {
        &self.alignment
    }

    /// Whether layers come out the same by both.
    pub(super) fn is_as(&self, other: &Self) -> bool {
        self.is_muted == other.is_muted
            && self.clock_offset_micros == other.clock_offset_micros
            && self.pose == other.pose
    }
}
