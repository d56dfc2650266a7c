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
        let mut looked = 0;
        for targets in targets.chunks(REFRESHED_AT_ONCE) {
            let mut fused: Vec<_> = targets
                .iter()
                .map(|(index, mask)| {
                    mapper.block(*index).map_or_else(StateBlock::default, |b| b.masked(mask))
                })
                .collect();
            let heard: Vec<_> = self.heard(sources).collect();
            let mut contested = vec![[0u64; 8]; targets.len()];
            // Number of a target, and of a source that knows something of it: of a crowd few do.
            let mut known_by: Vec<(usize, usize)> = Vec::new();
            for (nth, (_, origin, source)) in heard.iter().enumerate() {
                origin.blocks(&source.layer, targets, |number, source| {
                    let (fused, contested) = (&mut fused[number], &mut contested[number]);
                    let (known, new) = (fused.known(), source.known());
                    known_by.extend((new != [0; 8]).then_some((number, nth)));
                    for z in 0..8 {
                        contested[z] |= known[z] & new[z];
                    }
                    fused.overlay(&source.masked(&core::array::from_fn(|z| !known[z])));
                });
            }
            known_by.sort_unstable();
            for known_by in known_by.chunk_by(|(a, _), (b, _)| a == b) {
                let number = known_by[0].0;
                for bit in set_bits(&contested[number]) {
                    let voxel = targets[number].0.voxel(bit);
                    let known_by = known_by.iter().map(|(_, nth)| heard[*nth]);
                    looked += known_by.len();
                    let last = self.last_observation(known_by, sources.own.origin, mapper, voxel);
                    fused[number].set(bit, last.map_or(State::Unknown, |(state, _)| state));
                }
            }
            for ((index, mask), fused) in targets.iter().zip(fused) {
                self.view.write(*index, mask, &fused);
            }
        }
        looked
    }

    /// The state that was observed last on this robot's clock, by itself or by these sources, and whose it is; of those
    /// observed together, Occupied; of those that say the same at the same time, the own robot's, then that of the
    /// lowest id. O(sources).
    pub(super) fn last_observation<'a>(
        &self,
        sources: impl Iterator<Item = (RobotId, &'a Origin, &'a Source)>,
        id_own: RobotId,
        mapper: &Mapper,
        voxel: Voxel,
    ) -> Option<(State, RobotId)> {
        let own = mapper.state(voxel);
        let own_stamp = mapper.last_seen(voxel).unwrap_or(Stamp(i64::MIN));
        let own = (own != State::Unknown).then(|| {
            let stamp = own_stamp.plus_micros(self.settings.own_priority_micros);
            (stamp, own == State::Occupied, true, Reverse(id_own))
        });
        let source = sources.filter_map(|(id, origin, source)| {
            let (state, stamp) = origin.look_up(&source.layer, voxel)?;
            let made = source.received.made(stamp, origin.clock_offset_micros);
            Some((made, state == State::Occupied, id == id_own, Reverse(id)))
        });
        source.chain(own).max().map(|(_, is_occupied, _, Reverse(id))| {
            (if is_occupied { State::Occupied } else { State::Free }, id)
        })
    }
}
