//! Worlds are the same on every machine, and scans show just what is solid.

use flockmap_grid::{Pose, Resolution, Scan, Stamp, State, Voxel, VoxelBox};
use flockmap_sim::{Lidar, ScanOptions, World, WorldError};
use std::sync::LazyLock;

static FOREST: LazyLock<World> = LazyLock::new(|| World::forest(1));
static INDOOR: LazyLock<World> = LazyLock::new(|| World::indoor(1));

/// Golden: a change of a generator or of a scan pattern must be on purpose, since recordings and benchmarks
/// depend on it.
#[test]
fn the_same_seed_gives_the_same_world_on_every_machine() {
    assert_eq!(FOREST.digest(), FOREST_DIGEST);
    assert_eq!(INDOOR.digest(), INDOOR_DIGEST);
    assert_ne!(World::indoor(2).digest(), INDOOR_DIGEST);
}

const FOREST_DIGEST: u64 = 0x9e14_6e73_d948_5dfe;
const INDOOR_DIGEST: u64 = 0x4d51_7229_8f33_4d52;

#[test]
fn scans_are_the_same_on_every_machine() {
    let pose = Pose::new([0.375, 0.025, 2.325], [0.01, -0.02, 0.5, 0.8]).unwrap();
    let options = ScanOptions { range_noise_m: 0.02, seed: 3, ..ScanOptions::default() };
    let digest = |lidar: Lidar| {
        let scan = lidar.scan(&FOREST, &pose, Stamp(1_234_500_000), &options);
        let bytes: Vec<u8> = scan.points.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
        crc32fast::hash(&bytes)
    };
    assert_eq!([digest(Lidar::Avia), digest(Lidar::Mid360)], SCAN_DIGESTS);
}

const SCAN_DIGESTS: [u32; 2] = [2_519_943_219, 1_794_780_736];

#[test]
fn generated_worlds_have_the_stated_size_and_are_neither_empty_nor_full() {
    for (world, size) in [(&*FOREST, [60.0, 25.0, 10.0]), (&*INDOOR, [35.0, 30.0, 4.0])] {
        let side = world.resolution().metres();
        assert_eq!(world.bounds().size().map(|n| f64::from(n) * side), size);
        let share = world.solid_count() as f64 / world.bounds().volume() as f64;
        assert!((0.02..0.3).contains(&share), "{share}");
        assert!(world.solid_cells().all(|cell| world.bounds().contains(cell)));
    }
}

#[test]
fn the_forest_floor_and_the_office_walls_have_no_holes() {
    for i in 0..120 {
        for j in 0..50 {
            let above = [f64::from(i) * 0.5 - 29.9, f64::from(j) * 0.5 - 12.4, 9.99];
            assert!(FOREST.cast_ray(above, [0.0, 0.0, -1.0], 20.0).is_some(), "{above:?}");
        }
    }
    let lidar_inside = Pose::from_translation([-1.0, 1.2, 1.7]);
    let scan = Lidar::Mid360.scan(
        &INDOOR,
        &lidar_inside,
        Stamp(0),
        &ScanOptions { range_m: 60.0, min_range_m: 0.0, no_returns: true, ..ScanOptions::default() },
    );
    assert_eq!(scan.no_returns.len(), 0);
}

/// Every point lies in a solid cell, in range, in the field of view; beams are points, no-returns, or too
/// near.
fn check_scan(world: &World, lidar: Lidar, pose: &Pose, scan: &Scan, options: &ScanOptions) {
    let ([left, right], [low, high]) = lidar.field_of_view_deg();
    assert!(scan.points.len() + scan.no_returns.len() <= lidar.beams());
    for point in &scan.points {
        let point = point.map(f64::from);
        let cell = world.resolution().voxel_at(pose.transform(point)).unwrap();
        assert!(world.is_solid(cell), "{point:?} lies in {cell:?}, which is empty");
        let flat = (point[0] * point[0] + point[1] * point[1]).sqrt();
        let range = (flat * flat + point[2] * point[2]).sqrt();
        assert!(options.min_range_m - 1e-3 <= range && range <= options.range_m + 1e-3, "{range}");
        // Points near the sensor may be moved into their cell by a visible angle.
        if range > 2.0 {
            let (azimuth, elevation) =
                (point[1].atan2(point[0]).to_degrees(), point[2].atan2(flat).to_degrees());
            assert!((left - 0.05..=right + 0.05).contains(&azimuth), "{azimuth}");
            assert!((low - 0.05..=high + 0.05).contains(&elevation), "{elevation}");
        }
    }
    for point in &scan.no_returns {
        let range = point.iter().map(|v| f64::from(v * v)).sum::<f64>().sqrt();
        assert!((range - options.range_m).abs() < 1e-3);
    }
}

#[test]
fn every_point_of_a_scan_lies_in_a_solid_cell_within_range_and_field_of_view() {
    let options = ScanOptions { range_m: 12.0, min_range_m: 0.1, no_returns: true, ..ScanOptions::default() };
    for (world, place) in [(&*FOREST, [0.375, 0.025, 2.325]), (&*INDOOR, [-1.0, 1.2, 1.7])] {
        for lidar in [Lidar::Avia, Lidar::Mid360] {
            for (i, stamp) in [0, 100_000, 86_400_000_000].into_iter().enumerate() {
                let turn = 0.3 * i as f64;
                let pose = Pose::new(place, [0.02, turn * 0.1, turn, 1.0]).unwrap();
                let scan = lidar.scan(world, &pose, Stamp(stamp), &options);
                assert_eq!(scan.stamp, Stamp(stamp));
                assert!(scan.points.len() > 5_000, "{}", scan.points.len());
                check_scan(world, lidar, &pose, &scan, &options);
            }
        }
    }
}

#[test]
fn beams_are_unit_vectors_that_fill_the_field_of_view_and_do_not_repeat() {
    for lidar in [Lidar::Avia, Lidar::Mid360] {
        let beams = lidar.directions(Stamp(0));
        assert_eq!(beams.len(), lidar.beams());
        let ([left, right], [low, high]) = lidar.field_of_view_deg();
        let mut reached = [f64::MAX, f64::MIN, f64::MAX, f64::MIN];
        for beam in &beams {
            assert!((beam.iter().map(|v| v * v).sum::<f64>() - 1.0).abs() < 1e-12);
            let azimuth = beam[1].atan2(beam[0]).to_degrees();
            let elevation = beam[2].asin().to_degrees();
            assert!((left..=right).contains(&azimuth), "{azimuth}");
            assert!((low - 1e-9..=high + 1e-9).contains(&elevation), "{elevation}");
            reached = [
                reached[0].min(azimuth),
                reached[1].max(azimuth),
                reached[2].min(elevation),
                reached[3].max(elevation),
            ];
        }
        assert!(reached[1] - reached[0] > 0.9 * (right - left), "{reached:?}");
        assert!(reached[3] - reached[2] > 0.9 * (high - low), "{reached:?}");
        // One second later hardly any beam points where one pointed before.
        let key = |beam: &[f64; 3]| beam.map(|v| (v * 1e4).round() as i64);
        let before: std::collections::BTreeSet<_> = beams.iter().map(key).collect();
        let again =
            lidar.directions(Stamp(1_000_000)).iter().filter(|beam| before.contains(&key(beam))).count();
        assert!(again < lidar.beams() / 20, "{again} of {}", lidar.beams());
    }
}

#[test]
fn range_noise_has_the_stated_deviation_and_moves_points_along_their_beams() {
    let pose = Pose::from_translation([-1.0, 1.2, 1.7]);
    let exact = Lidar::Avia.scan(&INDOOR, &pose, Stamp(0), &ScanOptions::default());
    let options = ScanOptions { range_noise_m: 0.02, ..ScanOptions::default() };
    let noisy = Lidar::Avia.scan(&INDOOR, &pose, Stamp(0), &options);
    assert_eq!(exact.points.len(), noisy.points.len());
    let errors = exact.points.iter().zip(&noisy.points).map(|(a, b)| {
        let square: f64 = (0..3).map(|i| f64::from(a[i] - b[i]).powi(2)).sum();
        square
    });
    let deviation = (errors.sum::<f64>() / exact.points.len() as f64).sqrt();
    assert!((deviation - 0.02).abs() < 0.001, "{deviation}");
}

#[test]
fn a_world_from_points_is_solid_just_there() {
    let resolution = Resolution::from_metres(0.2).unwrap();
    let points = [[1.0, 2.05, 0.5], [-3.0, 0.1, 4.0], [1.05, 2.1, 0.45]];
    let world = World::from_points(points, resolution).unwrap();
    assert_eq!(world.solid_count(), 2);
    for point in points {
        assert!(world.is_solid(resolution.voxel_at(point).unwrap()));
    }
    let hit = world.cast_ray([1.1, 2.1, 3.0], [0.0, 0.0, -2.0], 10.0).unwrap();
    assert_eq!(hit.cell, resolution.voxel_at(points[0]).unwrap());
    assert!((hit.distance_m - 2.4).abs() < 1e-9);
    assert_eq!(world.is_known_free(Voxel::new(0, 0, 0)), None);
}

#[test]
fn a_world_from_states_knows_what_is_free() {
    let resolution = Resolution::from_metres(0.1).unwrap();
    let cube = |x: i32| VoxelBox::new(Voxel::new(x, 0, 0), [4; 3]).unwrap();
    let parts = [(cube(0), State::Occupied), (cube(4), State::Free), (cube(100), State::Unknown)];
    let world = World::from_states(parts, resolution).unwrap();
    assert_eq!(world.bounds(), cube(0).union(&cube(4)));
    assert_eq!(world.solid_count(), 64);
    assert_eq!(world.is_known_free(Voxel::new(5, 1, 1)), Some(true));
    assert_eq!(world.is_known_free(Voxel::new(1, 1, 1)), Some(false));
}

#[test]
fn a_world_that_cannot_be_is_refused_with_the_reason() {
    let resolution = Resolution::from_metres(0.01).unwrap();
    assert_eq!(World::from_points([], resolution).unwrap_err(), WorldError::Empty);
    let far = World::from_points([[0.0; 3], [20_000.0; 3]], resolution).unwrap_err();
    assert!(matches!(far, WorldError::TooLarge { .. }), "{far}");
    let nan = World::from_points([[0.0; 3], [f64::NAN; 3]], resolution).unwrap_err();
    assert!(matches!(nan, WorldError::OutOfReach { index: 1, .. }), "{nan}");
    let huge = VoxelBox::new(Voxel::new(0, 0, 0), [1 << 12; 3]).unwrap();
    let full = World::from_states([(huge, State::Occupied)], resolution).unwrap_err();
    assert!(matches!(full, WorldError::TooLarge { .. }), "{full}");
}
