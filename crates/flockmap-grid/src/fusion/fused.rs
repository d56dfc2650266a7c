//! A map made of own observations and layers by given settings.

use core::cmp::Reverse;
use std::collections::BTreeSet;

use super::part::Part;
use super::settings::Settings;
use super::sources::Sources;
use super::view::MapView;
use crate::submap::{BlockBox, is_reserved};
use crate::{BlockIndex, Mapper, Plane, RobotId, Stamp, State, Voxel, set_bits};

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
            let Some(around) = BlockBox::around(targets.iter().map(|(index, _)| *index)) else { continue };
            let own = self.is_own_plain(sources.own, mapper).then_some(mapper);
            let own_block =
                |index, mask| own.and_then(|own| own.block(index)).map(|block| block.masked(mask));
            let mut fused: Vec<_> =
                targets.iter().map(|(index, mask)| own_block(*index, mask).unwrap_or_default()).collect();
            let parts = self.parts(sources, mapper, &around);
            let mut contested = vec![[0u64; 8]; targets.len()];
            // Number of a target, and of a part that knows something of it: of a crowd few do.
            let mut known_by: Vec<(usize, usize)> = Vec::new();
            for (nth, part) in parts.iter().enumerate() {
                part.blocks(targets, |number, states| {
                    let (fused, contested) = (&mut fused[number], &mut contested[number]);
                    let (known, new) = (fused.known(), states.known());
                    known_by.extend((new != [0; 8]).then_some((number, nth)));
                    for z in 0..8 {
                        contested[z] |= known[z] & new[z];
                    }
                    fused.overlay(&states.masked(&core::array::from_fn(|z| !known[z])));
                });
            }
            known_by.sort_unstable();
            for known_by in known_by.chunk_by(|(a, _), (b, _)| a == b) {
                let number = known_by[0].0;
                for bit in set_bits(&contested[number]) {
                    let voxel = targets[number].0.voxel(bit);
                    let known_by = known_by.iter().map(|(_, nth)| &parts[*nth]);
                    looked += known_by.len();
                    let last = self.last_observation(known_by, sources.own.origin, own, voxel);
                    fused[number].set(bit, last.map_or(State::Unknown, |(state, _)| state));
                }
            }
            // What layers keep far out is no part of a map.
            for ((index, mask), fused) in targets.iter().zip(fused).filter(|((at, _), _)| !is_reserved(*at)) {
                self.view.write(*index, mask, &fused);
            }
        }
        looked
    }

    /// The state that was observed last on this robot's clock, by these parts, and by `own` where that is plain, and
    /// whose it is; of those observed together, Occupied; of those that say the same at the same time, the own robot's,
    /// then that of the lowest id. O(parts).
    pub(super) fn last_observation<'a>(
        &self,
        parts: impl Iterator<Item = &'a Part<'a>>,
        id_own: RobotId,
        own: Option<&Mapper>,
        voxel: Voxel,
    ) -> Option<(State, RobotId)> {
        let priority = self.settings.own_priority_micros;
        let own = own.and_then(|own| {
            let state = Some(own.state(voxel)).filter(|state| *state != State::Unknown)?;
            let stamp = own.last_seen(voxel).unwrap_or(Stamp(i64::MIN)).plus_micros(priority);
            Some((stamp, state == State::Occupied, true, Reverse(id_own)))
        });
        let parts = parts.filter_map(|part| {
            let (state, made) = part.look_up(voxel, priority)?;
            Some((made, state == State::Occupied, part.id == id_own, Reverse(part.id)))
        });
        parts.chain(own).max().map(|(_, is_occupied, _, Reverse(id))| {
            (if is_occupied { State::Occupied } else { State::Free }, id)
        })
    }
}
