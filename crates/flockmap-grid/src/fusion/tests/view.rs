//! What a planner reads of the map.

use super::*;

fn index(reach: i32) -> impl Strategy<Value = BlockIndex> {
    // In a few regions, beside their borders, and far away.
    let axis = move || prop_oneof![6 => -9..10i32, 1 => -reach..reach];
    (axis(), axis(), axis()).prop_map(|(x, y, z)| BlockIndex::new(x, y, z))
}

proptest! {
    #[test]
    fn the_blocks_in_a_box_are_those_that_share_voxels_with_it(
        blocks in prop::collection::btree_map(index(1 << 20), any::<bool>(), 0..80),
        a in index(1 << 25), b in index(1 << 25), from in [0..8i32, 0..8, 0..8], to in [0..8i32, 0..8, 0..8],
    ) {
        let mut view = MapView::new(resolution());
        for (index, is_kept) in &blocks {
            view.set_block(*index, &StateBlock::new([3; 8], [1; 8]));
            if !is_kept {
                view.set_block(*index, &StateBlock::default());
            }
        }
        let inside = |index: BlockIndex, [x, y, z]: [i32; 3]| {
            let corner = index.corner();
            Voxel::new(corner.x + x, corner.y + y, corner.z + z)
        };
        let region = VoxelBox::spanning(inside(a, from), inside(b, to)).unwrap();
        let mut found: Vec<BlockIndex> = view.blocks_in(&region).map(|(index, block)| {
            assert_eq!(Some(block), view.block(index));
            index
        }).collect();
        found.sort_unstable();
        let known = || blocks.iter().filter(|(_, is_kept)| **is_kept).map(|(index, _)| *index);
        let expected: Vec<BlockIndex> =
            known().filter(|index| index.voxel_box().intersection(&region).is_some()).collect();
        prop_assert_eq!(found, expected);

        // Of each block the voxels with x 0 and 1 in the rows with y 0 are known.
        let ends = known().map(|index| {
            VoxelBox::spanning(inside(index, [0, 0, 0]), inside(index, [1, 0, 7])).unwrap()
        });
        prop_assert_eq!(view.bounding_box(), ends.reduce(|a, b| a.union(&b)));
    }

    #[test]
    fn who_takes_over_what_changed_has_the_same_map(
        steps in prop::collection::vec(prop::collection::vec(([-3..3i32, -3..3, 0..2], 0..512usize, 0..3u8), 1..30), 1..20),
        pauses in prop::collection::vec(any::<bool>(), 20),
        at_once in 1..8usize,
    ) {
        let mut map = MapView::new(resolution());
        let mut model = BTreeMap::new();
        let mut mirror = MapView::new(resolution());
        let mut at = 0;
        for (step, pause) in steps.into_iter().zip(pauses) {
            for ([x, y, z], bit, state) in step {
                let index = BlockIndex::new(x, y, z);
                let state = [State::Unknown, State::Free, State::Occupied][usize::from(state)];
                let mut block = map.block(index).copied().unwrap_or_default();
                // All of it, now and then: so that blocks are emptied.
                if bit % 7 == 0 { block = StateBlock::default() } else { block.set(bit, state) }
                map.set_block(index, &block);
                model.insert(index, block);
            }
            model.retain(|_, block| !block.is_empty());
            prop_assert_eq!(map.blocks().map(|(i, b)| (i, *b)).collect::<BTreeMap<_, _>>(), model.clone());
            prop_assert_eq!(map.block_count(), model.len());
            if pause {
                continue;
            }
            // Some at a time, in ascending order of versions.
            while at < map.version() {
                let Some(changed) = map.versions_since(at) else {
                    mirror = MapView::new(resolution());
                    for (index, block) in map.blocks() {
                        mirror.set_block(index, block);
                    }
                    at = map.version();
                    break;
                };
                let mut changed: Vec<_> = changed.map(|(index, version)| (version, index)).collect();
                changed.sort_unstable();
                changed.truncate(at_once);
                let Some((last, _)) = changed.last() else { break };
                at = *last;
                for (_, index) in changed {
                    mirror.set_block(index, &map.block(index).copied().unwrap_or_default());
                }
            }
            prop_assert_eq!(mirror.blocks().map(|(i, b)| (i, *b)).collect::<BTreeMap<_, _>>(), model.clone());
        }
    }
}

#[test]
fn rays_stop_at_obstacles_and_at_the_unknown() {
    let mapper = mapper();
    let mut fusion = Fusion::new(OWN, resolution(), FusionConfig::default());
    let free = (0..10).map(|x| (Voxel::new(x, 0, 0), State::Free));
    let changes = Changes::from_voxels(free.chain([(Voxel::new(10, 0, 0), State::Occupied)]));
    fusion.apply(&mapper, stream(2), &changes, Stamp(1), Stamp(1)).unwrap();
    let from = [0.25, 0.25, 0.25];
    let hit = fusion.map().cast_ray(from, [8.25, 0.25, 0.25], false);
    assert_eq!(hit, RayEnd::Occupied { voxel: Voxel::new(10, 0, 0), distance_m: 4.75 });
    assert_eq!(fusion.map().cast_ray(from, [4.0, 0.25, 0.25], false), RayEnd::Clear);
    let up = fusion.map().cast_ray(from, [0.25, 0.25, 2.0], false);
    assert_eq!(up, RayEnd::Unknown { voxel: Voxel::new(0, 0, 1), distance_m: 0.25 });
    assert_eq!(fusion.map().cast_ray(from, [0.25, 0.25, 2.0], true), RayEnd::Clear);
}
