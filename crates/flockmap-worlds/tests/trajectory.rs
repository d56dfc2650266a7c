//! Trajectories touch nothing, keep apart, keep their limits, and cover the world.

use flockmap_grid::{Resolution, Stamp, State, Voxel, VoxelBox};
use flockmap_worlds::{Flight, Lidar, ScanOptions, Trajectory, TrajectoryError, TrajectoryOptions, World};
use std::sync::Arc;

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt()
}

/// Whether a ball around a point holds any part of a solid cell.
fn touches(world: &World, centre: [f64; 3], radius: f64) -> bool {
    let side = world.resolution().metres();
    let low = world.resolution().voxel_at(centre.map(|v| v - radius)).unwrap();
    let high = world.resolution().voxel_at(centre.map(|v| v + radius)).unwrap();
    VoxelBox::spanning(low, high).unwrap().voxels().any(|cell| {
        let corner = [cell.x, cell.y, cell.z].map(|v| f64::from(v) * side);
        let nearest = core::array::from_fn(|a| centre[a].clamp(corner[a], corner[a] + side));
        world.is_solid(cell) && distance(nearest, centre) < radius
    })
}

fn yaw(pose: &flockmap_grid::Pose) -> f64 {
    let rows = pose.rotation_rows();
    rows[1][0].atan2(rows[0][0])
}

/// Checks everything that a plan promises; gives metres flown.
fn check(world: &World, trajectories: &[Trajectory], options: &TrajectoryOptions) -> f64 {
    let mut flown = 0.0;
    for trajectory in trajectories {
        let poses = trajectory.poses();
        assert_eq!(poses.len(), (options.duration_s * 10.0).round() as usize);
        assert!(trajectory.clearance_m() > 0.1, "{}", trajectory.clearance_m());
        for (i, (stamp, pose)) in poses.iter().enumerate() {
            assert_eq!(*stamp, options.start.plus_micros(i as i64 * 100_000));
            let place = pose.translation();
            assert!(
                !touches(world, place, trajectory.clearance_m() - 1e-6),
                "pose {i} at {place:?} touches something"
            );
            let cell = world.resolution().voxel_at(place).unwrap();
            assert!(world.bounds().contains(cell));
        }
        for pair in poses.windows(2) {
            let ((_, a), (_, b)) = (&pair[0], &pair[1]);
            let step = distance(a.translation(), b.translation());
            assert!(step <= options.speed_m_s * 0.1 + 1e-6, "{step} m in 0.1 s");
            let turn = (yaw(b) - yaw(a) + 3.0 * core::f64::consts::PI) % core::f64::consts::TAU
                - core::f64::consts::PI;
            assert!(turn.abs() <= options.yaw_rate_rad_s * 0.1 + 1e-6, "{turn} rad in 0.1 s");
            // No solid cell lies between two poses.
            let ahead = core::array::from_fn(|i| b.translation()[i] - a.translation()[i]);
            if step > 0.0 {
                assert_eq!(world.cast_ray(a.translation(), ahead, step), None);
            }
            flown += step;
        }
        for three in poses.windows(3) {
            let [a, b, c] = [0, 1, 2].map(|i| three[i].1.translation());
            let change = core::array::from_fn(|i| (c[i] - b[i]) - (b[i] - a[i]));
            let acceleration = distance(change, [0.0; 3]) / 0.01;
            // Along and across the path at once, and a polyline of 5 cm pieces.
            assert!(acceleration <= 2.0 * options.acceleration_m_s2 + 0.3, "{acceleration} m/s²");
        }
    }
    for (i, a) in trajectories.iter().enumerate() {
        for b in &trajectories[i + 1..] {
            for ((_, p), (_, q)) in a.poses().iter().zip(b.poses()) {
                let apart = distance(p.translation(), q.translation());
                assert!(apart >= options.separation_m - 1e-6, "{apart} m apart");
            }
        }
    }
    flown
}

/// Size of the box that the flights of all robots span, on the floor.
fn span(trajectories: &[Trajectory]) -> [f64; 2] {
    let places = || trajectories.iter().flat_map(|p| p.poses()).map(|(_, pose)| pose.translation());
    [0, 1].map(|a| {
        let (low, high) =
            places().fold((f64::MAX, f64::MIN), |(low, high), place| (low.min(place[a]), high.max(place[a])));
        high - low
    })
}

#[test]
fn two_robots_fly_through_the_forest_and_touch_nothing() {
    let world = World::forest(3);
    let options = TrajectoryOptions { duration_s: 90.0, ..TrajectoryOptions::default() };
    let trajectories = Trajectory::plan(&world, 2, 5, &options).unwrap();
    assert!(check(&world, &trajectories, &options) > 2.0 * 90.0 * 0.5);
    assert!(span(&trajectories)[0] > 30.0, "{:?}", span(&trajectories));
}

#[test]
fn five_robots_fly_through_the_office_and_its_doors_and_touch_nothing() {
    let world = World::indoor(2);
    let options = TrajectoryOptions { duration_s: 90.0, ..TrajectoryOptions::default() };
    let trajectories = Trajectory::plan(&world, 5, 5, &options).unwrap();
    assert!(check(&world, &trajectories, &options) > 5.0 * 90.0 * 0.5);
    let [x, y] = span(&trajectories);
    assert!(x > 25.0 && y > 22.0, "{x} {y}");
}

#[test]
fn the_same_seed_gives_the_same_flight_on_every_machine() {
    let world = World::indoor(1);
    let options = TrajectoryOptions { duration_s: 30.0, ..TrajectoryOptions::default() };
    let digest = |seed: u64| {
        let trajectories = Trajectory::plan(&world, 2, seed, &options).unwrap();
        let numbers = trajectories.iter().flat_map(|p| p.poses()).flat_map(|(_, pose)| {
            pose.translation().into_iter().chain(pose.quaternion_xyzw()).flat_map(f64::to_le_bytes)
        });
        crc32fast::hash(&numbers.collect::<Vec<u8>>())
    };
    assert_eq!(digest(1), FLIGHT_DIGEST);
    assert_ne!(digest(2), FLIGHT_DIGEST);
}

const FLIGHT_DIGEST: u32 = 3_652_187_373;

#[test]
fn fast_robots_keep_their_limits_too() {
    let world = World::indoor(4);
    let options = TrajectoryOptions {
        duration_s: 20.0,
        speed_m_s: 4.0,
        acceleration_m_s2: 3.0,
        yaw_rate_rad_s: 2.5,
        start: Stamp(77),
        ..TrajectoryOptions::default()
    };
    let trajectories = Trajectory::plan(&world, 1, 9, &options).unwrap();
    check(&world, &trajectories, &options);
}

/// A closed box with walls around `size` cells of 10 cm.
fn room(size: [u32; 3], free: Option<VoxelBox>) -> World {
    let outside = VoxelBox::new(Voxel::new(-1, -1, -1), size.map(|n| n + 2)).unwrap();
    let inside = VoxelBox::new(Voxel::new(0, 0, 0), size).unwrap();
    let resolution = Resolution::from_metres(0.1).unwrap();
    let walls = outside.voxels().filter(|v| !inside.contains(*v));
    match free {
        None => World::from_points(walls.map(|v| resolution.centre(v)), resolution),
        Some(free) => World::from_states(
            walls.map(|v| (VoxelBox::spanning(v, v).unwrap(), State::Occupied)).chain([(free, State::Free)]),
            resolution,
        ),
    }
    .unwrap()
}

#[test]
fn nobody_flies_where_nothing_is_known() {
    let known = VoxelBox::new(Voxel::new(0, 0, 0), [40, 60, 30]).unwrap();
    let world = room([200, 60, 30], Some(known));
    let options = TrajectoryOptions { duration_s: 60.0, ..TrajectoryOptions::default() };
    let trajectories = Trajectory::plan(&world, 1, 1, &options).unwrap();
    check(&world, &trajectories, &options);
    for (_, pose) in trajectories[0].poses() {
        assert!(known.contains(world.resolution().voxel_at(pose.translation()).unwrap()));
    }
}

#[test]
fn no_space_and_too_many_robots_are_errors_that_say_what_was_tried() {
    let options = TrajectoryOptions::default();
    let tight = Trajectory::plan(&room([3, 3, 3], None), 1, 1, &options).unwrap_err();
    assert!(matches!(tight, TrajectoryError::NoSpace { .. }), "{tight}");
    assert!(tight.to_string().contains("0.2 m from anything solid"), "{tight}");
    let crowd = Trajectory::plan(&room([40, 40, 25], None), 20, 1, &options).unwrap_err();
    assert!(matches!(crowd, TrajectoryError::Crowded { robots: 20, .. }), "{crowd}");
    let option = Trajectory::plan(&room([40, 40, 25], None), 0, 1, &options).unwrap_err();
    assert_eq!(option.to_string(), "robots is 0, expected 1 to 64");
    let nan = TrajectoryOptions { speed_m_s: f64::NAN, ..options };
    assert!(Trajectory::plan(&room([40, 40, 25], None), 1, 1, &nan).is_err());
}

#[test]
fn a_flight_gives_a_scan_for_each_pose() {
    let world = Arc::new(room([80, 60, 30], None));
    let options = TrajectoryOptions { duration_s: 1.0, ..TrajectoryOptions::default() };
    let trajectory = Trajectory::plan(&world, 1, 1, &options).unwrap().remove(0);
    let flight = Flight::new(Arc::clone(&world), Lidar::Mid360, ScanOptions::default(), trajectory.clone());
    assert_eq!(flight.len(), 10);
    for (frame, (stamp, pose)) in flight.zip(trajectory.poses()) {
        assert_eq!((frame.scan.stamp, &frame.t_map_sensor), (*stamp, pose));
        // The room is closed: every beam comes back.
        assert_eq!(frame.scan.points.len(), Lidar::Mid360.beams());
    }
}
