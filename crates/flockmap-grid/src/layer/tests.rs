//! A layer beside a naive model.

mod dropped;

use std::collections::BTreeMap;

use super::sensors::SENSORS_NOTED_MIN;
use super::*;
use crate::SnapshotVoxels;
use proptest::prelude::*;

/// What it counts as it goes is what there is.
fn check_counts(layer: &Layer) {
    let (mut blocks, mut voxels, mut open, mut open_bytes, mut packed_bytes) = (0, 0, 0, 0, 0);
    for place in layer.cubes.values() {
        blocks += place.read().len();
        voxels += place.read().parts().iter().map(|b| b.states.known_count() as usize).sum::<usize>();
        match place {
            Place::Open(place) => {
                open += place.cube.len();
                open_bytes += OPEN_BYTES + place.cube.memory_bytes();
            }
            Place::Packed(packed) => {
                packed_bytes += packed.memory_bytes();
                assert!(packed.unpack().memory_bytes() <= packed.open_bytes());
            }
        }
    }
    let counted = (layer.blocks, layer.voxels, layer.open, layer.open_bytes, layer.packed_bytes);
    assert_eq!(counted, (blocks, voxels, open, open_bytes, packed_bytes));
    assert_eq!(layer.packed_count(), blocks - open);
}

/// What can be asked of a layer.
fn all_of(layer: &Layer, stamps: &[Stamp]) -> impl PartialEq + std::fmt::Debug + use<> {
    let mut blocks: Vec<_> = layer.blocks().collect();
    blocks.sort_unstable_by_key(|(index, _)| *index);
    let voxels: Vec<_> =
        layer.voxels().map(|(voxel, _)| (voxel, layer.get(voxel), layer.state(voxel))).collect();
    let before: Vec<_> = blocks
        .iter()
        .flat_map(|(index, _)| {
            stamps.iter().map(|stamp| layer.known_before(*index, *stamp)).collect::<Vec<_>>()
        })
        .collect();
    let since: Vec<_> = stamps.iter().map(|stamp| layer.snapshot_since(*stamp)).collect();
    (
        blocks,
        voxels,
        before,
        since,
        layer.digest(),
        (layer.len(), layer.newest(), layer.sensors.by_stamp().clone()),
    )
}

proptest! {
    #[test]
    fn a_layer_that_is_packed_now_and_then_is_one_that_never_was(
        steps in prop::collection::vec((package(), prop::bool::weighted(0.2), prop::bool::weighted(0.3)), 1..40),
    ) {
        let (mut layer, mut never) = (Layer::default(), Layer::default());
        // Few stamps, so that batches have several packages and some come late.
        for ((stamp, voxels), is_snapshot, packs) in &steps {
            let stamp = Stamp(stamp.0 / 100);
            let changes = Changes::from_voxels(voxels.iter().copied());
            if *packs {
                layer.pack();
                prop_assert_eq!(layer.packed_count(), layer.block_count());
            }
            for layer in [&mut layer, &mut never] {
                match changes.bounding_box().filter(|_| *is_snapshot) {
                    Some(region) => {
                        let parts = vec![(stamp, changes.clone())];
                        layer.apply_snapshot(&Snapshot { region, parts, sensors: vec![(stamp, [1, 2, 3])] });
                    }
                    None => drop(layer.apply(&changes, stamp)),
                }
            }
        }
        let stamps: Vec<Stamp> = (0..9).map(Stamp).collect();
        check_counts(&layer);
        check_counts(&never);
        prop_assert_eq!(all_of(&layer, &stamps), all_of(&never, &stamps));
        layer.pack();
        check_counts(&layer);
        prop_assert_eq!(all_of(&layer, &stamps), all_of(&never, &stamps));
        let mut copy = never.clone();
        check_counts(&copy);
        copy.pack();
        check_counts(&copy);
        prop_assert_eq!(all_of(&copy, &stamps), all_of(&never, &stamps));
        let mut copy = layer.clone();
        copy.apply(&Changes::from_voxels([(Voxel::new(1, 1, 1), State::Occupied)]), Stamp(100));
        prop_assert_eq!(all_of(&layer, &stamps), all_of(&never, &stamps), "a copy is one of its own");
    }
}

#[test]
fn what_had_nothing_for_long_is_packed_and_what_is_seen_again_and_again_is_not() {
    let mut layer = Layer::default();
    let wall = |x: i32| Changes::from_voxels((0..8).map(|y| (Voxel::new(x, y, 0), State::Occupied)));
    for step in 0..90_000 {
        layer.apply(&wall(40 * step), Stamp(2 * i64::from(step)));
        layer.apply(&wall(-1), Stamp(2 * i64::from(step) + 1));
    }
    assert!(layer.open < 66_000, "{} of {} are open", layer.open, layer.block_count());
    assert!(layer.packed_count() > 0);
    assert!(matches!(layer.cubes[&cube_of(Voxel::new(-1, 0, 0).block())], Place::Open(_)));
    check_counts(&layer);
}

#[test]
fn stamps_by_the_hundred_and_far_from_each_other_are_packed_as_they_are() {
    let mut layer = Layer::default();
    let stamps = [i64::MIN, -1, 0, 1, i64::MAX / 2, i64::MAX];
    for (n, voxel) in (0..40_000i32).map(|n| (n, Voxel::new(n % 32, n / 32 % 32, n / 1024 % 32))) {
        let stamp = if n % 9 == 0 { stamps[n as usize / 9 % 6] } else { i64::from(n) * 1_000_003 % 777_777 };
        let state = if n % 5 == 0 { State::Occupied } else { State::Free };
        layer.apply(&Changes::from_voxels([(voxel, state)]), Stamp(stamp));
    }
    let never = layer.clone();
    layer.pack();
    assert_eq!(layer.packed_count(), 64);
    let some = [i64::MIN, 0, 5, 400_000, i64::MAX].map(Stamp);
    assert_eq!(all_of(&layer, &some), all_of(&never, &some));
    check_counts(&layer);
}

fn package() -> impl Strategy<Value = (Stamp, Vec<(Voxel, State)>)> {
    let voxel = (-6..12i32, -6..12i32, -3..9i32).prop_map(|(x, y, z)| Voxel::new(x, y, z));
    let state = prop_oneof![Just(State::Free), Just(State::Occupied)];
    (0..700i64, prop::collection::vec((voxel, state), 1..40)).prop_map(|(stamp, v)| (Stamp(stamp), v))
}

proptest! {
    #[test]
    fn the_newest_word_on_each_voxel_stays_in_any_order(
        packages in prop::collection::vec(package(), 0..60).prop_shuffle(),
    ) {
        let mut layer = Layer::default();
        let mut model = BTreeMap::<Voxel, (Stamp, bool)>::new();
        for (stamp, voxels) in &packages {
            let changes = Changes::from_voxels(voxels.iter().copied());
            let before = (layer.memory_bytes(), layer.block_count());
            if stamp.0 % 7 == 0 {
                layer.pack();
            }
            let before = (layer.memory_bytes(), before.1);
            let (growth, new_blocks) = layer.growth_max(std::iter::once(&changes));
            let taken = layer.apply(&changes, *stamp);
            prop_assert!(layer.memory_bytes() <= before.0 + growth, "{} after {:?}", growth, before);
            prop_assert_eq!(layer.block_count(), before.1 + new_blocks);
            let mut expected = 0;
            for (voxel, state) in changes.voxels() {
                let word = (*stamp, state == State::Occupied);
                let known = model.get(&voxel).copied();
                if known.is_none_or(|known| known < word) {
                    model.insert(voxel, word);
                    expected += 1;
                }
            }
            let count: u32 = taken.iter().map(|(_, m)| m.iter().map(|w| w.count_ones()).sum::<u32>()).sum();
            prop_assert_eq!(count, expected);
        }
        prop_assert_eq!(layer.len(), model.len());
        check_counts(&layer);
        prop_assert_eq!(layer.memory_bytes_with(0), layer.memory_bytes());
        for (voxel, (stamp, occupied)) in &model {
            let state = if *occupied { State::Occupied } else { State::Free };
            prop_assert_eq!(layer.get(*voxel), Some((state, *stamp)));
        }
        // Its snapshot makes the same layer again.
        let mut again = Layer::default();
        if let Some(snapshot) = layer.snapshot() {
            for (stamp, part) in snapshot.parts.iter().rev() {
                prop_assert_eq!(part.within(&snapshot.region), part.clone());
                again.apply(part, *stamp);
            }
        }
        prop_assert_eq!(again.digest(), layer.digest());
        if let Some(snapshot) = layer.snapshot() {
            let (mut at_once, parts) = (Layer::default(), snapshot.parts.iter().map(|(_, part)| part));
            let (growth, new_blocks) = at_once.growth_max(parts);
            at_once.apply_snapshot(&snapshot);
            prop_assert!(at_once.memory_bytes() <= growth);
            prop_assert_eq!(at_once.block_count(), new_blocks);
        }
    }

    /// Against a layer that never forgets a sensor of its own accord.
    #[test]
    fn sensors_are_forgotten_only_where_no_voxel_of_their_batch_stands(
        packages in prop::collection::vec(package(), 1..60).prop_shuffle(), rounds in 1..30u64,
    ) {
        let (mut layer, mut all) = (Layer::default(), BTreeMap::new());
        for round in 0..rounds as i64 {
            for (stamp, voxels) in &packages {
                let stamp = Stamp(stamp.0 + 700 * round);
                layer.apply(&Changes::from_voxels(voxels.iter().copied()), stamp);
                let sensor = [stamp.0 as i32, 1, 2];
                layer.note_sensor(stamp, sensor);
                all.insert(stamp, sensor);
            }
        }
        layer.forget_sensors();
        let snapshot = layer.snapshot().unwrap();
        let standing: Vec<_> = snapshot.parts.iter().map(|(stamp, _)| (*stamp, all[stamp])).collect();
        prop_assert_eq!(&snapshot.sensors, &standing, "every sensor of a batch that stands is there");
        prop_assert_eq!(layer.sensors.by_stamp().len(), standing.len(), "and no other");
    }

    #[test]
    fn what_is_newer_than_a_stamp_completes_a_layer_that_knows_the_rest(
        packages in prop::collection::vec(package(), 0..40).prop_shuffle(), limit in 0..700i64,
    ) {
        let (mut layer, mut older) = (Layer::default(), Layer::default());
        for (stamp, voxels) in &packages {
            let changes = Changes::from_voxels(voxels.iter().copied());
            layer.apply(&changes, *stamp);
            if stamp.0 <= limit {
                older.apply(&changes, *stamp);
            }
        }
        layer.note_sensor(Stamp(3), [1, 2, 3]);
        let since = layer.snapshot_since(Stamp(limit));
        prop_assert_eq!(since.is_none(), packages.iter().all(|(stamp, _)| stamp.0 <= limit));
        if let Some(since) = &since {
            prop_assert!(since.parts.iter().all(|(stamp, part)| stamp.0 > limit && !part.is_empty()));
            prop_assert!(since.parts.is_sorted_by(|a, b| a.0 < b.0));
            let boxes = since.parts.iter().filter_map(|(_, part)| part.bounding_box());
            prop_assert_eq!(boxes.reduce(|a, b| a.union(&b)), Some(since.region));
            older.apply_snapshot(since);
            let voxels = SnapshotVoxels::from_state(since).unwrap();
            prop_assert_eq!(&voxels.to_state(), since);
            for voxels_max in [1, 30, 10_000] {
                let mut again = Layer::default();
                for run in voxels.runs(voxels_max) {
                    let count: usize = run.iter().map(|(_, part)| part.len()).sum();
                    let blocks: std::collections::BTreeSet<_> =
                        run.iter().flat_map(|(_, part)| part.blocks()).map(|(index, _)| *index).collect();
                    prop_assert!(count > 0 && (count <= voxels_max || blocks.len() == 1));
                    prop_assert!(run.is_sorted_by(|a, b| a.0 < b.0));
                    prop_assert!(blocks.iter().all(|index| again.block(*index).is_none()));
                    run.iter().for_each(|(stamp, part)| drop(again.apply(part, *stamp)));
                }
                let mut whole = Layer::default();
                whole.apply_snapshot(since);
                prop_assert_eq!(again.digest(), whole.digest());
            }
        }
        prop_assert_eq!(older.digest(), layer.digest());
        let newest = layer.snapshot_since(Stamp(i64::MIN));
        prop_assert_eq!(newest, layer.snapshot());
    }
}

proptest! {
    #[test]
    fn what_was_before_a_batch_is_right_or_refused(
        packages in prop::collection::vec((package(), prop::bool::weighted(0.2)), 0..30),
    ) {
        // Few stamps, so that batches have several packages and some come late.
        let mut layer = Layer::default();
        let mut applied: Vec<(Stamp, Vec<(Voxel, State)>)> = Vec::new();
        let has_snapshot = packages.iter().any(|(_, is_snapshot)| *is_snapshot);
        for ((stamp, voxels), is_snapshot) in &packages {
            let stamp = Stamp(stamp.0 / 100);
            let changes = Changes::from_voxels(voxels.iter().copied());
            match changes.bounding_box().filter(|_| *is_snapshot) {
                Some(region) => {
                    let parts = vec![(stamp, changes.clone())];
                    layer.apply_snapshot(&Snapshot { region, parts, sensors: Vec::new() });
                }
                None => {
                    layer.apply(&changes, stamp);
                }
            }
            applied.push((stamp, changes.voxels().collect()));
            let in_order = applied.is_sorted_by_key(|(stamp, _)| *stamp);
            let newest = applied.iter().map(|(stamp, _)| *stamp).max().unwrap_or_default();
            for at in (0..9).map(Stamp) {
                let mut expected = Layer::default();
                for (stamp, voxels) in applied.iter().filter(|(stamp, _)| *stamp < at) {
                    expected.apply(&Changes::from_voxels(voxels.iter().copied()), *stamp);
                }
                for (index, _) in layer.blocks() {
                    match layer.block_before(index, at) {
                        Ok(before) => {
                            let expected = expected.block(index).unwrap_or_default();
                            prop_assert_eq!(before.unwrap_or_default(), expected);
                        }
                        Err(_) => prop_assert!(newest > at || has_snapshot || !in_order),
                    }
                }
            }
        }
    }
}

#[test]
fn a_package_of_an_older_batch_that_comes_late_joins_the_past_where_that_is_certain() {
    let voxel = |x, state| Changes::from_voxels([(Voxel::new(x, 0, 0), state)]);
    let mut layer = Layer::default();
    let block = Voxel::new(0, 0, 0).block();
    layer.apply(&voxel(0, State::Free), Stamp(10));
    layer.apply(&voxel(1, State::Free), Stamp(20));
    layer.apply(&voxel(2, State::Occupied), Stamp(20));
    let before = layer.block_before(block, Stamp(20)).unwrap().unwrap();
    assert_eq!([0, 1, 2].map(|bit| before.get(bit)), [State::Free, State::Unknown, State::Unknown]);
    assert!(layer.block_before(block, Stamp(10)).is_err());
    // Between both, of a voxel that was not known before.
    layer.apply(&voxel(3, State::Free), Stamp(15));
    let before = layer.block_before(block, Stamp(20)).unwrap().unwrap();
    assert_eq!([0, 1, 3].map(|bit| before.get(bit)), [State::Free, State::Unknown, State::Free]);
    layer.apply(&voxel(0, State::Occupied), Stamp(15));
    assert!(layer.block_before(block, Stamp(20)).is_err());
    assert_eq!(layer.block_before(block, Stamp(21)).unwrap(), layer.block(block));
}

#[test]
fn a_snapshot_hides_what_was_before_its_newest_batch_and_not_what_is_before_later_ones() {
    let voxel = |x, state| Changes::from_voxels([(Voxel::new(x, 0, 0), state)]);
    let block = Voxel::new(0, 0, 0).block();
    let snapshot = Snapshot {
        sensors: Vec::new(),
        region: block.corner().block().voxel_box(),
        parts: vec![(Stamp(10), voxel(0, State::Free)), (Stamp(20), voxel(1, State::Free))],
    };
    let mut layer = Layer::default();
    layer.apply(&voxel(0, State::Free), Stamp(10));
    layer.apply_snapshot(&snapshot);
    for stamp in [10, 15, 20] {
        assert!(layer.block_before(block, Stamp(stamp)).is_err());
    }
    // A later batch, by one package or two, knows what was before it.
    let expected = layer.block(block).unwrap();
    assert_eq!(layer.block_before(block, Stamp(21)), Ok(Some(expected)));
    layer.apply(&voxel(2, State::Occupied), Stamp(30));
    assert_eq!(layer.block_before(block, Stamp(30)), Ok(Some(expected)));
    // Nor does a chunk that says nothing new hide it.
    layer.apply_snapshot(&snapshot);
    assert_eq!(layer.block_before(block, Stamp(30)), Ok(Some(expected)));
}

#[test]
fn a_block_of_512_different_stamps_and_then_many_more() {
    let mut layer = Layer::default();
    for round in 0..5i64 {
        for bit in 0..512i64 {
            let voxel = Voxel::new((bit & 7) as i32, (bit >> 3 & 7) as i32, (bit >> 6) as i32);
            let state = if (bit + round) % 3 == 0 { State::Occupied } else { State::Free };
            layer.apply(&Changes::from_voxels([(voxel, state)]), Stamp(round * 1000 + bit));
            assert_eq!(layer.get(voxel), Some((state, Stamp(round * 1000 + bit))));
        }
        assert_eq!(layer.get(Voxel::new(3, 2, 1)).unwrap().1, Stamp(round * 1000 + 64 + 16 + 3));
    }
    assert!(layer.memory_bytes() <= LAYER_BLOCK_BYTES_MAX, "{}", layer.memory_bytes());
}

#[test]
fn sensors_of_a_flight_that_sees_the_same_place_again_and_again_do_not_pile_up() {
    let mut layer = Layer::default();
    let kept =
        |batch: i64| if batch % 100 == 0 { Voxel::new(batch as i32, 50, 0) } else { Voxel::new(1, 1, 1) };
    for batch in 0..20_000 {
        layer.apply(&Changes::from_voxels([(kept(batch), State::Free)]), Stamp(batch));
        layer.note_sensor(Stamp(batch), [batch as i32, 0, 0]);
        // 200 batches stand at the end, and the blocks are as few.
        assert!(
            layer.sensors.by_stamp().len() < 200 + 2 * SENSORS_NOTED_MIN,
            "{} of {batch}",
            layer.sensors.by_stamp().len()
        );
    }
    let snapshot = layer.snapshot().unwrap();
    assert_eq!(snapshot.sensors.len(), snapshot.parts.len());
    // A snapshot says where its batches were seen from.
    let mut again = Layer::default();
    again.apply_snapshot(&snapshot);
    assert_eq!(again.snapshot().unwrap(), snapshot);
}

#[test]
fn a_call_that_notes_a_sensor_goes_through_a_bounded_part_of_the_layer_and_in_time_through_all() {
    let mut layer = Layer::default();
    // Two stamps to a block: what is older than the last two rounds does not stand.
    let block = |number: i32| Voxel::new(8 * (number % 64), 8 * (number / 64), 0);
    let (blocks, cube) = (8_192, 64);
    for number in 0..blocks {
        let changes = Changes::from_voxels([(block(number), State::Free)]);
        layer.apply(&changes, Stamp(0));
    }
    let mut swept = 0;
    for batch in 1..40_000 {
        layer.apply(&Changes::from_voxels([(block(batch % 64), State::Free)]), Stamp(batch.into()));
        assert!(layer.sensors.note(Stamp(batch.into()), [batch, 0, 0]));
        let looked = layer.sweep_sensors(100);
        assert!(looked < 100 + cube, "{looked} blocks in one call");
        swept += looked;
        assert!(layer.sensors.by_stamp().len() < 3 * blocks as usize, "{batch}");
    }
    assert!(swept > 3 * blocks as usize, "{swept}");
    layer.forget_sensors();
    let standing: Vec<Stamp> = layer.sensors.by_stamp().keys().copied().collect();
    assert_eq!(standing, (40_000 - 64..40_000).map(Stamp).collect::<Vec<_>>());
}

#[test]
fn a_layer_is_let_go_of_a_part_at_a_time() {
    let mut layer = Layer::default();
    let (blocks, cube) = (4_096, 64);
    for number in 0..blocks {
        let voxel = Voxel::new(8 * (number % 64), 8 * (number / 64), 0);
        layer.apply(&Changes::from_voxels([(voxel, State::Free)]), Stamp(number.into()));
    }
    let (bytes, mut discarded, mut freed) = (layer.memory_bytes(), layer.discard(), Vec::new());
    assert_eq!(discarded.memory_bytes(), bytes);
    while let more @ 1.. = discarded.free(100) {
        freed.push(more);
    }
    assert!(freed.iter().all(|more| *more < 100 + cube), "{freed:?}");
    assert_eq!(freed.iter().sum::<usize>(), blocks as usize);
}

#[test]
fn the_digest_tells_states_and_stamps_apart() {
    let of = |state, stamp| {
        let mut layer = Layer::default();
        layer.apply(&Changes::from_voxels([(Voxel::new(1, -2, 3), state)]), Stamp(stamp));
        layer.digest()
    };
    assert_eq!(of(State::Free, 7), of(State::Free, 7));
    assert_ne!(of(State::Free, 7), of(State::Occupied, 7));
    assert_ne!(of(State::Free, 7), of(State::Free, 8));
}

#[test]
fn what_leaves_a_layer_is_counted_where_a_copy_keeps_it_and_nowhere_else() {
    let at = |x: i32| Changes::from_voxels([(Voxel::new(x * 32, 0, 0), State::Free)]);
    let mut layer = Layer::default();
    (0..4).for_each(|x| drop(layer.apply(&at(x), Stamp(1))));
    layer.pack();
    layer.apply(&at(0), Stamp(2));
    layer.drop_cube(BlockIndex::new(0, 0, 0));
    assert_eq!(layer.bytes_left_in_copies(), 0, "there is no copy");
    let reader = layer.read_snapshot(None);
    let each = layer.packed_bytes as u64 / 3;
    // Dropped, and opened to be changed.
    layer.drop_cube(cube_of(Voxel::new(32, 0, 0).block()));
    let left = layer.bytes_left_in_copies();
    assert_eq!(left, each);
    layer.apply(&at(2), Stamp(3));
    assert_eq!(layer.bytes_left_in_copies(), 2 * each);
    layer.apply(&at(2), Stamp(4));
    assert_eq!(layer.bytes_left_in_copies(), 2 * each, "the copy has another one");
    drop(reader);
    layer.drop_cube(cube_of(Voxel::new(96, 0, 0).block()));
    assert_eq!(layer.bytes_left_in_copies(), 2 * each);
}
