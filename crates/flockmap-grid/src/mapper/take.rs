//! Which changes are taken from the map to be published.

use super::{Mapper, Which};
use crate::{BlockIndex, Changes, Plane, StateBlock};

impl Which {
    fn of(self, changes: &StateBlock, except_free: Plane) -> StateBlock {
        let free = core::array::from_fn(|word| changes.free()[word] & !except_free[word]);
        match self {
            Self::All => StateBlock::new(free, *changes.occupied()),
            Self::Occupied => StateBlock::new([0; 8], *changes.occupied()),
            Self::Free => StateBlock::new(free, [0; 8]),
        }
    }
}

impl Mapper {
    /// Number of voxels whose state differs from what was taken last (the paper's `ChangesInList(S)`).
    pub const fn pending(&self) -> usize {
        self.pending
    }

    /// Takes the net changes: each voxel whose state now differs from its state when it was last taken. One
    /// that flipped and flipped back, or has become Unknown, is none of them.
    pub fn take_changes(&mut self, which: Which) -> Changes {
        let blocks: Vec<BlockIndex> = self.pending_blocks.keys().copied().collect();
        self.take_from(blocks, which, usize::MAX, |_| [0; 8]).0
    }

    /// Takes the net changes of the blocks nearest to a block, as whole blocks, until the next one would make
    /// them more than `voxels_max`; but always those of one block. The others stay for the next time; so do
    /// voxels that have become Free and are in `except_free` of their block. Also says whether it came to
    /// `voxels_max`. O(n log n) for n blocks with changes.
    pub fn take_nearest(
        &mut self,
        which: Which,
        centre: BlockIndex,
        voxels_max: usize,
        except_free: impl Fn(BlockIndex) -> Plane,
    ) -> (Changes, bool) {
        let mut blocks: Vec<BlockIndex> = self.pending_blocks.keys().copied().collect();
        if voxels_max < self.pending {
            blocks.sort_unstable_by_key(|block| (block.distance_squared(centre), *block));
        }
        self.take_from(blocks, which, voxels_max, except_free)
    }

    /// How many changes there are to take, but for voxels that have become Free and are in `except_free` of
    /// their block. O(blocks with changes).
    pub fn count_changes(&self, which: Which, except_free: impl Fn(BlockIndex) -> Plane) -> usize {
        let blocks = self.pending_blocks.keys().filter_map(|index| Some((*index, self.blocks.get(*index)?)));
        blocks
            .map(|(index, block)| which.of(&block.changes(), except_free(index)).known_count() as usize)
            .sum()
    }

    fn take_from(
        &mut self,
        blocks: Vec<BlockIndex>,
        which: Which,
        voxels_max: usize,
        except_free: impl Fn(BlockIndex) -> Plane,
    ) -> (Changes, bool) {
        let (mut taken, mut voxels, mut is_cut) = (Vec::with_capacity(blocks.len()), 0, false);
        for index in blocks {
            let Some(known) = self.pending_blocks.get_mut(&index) else { continue };
            let Some(block) = self.blocks.get_mut(index) else {
                self.pending_blocks.remove(&index);
                continue;
            };
            let all = block.changes();
            let part = which.of(&all, except_free(index));
            let (part_count, left) = (part.known_count(), all.known_count() - part.known_count());
            if voxels > 0 && voxels + part_count as usize > voxels_max {
                is_cut = true;
                break;
            }
            voxels += part_count as usize;
            block.mark_packed(&part);
            self.pending -= *known as usize - left as usize;
            *known = left;
            if left == 0 {
                self.pending_blocks.remove(&index);
            }
            if part_count > 0 {
                // A block begins anew only where the sheet has room.
                taken.extend(block.sheet.block(index).map(|index| (index, part)));
            }
        }
        taken.sort_unstable_by_key(|(index, _)| *index);
        (Changes::from_blocks(taken), is_cut)
    }
}

impl BlockIndex {
    /// The square of the distance between the centres of two blocks, in blocks.
    pub(super) fn distance_squared(self, other: Self) -> i64 {
        let axis = |a: i32, b: i32| (i64::from(a) - i64::from(b)).pow(2);
        axis(self.x, other.x) + axis(self.y, other.y) + axis(self.z, other.z)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{MapperConfig, Pose, Preset, Resolution, Scan, Stamp, State};
    use proptest::prelude::*;

    fn mapper(points: &[[f32; 3]]) -> Mapper {
        let resolution = Resolution::from_metres(0.1).unwrap();
        let mut mapper = Mapper::new(MapperConfig::preset(Preset::RogMap, resolution, 20.0)).unwrap();
        let scan = Scan { stamp: Stamp(1), points: points.to_vec(), no_returns: Vec::new() };
        mapper.insert(&scan, &Pose::IDENTITY, &[]);
        mapper
    }

    fn none(_: BlockIndex) -> Plane {
        [0; 8]
    }

    #[test]
    fn what_somebody_else_knows_better_stays() {
        let mut mapper = mapper(&[[8.0, 0.0, 0.0]]);
        let all = mapper.pending();
        let one = |block: BlockIndex| {
            if block == BlockIndex::new(1, 0, 0) { [3, 0, 0, 0, 0, 0, 0, 0] } else { [0; 8] }
        };
        assert_eq!(
            (mapper.count_changes(Which::All, none), mapper.count_changes(Which::All, one)),
            (all, all - 2)
        );
        let (most, is_cut) = mapper.take_nearest(Which::All, BlockIndex::new(0, 0, 0), all, one);
        assert_eq!((most.len(), mapper.pending(), is_cut), (all - 2, 2, false));
        assert!(most.has_occupied());
        let (nothing, _) = mapper.take_nearest(Which::All, BlockIndex::new(0, 0, 0), all, one);
        assert!(nothing.is_empty());
        let rest = mapper.take_changes(Which::All);
        assert_eq!(rest.voxels().map(|(voxel, _)| voxel.x).collect::<Vec<_>>(), [8, 9]);
    }

    #[test]
    fn the_nearest_blocks_go_first_and_the_rest_stays() {
        let mut mapper = mapper(&[[8.0, 0.0, 0.0]]);
        let all = mapper.pending();
        let here = BlockIndex::new(0, 0, 0);
        let (near, is_cut) = mapper.take_nearest(Which::All, here, 20, none);
        assert!(near.len() <= 20 && near.blocks().iter().all(|(block, _)| block.x <= 2), "{near:?}");
        assert!(is_cut);
        assert_eq!(mapper.pending(), all - near.len());
        let (obstacles, is_cut) = mapper.take_nearest(Which::Occupied, here, 20, none);
        assert!(obstacles.has_occupied() && !is_cut);
        assert_eq!(mapper.count_changes(Which::Occupied, none), 0);
        assert_eq!(mapper.count_changes(Which::Free, none), mapper.pending());
        // One block is taken even if it has more: otherwise nothing would ever go.
        let (far, _) = mapper.take_nearest(Which::All, BlockIndex::new(10, 0, 0), 1, none);
        assert_eq!(far.blocks().len(), 1);
        assert!(far.len() > 1 && far.blocks()[0].0.x >= 9);
    }

    proptest! {
        #[test]
        fn parts_make_up_the_whole(
            points in prop::collection::vec([-9.0f32..9.0, -9.0f32..9.0, -2.0f32..2.0], 1..60),
            parts in prop::collection::vec((0..3u8, 0..400usize, [-9..9i32, -9..9, -2..2]), 0..20),
        ) {
            let (mut whole, mut in_parts) = (mapper(&points), mapper(&points));
            let whole = whole.take_changes(Which::All);
            let mut taken = Vec::new();
            let mut take = |changes: Changes, which: Which| {
                for (voxel, state) in changes.voxels() {
                    assert!(which == Which::All || (state == State::Free) == (which == Which::Free));
                    taken.push((voxel, state));
                }
            };
            for (which, voxels_max, [x, y, z]) in parts {
                let which = [Which::All, Which::Occupied, Which::Free][usize::from(which)];
                let (had, before) = (in_parts.count_changes(which, none) > 0, in_parts.pending());
                let (part, is_cut) = in_parts.take_nearest(which, BlockIndex::new(x, y, z), voxels_max, none);
                prop_assert_eq!(had, !part.is_empty());
                prop_assert_eq!(is_cut, in_parts.count_changes(which, none) > 0);
                prop_assert!(part.len() <= voxels_max || part.blocks().len() == 1);
                prop_assert_eq!(in_parts.pending(), before - part.len());
                take(part, which);
            }
            take(in_parts.take_changes(Which::All), Which::All);
            prop_assert_eq!(in_parts.pending(), 0);
            prop_assert_eq!(taken.len(), whole.len(), "nothing is taken twice");
            prop_assert_eq!(Changes::from_voxels(taken), whole);
        }
    }
}
