//! A map that takes the place of another one, for who follows versions.

use std::sync::Arc;

use super::MapView;
use super::regions::Place;
use crate::fusion::region::region_of;

/// By how much the versions of a staged map are ahead: more than any map changes while it is being made, and little
/// enough for as many to follow one another.
const STAGED_AHEAD: u64 = 1 << 32;

impl MapView {
    /// A copy that is to be changed, and to take the place of this map when it is ready. Its changes have versions
    /// that this map does not come to meanwhile. O(1).
    pub(in crate::fusion) fn staged(&self) -> Self {
        Self { version: self.version + STAGED_AHEAD, ..self.clone() }
    }

    /// Takes the place of the map that it was made from when that had the version `began`. Who had that map at any
    /// version hears of all blocks that differ: of those that were changed here, since their versions are newer, and
    /// of those that were changed there alone, which count as changed now. O(regions, blocks that changed there).
    pub(in crate::fusion) fn supersede(&mut self, former: &Self, began: u64) {
        self.version = self.version.max(former.version + 1);
        let Some(changed) = former.changed_since(began) else {
            // Blocks that came and went there cannot be named.
            self.version += 1;
            self.emptied_since = self.version;
            return;
        };
        for index in changed {
            let place = self.regions.get(region_of(index)).filter(|place| place.version() > began);
            let is_changed = place.and_then(|place| place.changed_at(index)).is_some_and(|at| at > began);
            if !is_changed {
                self.change(index, Some);
            }
        }
    }

    /// Bytes that this map holds beside those that it shares with another one. O(regions of 64³ voxels).
    pub(in crate::fusion) fn memory_bytes_beside(&self, other: &Self) -> usize {
        if Arc::ptr_eq(&self.regions, &other.regions) {
            return 0;
        }
        let is_shared = |(at, place): &(_, &Place)| {
            other.regions.get(*at).is_some_and(|theirs| place.is_shared_with(theirs))
        };
        let shared = self.regions.iter().filter(is_shared);
        self.memory_bytes() - shared.map(|(_, place)| place.memory_bytes()).sum::<usize>()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{BlockIndex, Resolution, State, StateBlock};

    /// Blocks that came and went in the former map cannot be named after it let go of them: who saw one of them must
    /// not be told that little has changed.
    #[test]
    fn who_saw_a_block_that_came_and_went_meanwhile_begins_anew() {
        let mut occupied = StateBlock::default();
        occupied.set(0, State::Occupied);
        let at = |n: i32| BlockIndex::new(n, 0, 0);
        let mut former = MapView::new(Resolution::from_metres(0.1).unwrap());
        (0..8).for_each(|n| former.set_block(at(n), &occupied));
        let (mut next, began) = (former.staged(), former.version());
        (100..104).for_each(|n| former.set_block(at(n), &occupied));
        let seen = former.clone();
        assert!(seen.block(at(100)).is_some());
        (100..104).for_each(|n| former.set_block(at(n), &StateBlock::default()));
        assert_eq!(former.changed_since(began), None, "they were let go of");
        next.supersede(&former, began);
        assert_eq!(next.changed_since(seen.version()), None);
        assert_eq!(next.changed_since(next.version()), Some(Vec::new()));
    }
}
