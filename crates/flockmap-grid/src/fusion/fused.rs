//! A map made of own observations and layers by given settings.

use core::cmp::Reverse;
use std::borrow::Cow;
use std::collections::BTreeSet;

use super::settings::{Origin, Settings};
use super::sources::{Source, Sources};
use super::view::MapView;
use crate::{BlockIndex, Mapper, Plane, RobotId, Stamp, State, StateBlock, Voxel, set_bits};

/// Blocks of the fused map that are worked out together: enough that what they have in common is looked at
/// once, few enough that what is noted of them, half a kilobyte each, stays small.
const REFRESHED_AT_ONCE: usize = 2_048;

/// The map and the settings by which it was made.
pub(super) struct Fused {
    pub settings: Settings,
    pub view: MapView,
    /// Origins of which something was fused as made at another time than it counts as made now.
    pub outdated: BTreeSet<RobotId>,
    /// It is being made, and is not shown yet: layers that were left out have no say in it.
    pub is_next: bool,
}

impl Fused {
    pub(super) fn new(settings: Settings, view: MapView) -> Self {
        Self { settings, view, outdated: BTreeSet::new(), is_next: false }
    }

    /// The sources that have a say.
    pub(super) fn heard<'a>(
        &'a self,
        sources: &'a Sources,
    ) -> impl Iterator<Item = (RobotId, &'a Origin, &'a Source)> {
        sources
            .of_others(self.is_next)
            .map(|(stream, source, _)| (stream.origin, self.settings.origin(stream.origin), source))
            .filter(|(_, origin, _)| !origin.is_muted)
    }

    /// The voxels on which these voxels of a layer of an origin can have a say, and few others.
    pub(super) fn reach<'a>(
        &self,
        origin: RobotId,
        voxels: &'a [(BlockIndex, Plane)],
    ) -> Cow<'a, [(BlockIndex, Plane)]> {
        let origin = self.settings.origin(origin);
        if origin.is_muted { Cow::Borrowed(&[]) } else { origin.alignment().reach(voxels) }
    }

    /// Works out voxels anew. What just one source knows is copied, 64 voxels at a time; only voxels that
    /// several know are compared one by one. Returns how often a layer was looked into for one of these.
    pub(super) fn refresh(
        &mut self,
        sources: &Sources,
        mapper: &Mapper,
        targets: &[(BlockIndex, Plane)],
    ) -> usize {
        let (layers, mut looked) = (self.heard(sources).count(), 0);
        for targets in targets.chunks(REFRESHED_AT_ONCE) {
            let mut fused: Vec<_> = targets
                .iter()
                .map(|(index, mask)| {
                    mapper.block(*index).map_or_else(StateBlock::default, |b| b.masked(mask))
                })
                .collect();
            let mut contested = vec![[0u64; 8]; targets.len()];
            for (_, origin, source) in self.heard(sources) {
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
                        looked += layers;
                        fused.set(bit, self.winner(sources, mapper, index.voxel(bit)));
                    }
                }
                self.view.write(*index, mask, &fused);
            }
        }
        looked
    }

    /// The state that was observed last on this robot's clock; of those observed together, Occupied.
    fn winner(&self, sources: &Sources, mapper: &Mapper, voxel: Voxel) -> State {
        match self.last_observation(sources, mapper, voxel) {
            None => State::Unknown,
            Some((true, _)) => State::Occupied,
            Some((false, _)) => State::Free,
        }
    }

    /// Whether it was Occupied, and whose it is; of those that say the same at the same time, the own robot's,
    /// then that of the lowest id.
    pub(super) fn last_observation(
        &self,
        sources: &Sources,
        mapper: &Mapper,
        voxel: Voxel,
    ) -> Option<(bool, RobotId)> {
        let id_own = sources.own.origin;
        let own = mapper.state(voxel);
        let own_stamp = mapper.last_seen(voxel).unwrap_or(Stamp(i64::MIN));
        let own = (own != State::Unknown).then(|| {
            let stamp = own_stamp.plus_micros(self.settings.own_priority_micros);
            (stamp, own == State::Occupied, true, Reverse(id_own))
        });
        let source = self.heard(sources).filter_map(|(id, origin, source)| {
            let (state, stamp) = origin.look_up(&source.layer, voxel)?;
            let made = source.received.made(stamp, origin.clock_offset_micros);
            Some((made, state == State::Occupied, id == id_own, Reverse(id)))
        });
        source.chain(own).max().map(|(_, is_occupied, _, Reverse(id))| (is_occupied, id))
    }
}
