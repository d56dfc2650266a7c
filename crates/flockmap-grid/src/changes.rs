//! A set of voxels with their new state: what one map package says.

use crate::block::{extent, plane_within, set_bits, voxel_bit};
use crate::{BlockIndex, Plane, State, StateBlock, Voxel, VoxelBox};

/// Voxels that changed and the state that each has now, Free or Occupied. A change to Unknown is never sent
/// (Sec. III-B of the paper), so a voxel that is neither is unchanged.
///
/// Held as blocks in ascending order of [`BlockIndex`], none of them empty: two equal sets are equal values.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Changes {
    blocks: Vec<(BlockIndex, StateBlock)>,
}

impl Changes {
    /// The set that these blocks make up. Blocks may come in any order; of two blocks at the same place the
    /// later one wins voxel by voxel; empty blocks are dropped. O(n log n).
    pub fn from_blocks(mut blocks: Vec<(BlockIndex, StateBlock)>) -> Self {
        if !blocks.is_sorted_by(|a, b| a.0 < b.0) {
            blocks.sort_by_key(|(index, _)| *index);
            blocks.dedup_by(|later, earlier| {
                let same = later.0 == earlier.0;
                if same {
                    earlier.1.overlay(&later.1);
                }
                same
            });
        }
        blocks.retain(|(_, block)| !block.is_empty());
        Self { blocks }
    }

    /// The set of these voxels; of two entries for one voxel the later wins; Unknown entries are ignored.
    pub fn from_voxels(voxels: impl IntoIterator<Item = (Voxel, State)>) -> Self {
        let mut blocks = rustc_hash::FxHashMap::<BlockIndex, StateBlock>::default();
        for (voxel, state) in voxels {
            if state != State::Unknown {
                blocks.entry(voxel.block()).or_default().set(voxel_bit(voxel), state);
            }
        }
        Self::from_blocks(blocks.into_iter().collect())
    }

    /// The blocks with changes, in ascending order.
    pub fn blocks(&self) -> &[(BlockIndex, StateBlock)] {
        &self.blocks
    }

    /// Whether nothing changed.
    pub fn is_empty(&self) -> bool {
        self.blocks.is_empty()
    }

    /// Whether a voxel became Occupied. O(blocks).
    pub fn has_occupied(&self) -> bool {
        self.blocks.iter().any(|(_, block)| block.occupied().iter().any(|word| *word != 0))
    }

    /// Number of changed voxels.
    pub fn len(&self) -> usize {
        self.blocks.iter().map(|(_, block)| block.known_count() as usize).sum()
    }

    /// The new state of a voxel, Unknown if it did not change. O(log n).
    pub fn get(&self, voxel: Voxel) -> State {
        match self.blocks.binary_search_by_key(&voxel.block(), |(index, _)| *index) {
            Ok(at) => self.blocks[at].1.get(voxel_bit(voxel)),
            Err(_) => State::Unknown,
        }
    }

    /// Every changed voxel with its new state, block by block.
    pub fn voxels(&self) -> impl Iterator<Item = (Voxel, State)> + '_ {
        self.blocks
            .iter()
            .flat_map(|(index, block)| set_bits(&block.known()).map(|bit| (index.voxel(bit), block.get(bit))))
    }

    /// As [`Self::voxels`], without borrowing.
    pub fn into_voxels(self) -> impl Iterator<Item = (Voxel, State)> {
        self.blocks.into_iter().flat_map(|pair| Self { blocks: vec![pair] }.voxels().collect::<Vec<_>>())
    }

    /// The smallest box that holds every change (the paper's "local OGM box"); `None` if there is none.
    pub fn bounding_box(&self) -> Option<VoxelBox> {
        bounding_box(self.blocks.iter().map(|(index, block)| (*index, block.known())))
    }

    /// The changes that lie in `region`.
    pub fn within(&self, region: &VoxelBox) -> Self {
        let mut blocks = Vec::new();
        for (index, block) in &self.blocks {
            if let Some(part) = index.voxel_box().intersection(region) {
                let block = if part.volume() == 512 {
                    *block
                } else {
                    block.masked(&plane_within(*index, part.min(), part.max()))
                };
                if !block.is_empty() {
                    blocks.push((*index, block));
                }
            }
        }
        Self { blocks }
    }
}

/// The smallest box that holds all these voxels of blocks.
pub(crate) fn bounding_box(blocks: impl Iterator<Item = (BlockIndex, Plane)>) -> Option<VoxelBox> {
    let mut ends: Option<[Voxel; 2]> = None;
    for (index, plane) in blocks.filter(|(_, plane)| *plane != [0; 8]) {
        let (low, high) = extent(&plane);
        let corner = index.corner();
        let [low, high] = [low, high].map(|[x, y, z]| Voxel::new(corner.x + x, corner.y + y, corner.z + z));
        let [lowest, highest] = ends.unwrap_or([low, high]);
        ends = Some([lowest.lowest(low), highest.highest(high)]);
    }
    ends.and_then(|[low, high]| VoxelBox::spanning(low, high))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeMap;

    fn voxel() -> impl Strategy<Value = Voxel> {
        (-20..20i32, -20..20i32, -20..20i32).prop_map(|(x, y, z)| Voxel::new(x, y, z))
    }

    fn state() -> impl Strategy<Value = State> {
        prop_oneof![Just(State::Free), Just(State::Occupied)]
    }

    proptest! {
        #[test]
        fn agrees_with_a_map_of_voxels(entries in prop::collection::vec((voxel(), state()), 0..200)) {
            let changes = Changes::from_voxels(entries.iter().copied());
            let model: BTreeMap<Voxel, State> = entries.into_iter().collect();
            prop_assert_eq!(changes.len(), model.len());
            for (voxel, state) in &model {
                prop_assert_eq!(changes.get(*voxel), *state);
            }
            let boxed = model.keys().copied().map(|v| VoxelBox::spanning(v, v).unwrap()).reduce(|a, b| a.union(&b));
            prop_assert_eq!(changes.bounding_box(), boxed);
            prop_assert_eq!(changes.voxels().collect::<BTreeMap<_, _>>(), model);
        }

        #[test]
        fn within_keeps_just_the_voxels_of_the_box(
            entries in prop::collection::vec((voxel(), state()), 0..200), a in voxel(), b in voxel(),
        ) {
            let region = VoxelBox::spanning(a, b).unwrap();
            let changes = Changes::from_voxels(entries);
            let expected: Vec<_> = changes.voxels().filter(|(v, _)| region.contains(*v)).collect();
            prop_assert_eq!(changes.within(&region).voxels().collect::<Vec<_>>(), expected);
        }
    }
}
