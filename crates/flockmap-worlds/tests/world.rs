//! Worlds are the same on every machine, have no holes, and are refused if they cannot be.

use flockmap_grid::{Pose, Resolution, Stamp, State, Voxel, VoxelBox};
use flockmap_worlds::{Lidar, ScanOptions, Scanner, World, WorldError};
use std::sync::{Arc, LazyLock};

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
fn generated_worlds_have_the_stated_size_and_are_neither_empty_nor_full() {
    for (world, size) in [(&*FOREST, [60.0, 25.0, 10.0]), (&*INDOOR, [35.0, 30.0, 4.0])] {
        let side = world.resolution().metres();
        assert_eq!(world.bounds().size().map(|n| f64::from(n) * side), size);
        let share = world.solid_cells().count() as f64 / world.bounds().volume() as f64;
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
    let options = ScanOptions { range_m: 60.0, min_range_m: 0.0, no_returns: true, ..ScanOptions::default() };
    let mut scanner = Scanner::new(Arc::new(INDOOR.clone()), Lidar::Mid360, options);
    let scan = scanner.scan(Stamp(0), &Pose::from_translation([-1.0, 1.2, 1.7]), None, &[]);
    assert_eq!(scan.no_returns.len(), 0);
}

#[test]
fn a_world_from_points_is_solid_just_there() {
    let resolution = Resolution::from_metres(0.2).unwrap();
    let points = [[1.0, 2.05, 0.5], [-3.0, 0.1, 4.0], [1.05, 2.1, 0.45]];
    let world = World::from_points(points, resolution).unwrap();
    assert_eq!(world.solid_cells().count(), 2);
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
    assert_eq!(world.solid_cells().count(), 64);
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
