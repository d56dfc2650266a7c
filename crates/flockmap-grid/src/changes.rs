//! A set of voxels with their new state: what one map package says.

use crate::block::{bit_of, voxel_bit};
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
        self.blocks.iter().flat_map(|(index, block)| {
            let corner = index.corner();
            let known = block.known();
            (0..8).flat_map(move |z| {
                Bits(known[z]).map(move |bit| {
                    let bit = z * 64 + bit;
                    let [x, y, z] = bit_of(bit);
                    (Voxel::new(corner.x + x, corner.y + y, corner.z + z), block.get(bit))
                })
            })
        })
    }

    /// As [`Self::voxels`], without borrowing.
    pub fn into_voxels(self) -> impl Iterator<Item = (Voxel, State)> {
        self.blocks.into_iter().flat_map(|pair| Self { blocks: vec![pair] }.voxels().collect::<Vec<_>>())
    }

    /// The smallest box that holds every change (the paper's "local OGM box"); `None` if there is none.
    pub fn bounding_box(&self) -> Option<VoxelBox> {
        let mut min = [i32::MAX; 3];
        let mut max = [i32::MIN; 3];
        for (index, block) in &self.blocks {
            let known = block.known();
            let (low, high) = extent(&known);
            let corner = index.corner();
            for (axis, c) in [corner.x, corner.y, corner.z].into_iter().enumerate() {
                min[axis] = min[axis].min(c + low[axis]);
                max[axis] = max[axis].max(c + high[axis]);
            }
        }
        if self.blocks.is_empty() {
            return None;
        }
        VoxelBox::spanning(Voxel::new(min[0], min[1], min[2]), Voxel::new(max[0], max[1], max[2]))
    }

    /// The changes that lie in `region`.
    pub fn within(&self, region: &VoxelBox) -> Self {
        let mut blocks = Vec::new();
        for (index, block) in &self.blocks {
            if let Some(part) = index.voxel_box().intersection(region) {
                let block =
                    if part.volume() == 512 { *block } else { block.masked(&plane_of(*index, &part)) };
                if !block.is_empty() {
                    blocks.push((*index, block));
                }
            }
        }
        Self { blocks }
    }
}

/// Lowest and highest x, y, z (0 … 7) of the set bits; `[7; 3]` and `[0; 3]` if none is set.
fn extent(plane: &Plane) -> ([i32; 3], [i32; 3]) {
    let mut low = [7; 3];
    let mut high = [0; 3];
    let mut flat = 0u64;
    for (z, &word) in plane.iter().enumerate() {
        if word != 0 {
            low[2] = low[2].min(z as i32);
            high[2] = z as i32;
        }
        flat |= word;
    }
    if flat != 0 {
        low[1] = (flat.trailing_zeros() / 8) as i32;
        high[1] = (7 - flat.leading_zeros() / 8) as i32;
        let mut row = flat;
        row |= row >> 32;
        row |= row >> 16;
        row |= row >> 8;
        let row = row as u8;
        low[0] = row.trailing_zeros() as i32;
        high[0] = 7 - row.leading_zeros() as i32;
    }
    (low, high)
}

/// The bits of `block` that lie in `part`, a box inside that block.
fn plane_of(block: BlockIndex, part: &VoxelBox) -> Plane {
    let corner = block.corner();
    let (min, max) = (part.min(), part.max());
    let ones = |low: i32, high: i32| (0xffu64 << low) & (0xff >> (7 - high));
    let row = ones(min.x - corner.x, max.x - corner.x);
    let mut slice = 0;
    for y in min.y - corner.y..=max.y - corner.y {
        slice |= row << (y * 8);
    }
    core::array::from_fn(
        |z| {
            if (min.z - corner.z..=max.z - corner.z).contains(&(z as i32)) { slice } else { 0 }
        },
    )
}

/// The numbers of the set bits of a word, ascending.
struct Bits(u64);

impl Iterator for Bits {
    type Item = usize;

    fn next(&mut self) -> Option<usize> {
        if self.0 == 0 {
            return None;
        }
        let bit = self.0.trailing_zeros() as usize;
        self.0 &= self.0 - 1;
        Some(bit)
    }
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
