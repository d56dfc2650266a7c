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
        let mut among = found.iter();
        view.for_each_in(&region, |index, block| {
            assert_eq!((Some(&index), Some(*block)), (among.next(), view.block(index)));
        });
        prop_assert_eq!(among.next(), None);
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
                let mut block = map.block(index).unwrap_or_default();
                // All of it, now and then: so that blocks are emptied.
                if bit % 7 == 0 { block = StateBlock::default() } else { block.set(bit, state) }
                map.set_block(index, &block);
                model.insert(index, block);
            }
            model.retain(|_, block| !block.is_empty());
            prop_assert_eq!(map.blocks().collect::<BTreeMap<_, _>>(), model.clone());
            prop_assert_eq!(map.block_count(), model.len());
            if pause {
                continue;
            }
            // Some at a time, in ascending order of versions.
            while at < map.version() {
                let Some(changed) = map.versions_since(at) else {
                    mirror = MapView::new(resolution());
                    for (index, block) in map.blocks() {
                        mirror.set_block(index, &block);
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
                    mirror.set_block(index, &map.block(index).unwrap_or_default());
                }
            }
            prop_assert_eq!(mirror.blocks().collect::<BTreeMap<_, _>>(), model.clone());
        }
    }
}

/// What can be asked of a map, in order.
fn all_of(map: &MapView, versions: &[u64]) -> impl PartialEq + std::fmt::Debug + use<> {
    let blocks: BTreeMap<_, _> = map.blocks().collect();
    let each: Vec<_> = blocks.keys().map(|index| map.block(*index)).collect();
    let indices: Vec<_> =
        (-9..10).map(|x| BlockIndex::new(x, x & 7, 0)).chain(blocks.keys().copied()).collect();
    let changed: Vec<_> = versions.iter().map(|version| map.changed_since(*version)).collect();
    let since: Vec<_> = versions
        .iter()
        .map(|version| map.versions_since(*version).map(|since| since.collect::<BTreeMap<_, _>>()))
        .collect();
    let region = VoxelBox::spanning(Voxel::new(-20, -9, 0), Voxel::new(30, 40, 21)).unwrap();
    let within: BTreeMap<_, _> = map.blocks_in(&region).collect();
    let opened: BTreeMap<_, _> = map.open_in(&region).blocks().collect();
    let rays: Vec<_> = (0..9)
        .map(|n| {
            map.cast_ray([f64::from(n) * 3.0 - 20.0, 3.1, 0.3], [9.7, f64::from(n) - 7.0, 2.0], n % 2 == 0)
        })
        .collect();
    assert_eq!(opened, blocks);
    (
        (blocks, each, map.states_of(&indices), within, rays),
        (changed, since, map.version(), map.bounding_box(), map.count(), map.block_count()),
    )
}

proptest! {
    #[test]
    fn a_map_that_is_packed_now_and_then_is_one_that_never_was(
        steps in prop::collection::vec(
            (prop::collection::vec((index(1 << 20), any::<[u64; 2]>(), 0..9u8), 1..30), any::<bool>()), 1..12
        ),
    ) {
        let (mut map, mut never) = (MapView::new(resolution()), MapView::new(resolution()));
        let (mut copies, mut versions) = (Vec::new(), vec![0]);
        for (blocks, packs) in &steps {
            for (index, [free, occupied], kind) in blocks {
                let states = match kind {
                    0 => StateBlock::default(),
                    1 => never.block(*index).unwrap_or_default(),
                    2 => StateBlock::new([*free; 8], [*occupied & !*free; 8]),
                    _ => StateBlock::new([*free, 0, u64::MAX, 0, 0, 0, *free, 1], [0, *occupied, 0, 0, 7, 0, 0, 0]),
                };
                map.set_block(*index, &states);
                never.set_block(*index, &states);
            }
            let copy = map.clone();
            if *packs {
                map.pack();
                map.check_counts();
            }
            versions.push(never.version());
            copies.push((copy, never.clone()));
        }
        map.check_counts();
        never.check_counts();
        prop_assert_eq!(all_of(&map, &versions), all_of(&never, &versions));
        for (copy, never) in copies {
            copy.check_counts();
            prop_assert_eq!(all_of(&copy, &versions), all_of(&never, &versions), "a copy stays as it was");
        }
        // In place of what it was made from, which is packed too.
        let began = map.version();
        let (mut next, mut never_next) = (map.staged(), never.staged());
        for index in (-9..10).map(|x| BlockIndex::new(x, 0, 0)) {
            next.set_block(index, &StateBlock::new([5; 8], [0; 8]));
            never_next.set_block(index, &StateBlock::new([5; 8], [0; 8]));
            let later = BlockIndex::new(0, index.x, 0);
            map.set_block(later, &StateBlock::default());
            never.set_block(later, &StateBlock::default());
        }
        next.pack();
        map.pack();
        next.supersede(&map, began);
        never_next.supersede(&never, began);
        next.forget_emptied();
        never_next.forget_emptied();
        next.check_counts();
        prop_assert_eq!(all_of(&next, &versions), all_of(&never_next, &versions));
    }
}

#[test]
fn what_nothing_is_written_to_for_long_is_packed_a_bounded_part_at_a_time() {
    let mut map = MapView::new(resolution());
    let wall = StateBlock::new([0xFFFF; 8], [0xFF_0000; 8]);
    let dense =
        (0..16).flat_map(|x| (0..16).flat_map(move |y| (0..16).map(move |z| BlockIndex::new(x, y, z))));
    dense.for_each(|index| map.set_block(index, &wall));
    assert_eq!((map.block_count(), map.packed_count()), (4_096, 0));
    let open_bytes = map.memory_bytes();
    let here = |n: i32| BlockIndex::new(100 + n % 8, 0, 0);
    let mut most = 0;
    for n in 0..70_000 {
        let before = map.packed_count();
        // Nothing changes here any more: what is looked at stays open all the same.
        map.set_block(here(n), &wall);
        most = most.max(map.packed_count() - before);
        assert!(n < 20_000 || (4_096..4_104).contains(&map.packed_count()) || n < 60_000);
    }
    assert!((1..=512).contains(&most), "{most} blocks at once");
    assert_eq!((map.block_count(), map.packed_count()), (4_104, 4_096));
    map.check_counts();
    assert!(map.memory_bytes() < open_bytes / 20, "{} of {open_bytes} bytes", map.memory_bytes());
    assert_eq!(map.version(), 4_104, "to be packed is no change");
}

#[test]
fn a_region_that_was_emptied_before_it_was_packed_is_let_go() {
    let mut map = MapView::new(resolution());
    let far = |n: i32| BlockIndex::new(20 * n, 0, 0);
    (0..24).for_each(|n| map.set_block(far(n), &StateBlock::new([3; 8], [4; 8])));
    map.set_block(far(0), &StateBlock::default());
    map.pack();
    map.check_counts();
    assert_eq!((map.block(far(0)), map.changed_since(24)), (None, Some(vec![far(0)])));
    (1..4).for_each(|n| map.set_block(far(n), &StateBlock::default()));
    map.check_counts();
    assert_eq!((map.block_count(), map.changed_since(24)), (20, None));
    (4..24).for_each(|n| map.set_block(far(n), &StateBlock::default()));
    map.check_counts();
    assert!(map.block_count() == 0 && map.changed_since(map.version()) == Some(Vec::new()));
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
