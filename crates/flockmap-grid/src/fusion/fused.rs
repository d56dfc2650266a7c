//! A map made of own observations and layers by given settings.

use core::cmp::Reverse;
use std::borrow::Cow;
use std::collections::BTreeSet;

use super::contribution::contributions;
use super::part::Part;
use super::settings::Settings;
use super::sources::Sources;
use super::view::MapView;
use crate::submap::{BlockBox, is_reserved};
use crate::{
    BlockIndex, Mapper, Plane, RobotId, Stamp, State, StateBlock, VOXEL_LIMIT, Voxel, plane_within, set_bits,
};

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

    /// Works out voxels anew, 64 at a time. Only where one part says Free and another Occupied stamps are
    /// compared, voxel by voxel. Returns how often a part was looked into for one of these.
    pub(super) fn refresh(
        &mut self,
        sources: &Sources,
        mapper: &Mapper,
        targets: &[(BlockIndex, Plane)],
    ) -> usize {
        let (mut looked, clears) = (0, self.settings.submap_clears_voxels);
        for targets in self.widened(targets).chunks(REFRESHED_AT_ONCE) {
            let Some(around) = BlockBox::around(targets.iter().map(|(index, _)| *index)) else { continue };
            let own = self.is_own_plain(sources.own, mapper).then_some(mapper);
            let parts = self.parts(sources, mapper, &around);
            let contributions = contributions(&parts, targets, clears);
            let mut rest = contributions.as_slice();
            let mut fused = Vec::with_capacity(targets.len());
            for (number, (index, mask)) in targets.iter().enumerate() {
                let (block, later) = rest.split_at(rest.partition_point(|one| one.target <= number));
                rest = later;
                let own_block = own.and_then(|own| own.block(*index)).map(|block| block.masked(mask));
                let all = || block.iter().map(|one| &one.states).chain(&own_block);
                let [free, occupied] = [StateBlock::free, StateBlock::occupied].map(|plane| {
                    all().fold([0; 8], |any, states| core::array::from_fn(|z| any[z] | plane(states)[z]))
                });
                let mut states = StateBlock::new(free, occupied);
                for bit in set_bits(&core::array::from_fn(|z| free[z] & occupied[z])) {
                    let known_by = block.iter().filter(|one| one.states.get(bit) != State::Unknown);
                    let known_by = known_by.map(|one| &parts[one.part]).inspect(|_| looked += 1);
                    let last = self.last_observation(known_by, sources.own.origin, own, index.voxel(bit));
                    states.set(bit, last.map_or(State::Unknown, |(state, _)| state));
                }
                fused.push(states);
            }
            // What layers keep far out is no part of a map.
            for ((index, mask), fused) in targets.iter().zip(fused).filter(|((at, _), _)| !is_reserved(*at)) {
                self.view.write(*index, mask, &fused);
            }
        }
        looked
    }

    /// These voxels, or their whole blocks where newer submaps clear older ones: an obstacle then has a say all around it.
    pub(super) fn widened<'a>(&self, targets: &'a [(BlockIndex, Plane)]) -> Cow<'a, [(BlockIndex, Plane)]> {
        match self.settings.submap_clears_voxels {
            0 => Cow::Borrowed(targets),
            _ => Cow::Owned(targets.iter().map(|(index, _)| whole(*index)).collect()),
        }
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
            Some((made, state == State::Occupied, part.stream.origin == id_own, Reverse(part.stream.origin)))
        });
        parts.chain(own).max().map(|(_, is_occupied, _, Reverse(id))| {
            (if is_occupied { State::Occupied } else { State::Free }, id)
        })
    }
}

/// A block with all of its voxels that lie in the grid: it may lie half beyond.
pub(super) fn whole(index: BlockIndex) -> (BlockIndex, Plane) {
    const LOWEST: Voxel = Voxel::new(-VOXEL_LIMIT, -VOXEL_LIMIT, -VOXEL_LIMIT);
    const HIGHEST: Voxel = Voxel::new(VOXEL_LIMIT, VOXEL_LIMIT, VOXEL_LIMIT);
    (index, plane_within(index, LOWEST, HIGHEST))
}
