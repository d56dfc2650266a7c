//! The polar rendering shows what the exact one shows, to within the spacing of its points.

use flockmap_grid::{Pose, Resolution, Scan, Stamp, Voxel, VoxelBox};
use flockmap_worlds::{Lidar, Rendering, ScanOptions, Scanner, World};
use std::sync::Arc;

const CELL_M: f64 = 0.05;

/// A world of the cells at these places (in cells).
fn world(cells: impl IntoIterator<Item = [i32; 3]>) -> Arc<World> {
    let points = cells.into_iter().map(|cell| cell.map(|c| (f64::from(c) + 0.5) * CELL_M));
    Arc::new(World::from_points(points, Resolution::from_metres(CELL_M).unwrap()).unwrap())
}

/// What a polar scan returned, point by point.
struct Return {
    /// In the frame of the map.
    point: [f64; 3],
    range_m: f64,
    /// Range of an exact ray in the same direction. `None`: it hits nothing.
    exact_m: Option<f64>,
}

fn polar(world: &Arc<World>, lidar: Lidar, pose: &Pose, range_m: f64) -> Scan {
    let options = ScanOptions {
        rendering: Rendering::Polar,
        range_m,
        min_range_m: 0.0,
        no_returns: true,
        ..ScanOptions::default()
    };
    Scanner::new(Arc::clone(world), lidar, options).scan(Stamp(0), pose, None, &[])
}

fn returns(world: &Arc<World>, lidar: Lidar, pose: &Pose, range_m: f64) -> Vec<Return> {
    let origin = pose.translation();
    let compare = |point: &[f32; 3]| {
        let point = pose.transform(point.map(f64::from));
        let direction: [f64; 3] = core::array::from_fn(|a| point[a] - origin[a]);
        let range_m = direction.iter().map(|v| v * v).sum::<f64>().sqrt();
        let exact_m = world.cast_ray(origin, direction, 1.5 * range_m + 1.0).map(|hit| hit.distance_m);
        Return { point, range_m, exact_m }
    };
    // Every fifth, since looking around a point takes longer than rendering it.
    polar(world, lidar, pose, range_m).points.iter().step_by(5).map(compare).collect()
}

/// Metres from a point to the nearest solid and to the nearest empty cell, whichever is further; infinity for
/// more than 0.25 m. So, how far it is off the surface.
fn off_m(world: &World, point: [f64; 3]) -> f64 {
    let at = world.resolution().voxel_at(point).unwrap();
    let mut nearest = [f64::INFINITY; 2];
    for cell in VoxelBox::new(Voxel::new(at.x - 5, at.y - 5, at.z - 5), [11; 3]).unwrap().voxels() {
        let low = [cell.x, cell.y, cell.z].map(|c| f64::from(c) * CELL_M);
        let gap = |a: usize| (low[a] - point[a]).max(point[a] - low[a] - CELL_M).max(0.0);
        let gap = (gap(0).powi(2) + gap(1).powi(2) + gap(2).powi(2)).sqrt();
        let kind = &mut nearest[usize::from(world.is_solid(cell))];
        *kind = kind.min(gap);
    }
    nearest[0].max(nearest[1])
}

fn share(returns: &[Return], is: impl Fn(&Return) -> bool) -> f64 {
    returns.iter().filter(|r| is(r)).count() as f64 / returns.len() as f64
}

#[test]
fn a_plane_comes_out_exact_even_at_a_grazing_angle() {
    // A floor 0.2 m thick, seen from 1.5 m above it, to 12 m away, where the angle is 7°.
    let floor =
        world((-260..260).flat_map(|x| (-260..260).flat_map(move |y| (-4..0).map(move |z| [x, y, z]))));
    for lidar in [Lidar::Vlp32, Lidar::Avia] {
        let pose = Pose::new([0.013, -0.021, 1.5], [0.02, 0.01, 0.3, 1.0]).unwrap();
        let returns = returns(&floor, lidar, &pose, 12.0);
        assert!(returns.len() > 100, "{lidar}: {}", returns.len());
        for Return { point, range_m, exact_m } in &returns {
            assert!(point[2].abs() < 1e-4, "{lidar}: {point:?}");
            assert!((range_m - exact_m.unwrap()).abs() < 1e-3, "{lidar}: {range_m} {exact_m:?}");
        }
    }
}

#[test]
fn nothing_is_seen_through_a_wall_and_nothing_is_missing() {
    // A closed room, 8 × 6 × 3 m, its walls 0.1 m thick.
    let skin = |x: i32, y: i32, z: i32| x.abs() >= 80 || y.abs() >= 60 || z.abs() >= 30;
    let cells = (-81..=81).flat_map(move |x| {
        (-61..=61).flat_map(move |y| (-31..=31).filter(move |&z| skin(x, y, z)).map(move |z| [x, y, z]))
    });
    let room = world(cells);
    for lidar in Lidar::ALL {
        let pose = Pose::from_yaw([0.7, -0.4, 0.3], 0.4);
        assert_eq!(polar(&room, lidar, &pose, 30.0).no_returns.len(), 0, "{lidar}");
        let returns = returns(&room, lidar, &pose, 30.0);
        for r in &returns {
            // Corners are rounded, by little more than the spacing of points.
            assert!(off_m(&room, r.point) < 0.15, "{lidar}: {:?}", r.point);
        }
        let exact = share(&returns, |r| (r.range_m - r.exact_m.unwrap()).abs() < 0.01);
        assert!(exact > 0.8, "{lidar}: {exact}");
    }
}

#[test]
fn a_pole_is_a_pole_before_a_wall() {
    // A wall 8 m away, and 4 m away a round pole of 0.3 m.
    let wall = (-200..200).flat_map(|y| (-80..80).flat_map(move |z| (160..164).map(move |x| [x, y, z])));
    let pole = (0..6).flat_map(|x| (0..6).flat_map(move |y| (-80..80).map(move |z| [80 + x, y - 3, z])));
    let round = |[x, y, _]: &[i32; 3]| {
        let (dx, dy) = (f64::from(*x) - 82.5, f64::from(*y) + 0.5);
        dx * dx + dy * dy <= 9.5
    };
    let scene = world(wall.chain(pole.filter(round)));
    let pose = Pose::from_translation([0.0; 3]);
    for lidar in [Lidar::Avia, Lidar::Vlp32, Lidar::Os128] {
        let returns = returns(&scene, lidar, &pose, 30.0);
        let [mut on_pole, mut on_wall] = [0; 2];
        // Not at the rim of the wall, where points are balls.
        for Return { point, .. } in
            returns.iter().filter(|r| r.point[1].abs() < 9.5 && r.point[2].abs() < 3.5)
        {
            if point[0] < 6.0 {
                on_pole += 1;
                // No wider than the cover of a point to each side.
                assert!((3.85..4.45).contains(&point[0]) && point[1].abs() < 0.27, "{lidar}: {point:?}");
            } else {
                on_wall += 1;
                // No wall is seen through the pole, which hides 0.3 m of it at half the distance.
                assert!((7.9..8.1).contains(&point[0]) && point[1].abs() > 0.25, "{lidar}: {point:?}");
            }
        }
        assert!(on_pole > 20 && on_wall > 500, "{lidar}: {on_pole} {on_wall}");
    }
}

/// In leaves and branches, which have no planes, points stand for balls: there the polar rendering sees things
/// a little larger than they are.
#[test]
fn generated_worlds_look_the_same_in_both_renderings() {
    let scenes = [(World::forest(1), [0.375, 0.025, 2.325], 0.5), (World::indoor(1), [-1.0, 1.2, 1.7], 0.1)];
    for (world, place, short_max) in scenes {
        let world = Arc::new(world);
        for lidar in [Lidar::Mid360, Lidar::Vlp32] {
            let pose = Pose::from_yaw(place, 0.3);
            let returns = returns(&world, lidar, &pose, 15.0);
            let off = share(&returns, |r| off_m(&world, r.point) > 0.1);
            let through = share(&returns, |r| r.exact_m.is_some_and(|exact| r.range_m > exact + 0.2));
            let short = share(&returns, |r| r.exact_m.is_none_or(|exact| r.range_m < exact - 0.2));
            println!(
                "{lidar}: {} points, {off:.4} off, {through:.4} through, {short:.4} short",
                returns.len()
            );
            assert!(off < 0.05 && through < 0.015 && short < short_max, "{lidar}: {off} {through} {short}");
        }
    }
}
