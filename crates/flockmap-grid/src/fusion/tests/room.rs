//! Layers at their limits.

use super::*;
use crate::{SubmapId, SubmapRecord};

/// The voxels of a diagonal, one in each of so many blocks.
fn apart(blocks: core::ops::Range<i32>) -> Changes {
    Changes::from_voxels(blocks.map(|n| (Voxel::new(9 * n, 9 * n, n), State::Free)))
}

/// Everything is as if the map were made anew.
fn check_view(fusion: &mut Fusion, mapper: &Mapper) {
    let mut blocks: Vec<_> = fusion.map().blocks().collect();
    fusion.rebuild(mapper);
    let mut anew: Vec<_> = fusion.map().blocks().collect();
    for list in [&mut blocks, &mut anew] {
        list.retain(|(_, states)| !states.is_empty());
        list.sort_unstable_by_key(|(index, _)| *index);
    }
    assert_eq!(blocks, anew);
}

/// A robot at the origin that has seen nothing.
fn standing(mapper: &mut Mapper, fusion: &mut Fusion) {
    let scan = Scan { stamp: Stamp(0), points: Vec::new(), no_returns: Vec::new() };
    let report = mapper.insert(&scan, &Pose::IDENTITY, &[]);
    fusion.own_scan(mapper, &report);
}

#[test]
fn at_the_limit_the_newest_is_held_and_what_was_dropped_is_said() {
    let mapper = mapper();
    let config = FusionConfig { layer_bytes_max: 40_000, streams_max: 2, ..FusionConfig::default() };
    let mut fusion = Fusion::new(OWN, resolution(), config);
    let (mut taken, mut dropped) = (0, 0);
    for second in 0..100 {
        let stamp = Stamp(i64::from(second) * 1_000_000);
        let stream = stream(2 + second as u16 % 2);
        taken += fusion.apply(&mapper, stream, &apart(second..second + 1), stamp, stamp).unwrap();
        for gone in fusion.take_dropped() {
            assert!(gone.newest < stamp && fusion.is_in_part(gone.stream));
            dropped += gone.blocks;
        }
        assert!(fusion.memory_bytes_of_others(&mapper) <= 40_000);
        assert_eq!(fusion.map().state(Voxel::new(9 * second, 9 * second, second)), State::Free);
    }
    let left: usize = fusion.layers().map(|(_, layer)| layer.len()).sum();
    assert_eq!((taken, left + dropped), (100, 100));
    assert!(left > 15, "{left}");
    let is_known = |n: i32| fusion.map().state(Voxel::new(9 * n, 9 * n, n)) == State::Free;
    // Up to three of a stream lie in one cube.
    assert!((106 - left as i32..100).all(is_known), "the oldest go first");
    check_view(&mut fusion, &mapper);
}

#[test]
fn what_is_near_stays_and_what_comes_from_afar_is_not_worth_it() {
    let mut mapper = mapper();
    let config = FusionConfig { layer_bytes_max: 40_000, ..FusionConfig::default() };
    let mut fusion = Fusion::new(OWN, resolution(), config);
    standing(&mut mapper, &mut fusion);
    let now = Stamp(1_000_000);
    // From afar to the robot, and then away from it on the other side.
    let turn = Pose::from_yaw([0.0; 3], 3.0);
    fusion.set_alignment(RobotId(3), &turn).unwrap();
    for n in (0..100).rev() {
        fusion.apply(&mapper, stream(2), &apart(n..n + 1), Stamp(1), now).unwrap();
    }
    assert!(fusion.take_dropped().iter().all(|gone| gone.stream == stream(2) && gone.blocks > 30));
    let held = |fusion: &Fusion, of| fusion.layer(stream(of)).map_or(0, Layer::len);
    let before = held(&fusion, 2);
    assert!((0..10).all(|n| fusion.layer(stream(2)).unwrap().get(Voxel::new(9 * n, 9 * n, n)).is_some()));
    for n in 100..150 {
        fusion.apply(&mapper, stream(3), &apart(n..n + 1), Stamp(1), now).unwrap();
    }
    assert_eq!(held(&fusion, 2), before);
    let [Dropped { blocks, newest: Stamp(1), .. }] = fusion.take_dropped()[..] else { panic!() };
    // There was a little room.
    assert!(held(&fusion, 3) < 15 && blocks > 30, "{blocks}");
    check_view(&mut fusion, &mapper);
}

#[test]
fn more_streams_than_may_be_are_refused_and_what_is_forgotten_gives_its_room_in_a_moment() {
    let mapper = mapper();
    let config = FusionConfig { layer_bytes_max: 26_000, streams_max: 2, ..FusionConfig::default() };
    let mut fusion = Fusion::new(OWN, resolution(), config);
    for id in [2, 3] {
        fusion.apply(&mapper, stream(id), &apart(0..14), Stamp(1), Stamp(1)).unwrap();
    }
    let full = fusion.apply(&mapper, stream(4), &apart(0..1), Stamp(1), Stamp(1));
    assert_eq!(full, Err(FusionError::StreamsFull(stream(4), 2)));
    fusion.forget(stream(2));
    let mut more =
        (100..200).map(|n| (n, fusion.apply(&mapper, stream(3), &apart(n..n + 1), Stamp(2), Stamp(2))));
    let Some((n, full)) = more.find(|(_, taken)| taken.is_err()) else { panic!("there is room for all") };
    drop(more);
    assert!(matches!(full, Err(FusionError::LayersFull { .. })) && fusion.take_dropped().is_empty());
    finish(&mut fusion, &mapper);
    assert_eq!(fusion.apply(&mapper, stream(3), &apart(n..n + 1), Stamp(2), Stamp(2)), Ok(1));
    assert!(fusion.take_dropped().is_empty());
}

#[test]
fn a_snapshot_of_many_stamps_is_left_out_where_its_voxels_alone_would_fit() {
    let mapper = mapper();
    let voxels = || (0..512).map(|bit| (Voxel::new(bit & 7, bit >> 3 & 7, bit >> 6), State::Free));
    let parts = (1..).map(Stamp).zip(voxels().map(|voxel| source(&[voxel]))).collect();
    let region = VoxelBox::spanning(Voxel::new(0, 0, 0), Voxel::new(7, 7, 7)).unwrap();
    let state = Snapshot { region, parts, sensors: Vec::new() };
    for (layer_bytes_max, is_refused) in [(6_000, true), (10_000, false)] {
        let config = FusionConfig { layer_bytes_max, ..FusionConfig::default() };
        let mut fusion = Fusion::new(OWN, resolution(), config.clone());
        let taken = fusion.apply_snapshot(&mapper, stream(2), &state, false, Stamp(999)).unwrap();
        // It is one block: it is there, or it is not.
        assert_eq!((taken, fusion.is_in_part(stream(2))), if is_refused { (0, true) } else { (512, false) });
        assert!(fusion.memory_bytes_of_others(&mapper) <= layer_bytes_max);
        // Of one stamp it fits.
        let mut fusion = Fusion::new(OWN, resolution(), config);
        let all: Vec<_> = voxels().collect();
        assert_eq!(fusion.apply(&mapper, stream(2), &source(&all), Stamp(1), Stamp(1)), Ok(512));
    }
}

#[test]
fn what_others_tell_leaves_the_own_layer_its_room_and_the_other_way_round() {
    let mapper = mapper();
    let config =
        FusionConfig { layer_bytes_max: 30_000, own_layer_bytes_max: 30_000, ..FusionConfig::default() };
    for (first, second) in [(OWN, stream(2)), (stream(2), OWN)] {
        let mut fusion = Fusion::new(OWN, resolution(), config.clone());
        let mut taken = |stream| {
            let take = |n: &i32| {
                fusion.apply(&mapper, stream, &apart(*n..n + 1), Stamp(1), Stamp(1)).unwrap();
                fusion.take_dropped().is_empty()
            };
            (0..100).take_while(take).count()
        };
        assert!((10..100).contains(&taken(first)));
        assert!((10..100).contains(&taken(second)));
    }
}

#[test]
fn where_room_is_wanting_some_of_what_lies_cold_is_packed_at_a_time_and_the_own_layer_takes_what_fits() {
    let mapper = mapper();
    // A thousand blocks in a new place.
    let batch = |number: i32| {
        let voxels = (0..1_000).map(|n| (Voxel::new(8 * (n % 32), 8 * (n / 32), 8 * number), State::Free));
        Changes::from_voxels(voxels)
    };
    for of in [OWN, stream(2)] {
        let mut fusion = Fusion::new(OWN, resolution(), FusionConfig::default());
        for number in 0..36 {
            let stamp = Stamp(number.into());
            fusion.apply(&mapper, of, &batch(number), stamp, stamp).unwrap();
        }
        let packed = |fusion: &Fusion| fusion.layer(of).unwrap().packed_count();
        assert_eq!(packed(&fusion), 0);
        fusion.config.layer_bytes_max = fusion.memory_bytes_of_others(&mapper);
        fusion.config.own_layer_bytes_max = fusion.layer(of).unwrap().memory_bytes();
        let mut calls = Vec::new();
        loop {
            let before = packed(&fusion);
            let taken = fusion.apply(&mapper, of, &batch(36), Stamp(36), Stamp(36));
            calls.push(packed(&fusion) - before);
            if taken.is_ok() {
                break;
            }
        }
        let total: usize = calls.iter().sum();
        assert!(0 < total && total < 36_000 - 32_768 + 64, "{calls:?}");
        if of == OWN {
            assert_eq!(calls.len(), 1, "what is published cannot be refused");
        } else {
            assert!(calls.iter().all(|packed| *packed <= 128 + 512 + 2 * 64), "{calls:?}");
        }
    }
}

#[test]
fn what_rests_in_many_small_layers_is_packed_before_anything_is_dropped() {
    let mapper = mapper();
    let batch = |stream: u16, number: u16| {
        let at =
            |n: i32| Voxel::new(8 * (n % 32), 8 * (n / 32) + 512 * i32::from(stream), 8 * i32::from(number));
        Changes::from_voxels((0..250).map(|n| (at(n), State::Free)))
    };
    let one_after_the_other: Vec<_> =
        (2..42).flat_map(|of| (0..12).map(move |number| (of, number))).collect();
    let mut in_turn = one_after_the_other.clone();
    in_turn.sort_by_key(|(_, number)| *number);
    for order in [one_after_the_other, in_turn] {
        let config =
            FusionConfig { layer_bytes_max: 32 << 20, mutes_others: true, ..FusionConfig::default() };
        let mut fusion = Fusion::new(OWN, resolution(), config);
        for (of, number) in order {
            let stamp = Stamp(number.into());
            assert_eq!(fusion.apply(&mapper, stream(of), &batch(of, number), stamp, stamp), Ok(250));
            assert!(fusion.memory_bytes_of_others(&mapper) <= 32 << 20);
        }
        assert!(fusion.take_dropped().is_empty());
        assert!(fusion.layers().all(|(_, layer)| layer.len() == 3_000));
        let packed: usize = fusion.layers().map(|(_, layer)| layer.packed_count()).sum();
        assert!((10_000..115_000).contains(&packed), "{packed}");
        // One that goes has no place among those that are packed.
        fusion.forget(stream(2));
        finish(&mut fusion, &mapper);
        fusion.apply(&mapper, stream(2), &batch(2, 0), Stamp(1), Stamp(1)).unwrap();
        assert_eq!(fusion.layer(stream(2)).map(Layer::len), Some(250));
    }
}

#[test]
fn what_is_said_of_submaps_is_refused_last_and_an_older_pose_does_not_come_in_its_place() {
    let mapper = mapper();
    let config = FusionConfig { layer_bytes_max: 100_000, ..FusionConfig::default() };
    let mut fusion = Fusion::new(OWN, resolution(), config);
    let stamp = |n: u16| Stamp(i64::from(n) * 1_000_000);
    let record = |n: u16, x: f64| {
        let pose = Pose::from_translation([x, 0.0, 0.0]).rounded().ok();
        SubmapRecord::changes(&[SubmapRecord { submap: SubmapId::new(n).unwrap(), begins: n > 0, pose }])
            .unwrap()
    };
    fusion.apply(&mapper, stream(3), &apart(0..20), Stamp(1), Stamp(1)).unwrap();
    let refused = (0..400).find(|n| {
        fusion.apply(&mapper, stream(2), &record(*n, f64::from(*n)), stamp(*n), stamp(*n)).unwrap();
        assert!(fusion.memory_bytes_of_others(&mapper) <= 100_000);
        fusion.take_dropped().iter().any(|gone| gone.stream == stream(2))
    });
    let refused = refused.expect("it is full");
    assert_eq!(fusion.layer(stream(3)).map_or(0, Layer::len), 0, "voxels go first");
    assert!(refused > 50 && fusion.is_in_part(stream(2)), "{refused}");
    let now = stamp(refused);
    assert_eq!(fusion.apply(&mapper, stream(2), &record(refused, 0.5), now.plus_micros(-1), now), Ok(0));
    check_view(&mut fusion, &mapper);
}
