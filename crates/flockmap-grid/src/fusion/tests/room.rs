//! Layers at their limits.

use super::*;

/// The voxels of a diagonal, one in each of so many blocks.
fn apart(blocks: core::ops::Range<i32>) -> Changes {
    Changes::from_voxels(blocks.map(|n| (Voxel::new(9 * n, 9 * n, n), State::Free)))
}

#[test]
fn layers_beyond_their_limit_are_refused_and_nothing_is_changed() {
    let mapper = mapper();
    let config = FusionConfig { layer_bytes_max: 40_000, streams_max: 2, ..FusionConfig::default() };
    let mut fusion = Fusion::new(OWN, resolution(), config);
    let mut blocks = 0;
    let full = loop {
        let before = (fusion.layer(stream(2)).map(Layer::digest), fusion.memory_bytes_of_others(&mapper));
        match fusion.apply(&mapper, stream(2), &apart(blocks..blocks + 4), Stamp(1), Stamp(1)) {
            Ok(taken) => blocks += taken as i32,
            Err(error) => {
                let after =
                    (fusion.layer(stream(2)).map(Layer::digest), fusion.memory_bytes_of_others(&mapper));
                assert_eq!(before, after);
                break error;
            }
        }
        assert!(fusion.memory_bytes_of_others(&mapper) <= 40_000);
    };
    let FusionError::LayersFull { held, more, max: 40_000 } = full else { panic!("{full}") };
    assert!(held + more > 40_000 && held > 13_000 && (16..99).contains(&blocks), "{full}, {blocks} blocks");
    assert_eq!(
        fusion.apply(&mapper, stream(2), &apart(0..2), Stamp(2), Stamp(2)),
        Ok(2),
        "what is there may change"
    );
    let beyond = apart(500..504);
    assert!(matches!(
        fusion.apply(&mapper, stream(3), &apart(0..100), Stamp(1), Stamp(1)),
        Err(FusionError::LayersFull { .. })
    ));
    assert!(fusion.layer(stream(3)).is_none());
    assert_eq!(fusion.map().state(Voxel::new(9 * 99, 9 * 99, 99)), State::Unknown);
    fusion.forget(stream(2));
    assert!(fusion.memory_bytes_of_others(&mapper) > 13_000, "it is in the map yet");
    finish(&mut fusion, &mapper);
    assert_eq!(fusion.memory_bytes_of_others(&mapper), 0);
    assert_eq!(fusion.apply(&mapper, stream(3), &beyond, Stamp(1), Stamp(1)), Ok(4));
}

#[test]
fn a_snapshot_of_many_stamps_is_refused_where_its_voxels_alone_would_fit() {
    let mapper = mapper();
    let voxels = || (0..512).map(|bit| (Voxel::new(bit & 7, bit >> 3 & 7, bit >> 6), State::Free));
    let parts = (1..).map(Stamp).zip(voxels().map(|voxel| source(&[voxel]))).collect();
    let region = VoxelBox::spanning(Voxel::new(0, 0, 0), Voxel::new(7, 7, 7)).unwrap();
    let state = Snapshot { region, parts, sensors: Vec::new() };
    for (layer_bytes_max, is_refused) in [(6_000, true), (10_000, false)] {
        let config = FusionConfig { layer_bytes_max, ..FusionConfig::default() };
        let mut fusion = Fusion::new(OWN, resolution(), config.clone());
        assert_eq!(fusion.apply_snapshot(&mapper, stream(2), &state, Stamp(999)).is_err(), is_refused);
        assert_eq!(fusion.layer(stream(2)).is_none(), is_refused);
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
        let taken = |fusion: &mut Fusion, stream| {
            (0..100)
                .take_while(|n| fusion.apply(&mapper, stream, &apart(*n..n + 1), Stamp(1), Stamp(1)).is_ok())
                .count()
        };
        assert!((10..100).contains(&taken(&mut fusion, first)));
        assert!((10..100).contains(&taken(&mut fusion, second)));
        let own_full = fusion.apply(&mapper, OWN, &apart(100..200), Stamp(2), Stamp(2));
        assert!(matches!(own_full, Err(FusionError::OwnLayerFull { .. })), "{own_full:?}");
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
