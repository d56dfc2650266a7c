//! What a robot sees: the part of a scan that its mapper makes use of.

use super::ApplicationOptions;
use flockmap_grid::{Pose, Scan, Stamp};
use flockmap_worlds::{Body, World};

/// Returns from nearer than this are dropped.
const RANGE_MIN_M: f64 = 0.3;

/// A scan of all beams of the LiDAR, with the other robot in sight. A beam is followed to where the mapper
/// cuts it, at the range or the face of the update box; if it met nothing until there, it is a no-return.
/// What it would have met farther on makes no difference to the map.
#[allow(non_snake_case)]
pub(super) fn scan(
    options: &ApplicationOptions,
    world: &World,
    T_map_sensor: &Pose,
    stamp: Stamp,
    other: [f64; 3],
) -> Scan {
    let rows = T_map_sensor.rotation_rows();
    let origin = T_map_sensor.translation();
    let mut scan = Scan { stamp, points: Vec::new(), no_returns: Vec::new() };
    for beam in options.lidar.directions(stamp) {
        let direction = rows.map(|row| row[0] * beam[0] + row[1] * beam[1] + row[2] * beam[2]);
        let cut_m = (0..3).fold(options.range_m, |cut_m, a| {
            // A little beyond the face, so that what is cut there is cut by the mapper too.
            cut_m.min((options.update_box_m[a] + 0.05) / direction[a].abs())
        });
        let solid = world.cast_ray(origin, direction, cut_m).map(|hit| {
            let offset: [f64; 3] = core::array::from_fn(|a| hit.point[a] - origin[a]);
            (hit.distance_m, core::array::from_fn(|a| (0..3).map(|b| rows[b][a] * offset[b]).sum::<f64>()))
        });
        let body = Body::robot(other)
            .distance_m(origin, direction)
            .filter(|distance| *distance <= cut_m)
            .map(|distance| (distance, beam.map(|v| v * distance)));
        let nearest = solid.into_iter().chain(body).min_by(|a, b| a.0.total_cmp(&b.0));
        match nearest {
            Some((distance, point)) if distance >= RANGE_MIN_M => {
                scan.points.push(point.map(|v| v as f32));
            }
            Some(_) => {}
            None => scan.no_returns.push(beam.map(|v| (v * options.range_m) as f32)),
        }
    }
    scan
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_grid::Resolution;
    use flockmap_worlds::Lidar;

    #[test]
    fn a_robot_hides_what_is_behind_it() {
        // A wall at x = 5.
        let wall =
            (-40..40).flat_map(|y| (0..30).map(move |z| [5.05, f64::from(y) * 0.1, f64::from(z) * 0.1]));
        let world = World::from_points(wall, Resolution::from_metres(0.1).unwrap()).unwrap();
        let options = ApplicationOptions::default();
        let pose = Pose::from_translation([0.0, 0.0, 1.5]);
        let count = |other, from: f32, to: f32| {
            let scan = scan(&options, &world, &pose, Stamp(0), other);
            assert_eq!(scan.points.len() + scan.no_returns.len(), Lidar::Avia.beams());
            scan.points.iter().filter(|p| from <= p[0] && p[0] <= to).count()
        };
        let (away, near) = ([-3.0, 0.0, 1.5], [2.0, 0.0, 1.5]);
        assert_eq!(count(away, 1.7, 2.3), 0);
        assert!(count(near, 1.7, 2.3) > 100);
        // Some beams of its edge end on the body where they would have been cut.
        assert!(count(away, 4.9, 5.1) > count(near, 4.9, 5.1));
    }
}
