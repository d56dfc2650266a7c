use super::*;
use flockmap_grid::{
    Changes, Fusion, FusionConfig, Mapper, MapperConfig, Preset, Resolution, RobotId, Stamp, State, Stream,
    Voxel, VoxelBox,
};
use flockmap_worlds::World;
use flockmap_worlds::curve::{distance, wrapped};
use proptest::prelude::*;

/// A fused map that is written to directly.
struct Map {
    fusion: Fusion,
    mapper: Mapper,
    stamp: i64,
}

impl Map {
    fn new() -> Self {
        let resolution = Resolution::from_metres(0.1).unwrap();
        let mapper = Mapper::new(MapperConfig::preset(Preset::RogMap, resolution, 7.0)).unwrap();
        let own = Stream { origin: RobotId(1), epoch: 1 };
        Self { fusion: Fusion::new(own, resolution, FusionConfig::default()), mapper, stamp: 0 }
    }

    fn set(&mut self, voxels: impl IntoIterator<Item = (Voxel, State)>) {
        self.stamp += 1;
        let from = Stream { origin: RobotId(2), epoch: 1 };
        let changes = Changes::from_voxels(voxels);
        let now = Stamp(self.stamp);
        self.fusion.apply(&self.mapper, from, &changes, now, now).unwrap();
    }

    /// All voxels of a world's part: solid ones Occupied, others Free.
    fn show(&mut self, world: &World, region_m: [[f64; 3]; 2]) {
        let resolution = Resolution::from_metres(0.1).unwrap();
        let corner = |p| resolution.voxel_at(p).unwrap();
        let voxels = VoxelBox::spanning(corner(region_m[0]), corner(region_m[1])).unwrap();
        let state = |v: Voxel| if world.is_solid(v) { State::Occupied } else { State::Free };
        self.set(voxels.voxels().map(|v| (v, state(v))));
    }
}

const REGION_M: [[f64; 3]; 2] = [[-1.0, -1.0, 0.0], [1.0, 1.0, 1.2]];

fn config(region_m: [[f64; 3]; 2]) -> NavigationConfig {
    NavigationConfig::new(Resolution::from_metres(0.1).unwrap(), region_m)
}

/// What a cell should be, worked out from the voxels alone.
fn naive(map: &Map, grid: &NavigationGrid, number: usize, clearance_m: f64) -> (CellState, bool) {
    let corner = grid.cells().centre(number).map(|v| ((v - 0.1) * 10.0).round() as i32);
    let cell = VoxelBox::new(Voxel::new(corner[0], corner[1], corner[2]), [2; 3]).unwrap();
    let count = |state| cell.voxels().filter(|v| map.fusion.map().state(*v) == state).count();
    let state = if count(State::Occupied) > 0 {
        CellState::Occupied
    } else if count(State::Free) >= 4 {
        CellState::Free
    } else {
        CellState::Unknown
    };
    let gap = |low: i32, v: i32| f64::from((low - v - 1).max(v - low - 2).max(0)) * 0.1;
    let blocked = map.fusion.map().voxels().any(|(v, state)| {
        let d = [gap(corner[0], v.x), gap(corner[1], v.y), gap(corner[2], v.z)];
        state == State::Occupied && d.iter().map(|d| d * d).sum::<f64>().sqrt() < clearance_m - 1e-6
    });
    (state, state == CellState::Free && !blocked)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 12, ..ProptestConfig::default() })]

    #[test]
    fn the_grid_follows_the_map(
        batches in prop::collection::vec(
            prop::collection::vec(((-14i32..14, -14i32..14, -3i32..15), 0u8..8), 0..400), 1..5),
        clearance_m in prop::sample::select(vec![0.0, 0.1, 0.25, 0.3, 0.5]),
    ) {
        let mut map = Map::new();
        let mut grid = NavigationGrid::new(&NavigationConfig { clearance_m, ..config(REGION_M) }).unwrap();
        for batch in batches {
            map.set(batch.into_iter().map(|((x, y, z), s)| {
                (Voxel::new(x, y, z), if s == 0 { State::Occupied } else { State::Free })
            }));
            grid.update(map.fusion.map());
            for number in 0..grid.count() {
                let (state, passable) = naive(&map, &grid, number, clearance_m);
                prop_assert_eq!(grid.cell_state(number), state, "{:?}", grid.cells().centre(number));
                prop_assert_eq!(grid.is_passable(number, false), passable, "{:?}", grid.cells().centre(number));
            }
        }
    }
}

#[test]
fn a_map_made_anew_leaves_nothing_behind() {
    let mut map = Map::new();
    let mut grid = NavigationGrid::new(&config(REGION_M)).unwrap();
    map.set([(Voxel::new(0, 0, 5), State::Occupied), (Voxel::new(9, 9, 9), State::Free)]);
    grid.update(map.fusion.map());
    assert_eq!(grid.cell_state(grid.cells().cell_at([0.0, 0.0, 0.5]).unwrap()), CellState::Occupied);
    map.fusion.set_muted(RobotId(2), true);
    map.fusion.rebuild(&map.mapper);
    grid.update(map.fusion.map());
    assert!((0..grid.count()).all(|cell| grid.cell_state(cell) == CellState::Unknown));
    assert!((0..grid.count()).all(|cell| grid.is_passable(cell, true) && !grid.is_crowded(cell)));
}

#[test]
fn an_impossible_grid_is_refused_with_a_reason() {
    for region in [[[0.0; 3], [0.0; 3]], [[0.0; 3], [f64::NAN; 3]], [[-1e12; 3], [1.0; 3]]] {
        assert!(matches!(NavigationGrid::new(&config(region)), Err(NavigationError::Region(_))));
    }
    let huge = [[-1000.0; 3], [1000.0; 3]];
    assert!(matches!(NavigationGrid::new(&config(huge)), Err(NavigationError::TooLarge { .. })));
    let far = NavigationConfig { clearance_m: 9.0, ..config(REGION_M) };
    assert!(matches!(NavigationGrid::new(&far), Err(NavigationError::Distance { .. })));
}

/// Two rooms with a wall between them at x = 0, and a door 1 m wide in it.
fn two_rooms() -> World {
    let wall = |a: [f64; 3], b: [f64; 3]| {
        let steps = |i: usize| ((b[i] - a[i]) * 10.0).round() as i32;
        let (a, n) = (a, [steps(0), steps(1), steps(2)]);
        (0..=n[0]).flat_map(move |x| {
            (0..=n[1]).flat_map(move |y| {
                (0..=n[2])
                    .map(move |z| [x, y, z])
                    .map(move |d| core::array::from_fn(|i| a[i] + f64::from(d[i]) * 0.1 + 0.05))
            })
        })
    };
    let points = wall([0.0, -3.0, 0.0], [0.0, 1.4, 1.9]).chain(wall([0.0, 2.4, 0.0], [0.0, 2.9, 1.9]));
    World::from_points(points, Resolution::from_metres(0.1).unwrap()).unwrap()
}

const ROOMS_M: [[f64; 3]; 2] = [[-3.0, -3.0, 0.0], [3.0, 3.0, 2.0]];

fn query(from: [f64; 3], to: [f64; 3]) -> RouteQuery {
    RouteQuery { from, to, unknown_ok: false, expansions_max: usize::MAX }
}

#[test]
fn a_route_leads_through_the_door_and_keeps_the_clearance() {
    let world = two_rooms();
    let mut map = Map::new();
    map.show(&world, [[-3.0, -3.0, 0.0], [2.95, 2.95, 1.95]]);
    let mut grid = NavigationGrid::new(&config(ROOMS_M)).unwrap();
    grid.update(map.fusion.map());
    let mut router = Router::new(&grid);
    let (from, to) = ([-2.0, -2.0, 1.0], [2.0, -2.0, 1.0]);
    let route = router.route(&grid, &query(from, to), |_| false).unwrap();
    assert_eq!((route[0], route[route.len() - 1]), (from, to));
    let length: f64 = route.windows(2).map(|p| distance(p[0], p[1])).sum();
    // The path by the door's middle is 8.7 m; a grid's paths are up to 8 % longer.
    assert!((8.2..9.4).contains(&length), "{length} m: {route:?}");
    for pair in route.windows(2) {
        for step in 0..=100 {
            let p: [f64; 3] =
                core::array::from_fn(|a| pair[0][a] + (pair[1][a] - pair[0][a]) * f64::from(step) / 100.0);
            for solid in world.solid_cells() {
                let c = [solid.x, solid.y, solid.z].map(|v| f64::from(v) * 0.1);
                let d = (0..3).map(|a| (c[a] - p[a]).max(p[a] - c[a] - 0.1).max(0.0).powi(2)).sum::<f64>();
                assert!(d.sqrt() > 0.3 - 1e-6, "{p:?} is {} m from {c:?}", d.sqrt());
            }
        }
    }
}

#[test]
fn there_is_no_route_through_a_closed_door_nor_through_the_unknown() {
    let mut map = Map::new();
    let mut grid = NavigationGrid::new(&config(ROOMS_M)).unwrap();
    let mut router = Router::new(&grid);
    let there = query([-2.0, -2.0, 1.0], [2.0, -2.0, 1.0]);
    assert_eq!(router.route(&grid, &there, |_| false), Err(NoRoute::End));
    assert!(router.route(&grid, &RouteQuery { unknown_ok: true, ..there }, |_| false).is_ok());
    map.show(&two_rooms(), [[-3.0, -3.0, 0.0], [2.95, 2.95, 1.95]]);
    map.set((14..24).flat_map(|y| (0..20).map(move |z| (Voxel::new(0, y, z), State::Occupied))));
    grid.update(map.fusion.map());
    assert_eq!(router.route(&grid, &there, |_| false), Err(NoRoute::Unreachable));
    let few = RouteQuery { expansions_max: 10, ..there };
    assert_eq!(router.route(&grid, &few, |_| false), Err(NoRoute::GaveUp { expansions: 10 }));
    assert_eq!(router.route(&grid, &query([9.0; 3], there.to), |_| false), Err(NoRoute::Start));
    assert_eq!(router.route(&grid, &query(there.from, [0.05, 0.0, 1.0]), |_| false), Err(NoRoute::End));
}

#[test]
fn a_route_is_as_short_as_the_flood_says_and_leads_out_of_a_tight_start() {
    let mut map = Map::new();
    map.show(&two_rooms(), [[-3.0, -3.0, 0.0], [2.95, 2.95, 1.95]]);
    let mut grid = NavigationGrid::new(&NavigationConfig { comfort_m: 0.3, ..config(ROOMS_M) }).unwrap();
    grid.update(map.fusion.map());
    let mut router = Router::new(&grid);
    // Right at the wall, nearer than the clearance.
    let from = [-0.3, 0.0, 1.0];
    assert!(!grid.is_passable(grid.cells().cell_at(from).unwrap(), false));
    router.flood(&grid, from, 100.0, |_| false);
    let metres: Vec<Option<f64>> = (0..grid.count()).map(|cell| router.metres_to(&grid, cell)).collect();
    for cell in (0..grid.count()).step_by(97) {
        let route = router.route(&grid, &query(from, grid.cells().centre(cell)), |_| false);
        assert_eq!(route.is_ok(), metres[cell].is_some() && grid.is_passable(cell, false));
        if let (Ok(route), Some(metres)) = (route, metres[cell]) {
            let length: f64 = route.windows(2).map(|p| distance(p[0], p[1])).sum();
            assert!(length <= metres + 0.2, "{length} m, {metres} m by the grid");
        }
    }
}

#[test]
fn what_is_to_be_avoided_is_gone_round() {
    let mut map = Map::new();
    map.show(&two_rooms(), [[-3.0, -3.0, 0.0], [2.95, 2.95, 1.95]]);
    let mut grid = NavigationGrid::new(&config(ROOMS_M)).unwrap();
    grid.update(map.fusion.map());
    let mut router = Router::new(&grid);
    let there = query([-2.0, -2.0, 1.0], [-2.0, 2.0, 1.0]);
    let middle = [-2.0, 0.0, 1.0];
    let near = |cell| distance(grid.cells().centre(cell), middle) < 0.8;
    let route = router.route(&grid, &there, near).unwrap();
    assert!(route.len() > 2 && route.iter().all(|p| distance(*p, middle) > 0.7));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 256, ..ProptestConfig::default() })]

    #[test]
    fn motion_keeps_its_limits_whatever_is_asked_of_it(
        paths in prop::collection::vec(
            (prop::collection::vec((-40i32..40, -40i32..40, 0i32..8), 1..5), 1usize..25, any::<bool>(), -3.0f64..3.0),
            1..8),
    ) {
        let limits = MotionLimits::default();
        let mut motion = Motion::new([0.0, 0.0, 1.0], 0.0);
        for (waypoints, steps, brake, yaw) in paths {
            let mut line = vec![motion.stopping_point(&limits)];
            line.extend(waypoints.iter().map(|&(x, y, z)| [x, y, z].map(|v| f64::from(v) * 0.1)));
            let (before, speed) = (motion.position(), motion.speed());
            let stop = motion.stopping_path(&limits);
            if brake {
                motion.brake(&limits);
                prop_assert!(distance(motion.stopping_point(&limits), stop[stop.len() - 1]) < 1e-6);
            } else {
                motion.follow(&line, &limits, |_, _| true);
            }
            prop_assert!(distance(before, motion.position()) < 1e-9, "it jumps");
            prop_assert!((speed - motion.speed()).abs() < 0.011, "its speed jumps");
            for _ in 0..steps {
                let (p, v, y) = (motion.position(), motion.speed(), motion.yaw());
                motion.step(0.1, yaw, &limits);
                let moved = distance(p, motion.position());
                prop_assert!(moved <= 0.15 + 1e-6, "{moved} m in 0.1 s");
                // Braking again and again changes nothing once it brakes.
                if brake {
                    motion.brake(&limits);
                    prop_assert!(motion.position().iter().all(|v| v.is_finite()));
                }
                prop_assert!((motion.speed() - v).abs() <= 0.1 + 0.011, "{v} to {} m/s", motion.speed());
                prop_assert!(wrapped(motion.yaw() - y).abs() <= 0.14 + 1e-9);
            }
        }
        for _ in 0..1_000 {
            motion.step(0.1, 0.0, &limits);
        }
        prop_assert!(motion.is_at_end() && motion.speed() == 0.0);
    }
}

#[test]
fn motion_brakes_on_its_path_before_what_lies_behind_its_stopping_point() {
    let limits = MotionLimits::default();
    let mut motion = Motion::new([0.0, 0.0, 1.0], 0.0);
    motion.follow(&[motion.stopping_point(&limits), [20.0, 0.0, 1.0]], &limits, |_, _| true);
    for _ in 0..40 {
        motion.step(0.1, 0.0, &limits);
    }
    assert!((motion.speed() - 1.5).abs() < 1e-6);
    let stop = motion.stopping_point(&limits)[0];
    // v² / 2a.
    assert!((stop - motion.position()[0] - 1.125).abs() < 1e-6);
    motion.brake(&limits);
    for _ in 0..30 {
        motion.step(0.1, 0.0, &limits);
        assert!(motion.position()[0] <= stop + 1e-9);
    }
    assert!(motion.is_at_end() && (motion.position()[0] - stop).abs() < 1e-6);
}

#[test]
fn a_bend_is_rounded_where_there_is_room_and_taken_slowly_where_there_is_none() {
    let limits = MotionLimits::default();
    let seconds = |room: bool| {
        let mut motion = Motion::new([0.0, 0.0, 1.0], 0.0);
        let line = [[0.0, 0.0, 1.0], [4.0, 0.0, 1.0], [4.0, 4.0, 1.0]];
        motion.follow(&line, &limits, |_, _| room);
        (1..).find(|_| {
            motion.step(0.1, 0.0, &limits);
            let p = motion.position();
            assert!(room || p[1] < 1e-9 || p[0] > 4.0 - 1e-9);
            motion.is_at_end()
        })
    };
    let (round, sharp) = (seconds(true).unwrap(), seconds(false).unwrap());
    assert!((60..72).contains(&round), "{round}");
    assert!(sharp > round + 8, "{sharp} against {round}");
}
