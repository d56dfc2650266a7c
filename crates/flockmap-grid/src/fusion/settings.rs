//! What is set for the layers of each origin.

use std::collections::BTreeMap;

use super::align::Alignment;
use crate::{BlockIndex, Layer, Plane, Pose, Resolution, RobotId, Stamp, State, StateBlock, Voxel};

/// By which rules layers become a map.
#[derive(Clone, Debug)]
pub(super) struct Settings {
    pub own_priority_micros: i64,
    origins: BTreeMap<RobotId, Origin>,
    /// Of origins for which nothing was set.
    unset: Origin,
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
    pub(super) fn new(own_priority_micros: i64, resolution: Resolution) -> Self {
        let pose = Pose::IDENTITY;
        let alignment = Alignment::new(&pose, resolution);
        let unset = Origin { pose, alignment, clock_offset_micros: 0, is_muted: false };
        Self { own_priority_micros, origins: BTreeMap::new(), unset }
    }

    pub(super) fn origin(&self, id: RobotId) -> &Origin {
        self.origins.get(&id).unwrap_or(&self.unset)
    }

    pub(super) fn origin_mut(&mut self, id: RobotId) -> &mut Origin {
        self.origins.entry(id).or_insert_with(|| self.unset.clone())
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

    /// Whether nothing is set but how far the clock is off.
    pub(super) const fn is_plain(&self) -> bool {
        self.alignment.is_identity() && !self.is_muted
    }

    /// Whether layers come out the same by both.
    pub(super) fn is_as(&self, other: &Self) -> bool {
        self.is_muted == other.is_muted
            && self.clock_offset_micros == other.clock_offset_micros
            && self.pose == other.pose
    }

    /// What a layer says of voxels in the own frame, block by block, with the number of the target.
    pub(super) fn blocks(
        &self,
        layer: &Layer,
        targets: &[(BlockIndex, Plane)],
        mut source: impl FnMut(usize, StateBlock),
    ) {
        if !self.alignment.is_identity() {
            return self.alignment.blocks(layer, targets, source);
        }
        for (number, block) in layer.blocks_at(targets.iter().map(|(index, _)| *index)) {
            source(number, block.masked(&targets[number].1));
        }
    }

    pub(super) fn look_up(&self, layer: &Layer, voxel: Voxel) -> Option<(State, Stamp)> {
        if self.alignment.is_identity() { layer.get(voxel) } else { self.alignment.look_up(layer, voxel) }
    }
}
