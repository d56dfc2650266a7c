//! What moves is seen where it is, and what a moving sensor sees is bent just as its motion says.

use flockmap_grid::{Pose, Resolution, Stamp, VoxelBox};
use flockmap_worlds::{
    Body, Flight, Lidar, ObstacleOptions, OptionError, Rendering, ScanOptions, Scanner, Shape, Tracks,
    TracksError, Trajectory, TrajectoryOptions, World,
};
use std::sync::Arc;

/// An empty hall, 12 × 10 × 5 m inside, its walls one cell of 0.1 m thick and its middle at 0.
fn hall() -> Arc<World> {
    let skin = |x: i32, y: i32, z: i32| x == -61 || x == 60 || y == -51 || y == 50 || z == -26 || z == 25;
    let cells = (-61..=60)
        .flat_map(move |x| (-51..=50).flat_map(move |y| (-26..=25).map(move |z| [x, y, z])))
        .filter(|[x, y, z]| skin(*x, *y, *z));
    let points = cells.map(|cell| cell.map(|c| (f64::from(c) + 0.5) * 0.1));
    Arc::new(World::from_points(points, Resolution::from_metres(0.1).unwrap()).unwrap())
}

fn scanner(world: &Arc<World>, lidar: Lidar, rendering: Rendering) -> Scanner {
    let options = ScanOptions { rendering, no_returns: true, motion: true, ..ScanOptions::default() };
    Scanner::new(Arc::clone(world), lidar, options)
}

fn length(v: [f64; 3]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

#[test]
fn a_sphere_and_a_box_are_seen_on_their_surface_and_hide_what_is_behind() {
    let world = hall();
    let sphere = Body { shape: Shape::Sphere { radius_m: 0.4 }, centre_m: [3.0, 1.0, 0.2] };
    let team_mate = Body::robot([2.0, -1.0, 0.1]);
    let pose = Pose::new([-0.4, 0.3, 0.0], [0.0, 0.02, 0.05, 1.0]).unwrap();
    for rendering in [Rendering::Cast, Rendering::Polar] {
        for lidar in Lidar::ALL {
            let scan = scanner(&world, lidar, rendering).scan(Stamp(0), &pose, None, &[sphere, team_mate]);
            let [mut on_sphere, mut on_box] = [0; 2];
            for point in &scan.points {
                let point = pose.transform(point.map(f64::from));
                let from = |centre: [f64; 3]| core::array::from_fn(|a| point[a] - centre[a]);
                if (length(from(sphere.centre_m)) - 0.4).abs() < 1e-3 {
                    on_sphere += 1;
                }
                let [x, y, z]: [f64; 3] = from(team_mate.centre_m).map(f64::abs);
                let outside = [x - 0.2, y - 0.2, z - 0.15];
                if outside.iter().copied().fold(f64::MIN, f64::max).abs() < 1e-3 {
                    on_box += 1;
                }
                // Whatever is further away than a body is not in its shadow.
                let origin = pose.translation();
                let direction: [f64; 3] = core::array::from_fn(|a| point[a] - origin[a]);
                let range = length(direction);
                for body in [sphere, team_mate] {
                    let distance = body.distance_m(origin, direction.map(|v| v / range));
                    // At the rim rounding to f32 decides.
                    assert!(distance.is_none_or(|d| range < d + 0.02) || rim(&body, origin, direction));
                }
            }
            assert!(on_sphere > 20 && on_box > 10, "{lidar} {rendering}: {on_sphere} {on_box}");
        }
    }
}

/// Whether a ray passes the rim of a body by less than a millimetre.
fn rim(body: &Body, origin: [f64; 3], direction: [f64; 3]) -> bool {
    let smaller = match body.shape {
        Shape::Sphere { radius_m } => Shape::Sphere { radius_m: radius_m - 1e-3 },
        Shape::Box { half_m } => Shape::Box { half_m: half_m.map(|h| h - 1e-3) },
    };
    let unit = direction.map(|v| v / length(direction));
    Body { shape: smaller, ..*body }.distance_m(origin, unit).is_none()
}

#[test]
fn a_sensor_does_not_see_what_it_is_inside_of() {
    let world = hall();
    for rendering in [Rendering::Cast, Rendering::Polar] {
        let mut scanner = scanner(&world, Lidar::Mid360, rendering);
        let pose = Pose::from_translation([0.05, -0.1, 0.02]);
        let alone = scanner.scan(Stamp(0), &pose, None, &[]);
        let around = Body { shape: Shape::Sphere { radius_m: 1.0 }, centre_m: [0.3, 0.0, 0.0] };
        assert_eq!(scanner.scan(Stamp(0), &pose, None, &[Body::robot([0.0; 3]), around]), alone);
    }
}

/// A sensor flies and turns during a scan. Each point is, in the frame of the sensor at the moment of its
/// beam, just what a scan standing there shows.
#[test]
fn points_of_a_moving_sensor_are_those_of_the_moment_of_their_beam() {
    let world = hall();
    let (start, end) = (Pose::from_yaw([-0.3, 0.2, 0.1], 0.2), Pose::from_yaw([-0.1, 0.3, 0.0], 0.5));
    for lidar in Lidar::ALL {
        let options = ScanOptions { motion: true, range_m: 50.0, min_range_m: 0.0, ..ScanOptions::default() };
        let moving = Scanner::new(Arc::clone(&world), lidar, options).scan(Stamp(0), &start, Some(&end), &[]);
        let beams = lidar.directions(Stamp(0));
        assert_eq!(moving.points.len(), beams.len());
        for (number, beam) in beams.iter().enumerate().step_by(97) {
            let share = lidar.fired_after_micros(number) as f64 / 1e5;
            let place = core::array::from_fn(|a| {
                start.translation()[a] + share * (end.translation()[a] - start.translation()[a])
            });
            let pose = Pose::from_yaw(place, 0.2 + 0.3 * share);
            let origin = pose.translation();
            let ahead = pose.transform(*beam);
            let hit = world.cast_ray(origin, core::array::from_fn(|a| ahead[a] - origin[a]), 50.0).unwrap();
            let expected = pose.inverse().transform(hit.point);
            let seen = moving.points[number].map(f64::from);
            let off = length(core::array::from_fn(|a| seen[a] - expected[a]));
            assert!(off < 1e-4, "{lidar} beam {number}: {seen:?} {expected:?}");
        }
    }
}

/// Taken for a scan that stood still, a scan in motion shows walls where they are not, by as much as the sensor
/// moved; taken beam by beam, it shows them where they are.
#[test]
fn a_moving_polar_scan_lies_on_the_walls_once_it_is_corrected() {
    let world = hall();
    let (start, end) = (Pose::from_translation([0.0; 3]), Pose::from_yaw([0.2, 0.0, 0.0], 0.1));
    let beams = Lidar::Vlp32.directions(Stamp(0));
    let scan = scanner(&world, Lidar::Vlp32, Rendering::Polar).scan(Stamp(0), &start, Some(&end), &[]);
    assert_eq!(scan.points.len(), beams.len());
    let wall = |point: [f64; 3]| {
        (0..3).map(|a| [6.0, 5.0, 2.5][a] - point[a].abs()).fold(f64::INFINITY, f64::min).abs()
    };
    let (mut corrected_worst, mut raw_worst) = (0.0f64, 0.0f64);
    for (number, point) in scan.points.iter().enumerate() {
        let point = point.map(f64::from);
        let share = Lidar::Vlp32.fired_after_micros(number) as f64 / 1e5;
        let pose = Pose::from_yaw([0.2 * share, 0.0, 0.0], 0.1 * share);
        corrected_worst = corrected_worst.max(wall(pose.transform(point)));
        raw_worst = raw_worst.max(wall(start.transform(point)));
    }
    // Points of 0.1 m and an image each 10 ms on the one hand, 0.2 m and 5.7° at 7 m on the other.
    assert!(corrected_worst < 0.2, "{corrected_worst}");
    assert!(raw_worst > 0.4, "{raw_worst}");
}

#[test]
fn obstacles_move_at_their_speed_and_touch_nothing_solid() {
    let world = World::indoor(1);
    let options =
        ObstacleOptions { count: 8, duration_s: 60.0, start: Stamp(1_000_000), ..ObstacleOptions::default() };
    let tracks = Tracks::obstacles(&world, 3, &options).unwrap();
    assert_eq!(tracks, Tracks::obstacles(&world, 3, &options).unwrap());
    assert_ne!(tracks, Tracks::obstacles(&world, 4, &options).unwrap());
    assert_eq!(tracks.len(), 8);
    let mut flown = [0.0; 8];
    for step in 0..600 {
        let (now, next) = (Stamp(1_000_000 + step * 100_000), Stamp(1_100_000 + step * 100_000));
        let bodies = tracks.bodies_at(now, None);
        for (number, body) in bodies.iter().enumerate() {
            let half = body.shape.half_m();
            assert!((0.3..=0.4).contains(&half[0]), "{half:?}");
            let corner = |sign: f64| {
                let corner = core::array::from_fn(|a| body.centre_m[a] + sign * (half[a] - 1e-6));
                world.resolution().voxel_at(corner).unwrap()
            };
            let (low, high) = (corner(-1.0), corner(1.0));
            assert!(world.bounds().contains(low) && world.bounds().contains(high));
            assert!(!world.is_any_solid(&VoxelBox::spanning(low, high).unwrap()), "{number} at {now:?}");
            let after = tracks.position(number, next).unwrap();
            let step_m = length(core::array::from_fn(|a| after[a] - body.centre_m[a]));
            assert!(step_m <= 0.3 + 1e-6, "{step_m}");
            flown[number] += step_m;
        }
    }
    // 1 to 3 m/s for 60 s.
    assert!(flown.iter().all(|m| (40.0..181.0).contains(m)), "{flown:?}");
    let last = tracks.position(0, Stamp(61_000_000));
    assert_eq!(tracks.position(0, Stamp(i64::MAX)), last);
    assert_eq!(tracks.position(0, Stamp(0)), tracks.position(0, Stamp(1_000_000)));
    assert_eq!(tracks.position(8, Stamp(0)), None);
}

#[test]
fn tracks_that_cannot_be_are_refused_with_the_reason() {
    let hall = hall();
    let error = |options: ObstacleOptions| Tracks::obstacles(&hall, 1, &options).unwrap_err();
    let slow = ObstacleOptions { speed_m_s: [2.0, 1.0], ..ObstacleOptions::default() };
    assert_eq!(error(slow).to_string(), "speed_m_s[1] is 1, expected speed_m_s[0] to 10");
    let long = ObstacleOptions { count: 1_000, duration_s: 2_000.0, ..ObstacleOptions::default() };
    assert!(error(long).to_string().starts_with("count × duration_s is 2000000"));
    let nan = ObstacleOptions { size_m: [f64::NAN, 1.0], ..ObstacleOptions::default() };
    assert!(matches!(error(nan), TracksError::Option(OptionError { name: "size_m[0]", .. })));
    let wall = World::from_points([[0.0; 3], [0.3; 3]], Resolution::from_metres(0.1).unwrap()).unwrap();
    let none = Tracks::obstacles(&wall, 1, &ObstacleOptions::default()).unwrap_err();
    assert!(none.to_string().starts_with("no free place for moving obstacle 1 of 10"), "{none}");
    let mut full = Tracks::default();
    for _ in 0..1_024 {
        full.push(Shape::ROBOT, &[]).unwrap();
    }
    assert_eq!(full.push(Shape::ROBOT, &[]), Err(TracksError::TooMany));
    assert!(full.bodies_at(Stamp(0), None).is_empty());
}

#[test]
fn robots_on_patrol_see_each_other_but_not_themselves() {
    let world = hall();
    let options = TrajectoryOptions { duration_s: 3.0, ..TrajectoryOptions::default() };
    let trajectories = Trajectory::plan(&world, 2, 1, &options).unwrap();
    let mut tracks = Tracks::default();
    for trajectory in &trajectories {
        tracks.push(Shape::ROBOT, trajectory.poses()).unwrap();
    }
    let tracks = Arc::new(tracks);
    let scan = ScanOptions::default();
    for (own, trajectory) in trajectories.iter().enumerate() {
        let flight = Flight::new(Arc::clone(&world), Lidar::Vlp32, scan, trajectory.clone());
        let alone: Vec<_> = flight.clone().collect();
        let seen: Vec<_> = flight.among(Arc::clone(&tracks), Some(own)).collect();
        assert_eq!(seen.len(), 30);
        for (number, (alone, seen)) in alone.iter().zip(&seen).enumerate() {
            let other = trajectories[1 - own].poses()[number].1.translation();
            let near = |point: &[f32; 3]| {
                let point = seen.t_map_sensor.transform(point.map(f64::from));
                length(core::array::from_fn(|a| point[a] - other[a])) < Shape::ROBOT.reach_m() + 1e-3
            };
            let changed = alone.scan.points.iter().zip(&seen.scan.points).filter(|(a, b)| a != b);
            assert_eq!(alone.scan.points.len(), seen.scan.points.len());
            let mut count = 0;
            for (_, point) in changed {
                assert!(near(point), "{point:?}");
                count += 1;
            }
            assert!(count > 0, "robot {own}, scan {number}");
        }
    }
}
