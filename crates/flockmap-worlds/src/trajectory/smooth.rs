//! How a robot flies along a path: rounded corners, limits of speed, acceleration and yaw rate.

use super::TrajectoryOptions;
use super::region::Region;
use super::space::Space;
use crate::curve::{CREEP_M_S, between, distance, rounded, slow_in_bends, slow_to_reach, wrapped};
use flockmap_grid::{Pose, Stamp};
use libm::{atan2, cos, sin};

/// Poses every 0.1 s along the polyline `line`, which must lie in the region.
pub(super) fn fly(
    space: &Space,
    region: &Region,
    line: &[[f64; 3]],
    options: &TrajectoryOptions,
) -> Vec<(Stamp, Pose)> {
    let fits = |a, b| space.lattice.line_fits(a, b, |cell| region.contains(cell));
    let (points, _) = rounded(&line[..1], 0.0, &line[1..], fits);
    let lengths: Vec<f64> = points.windows(2).map(|pair| distance(pair[0], pair[1])).collect();
    let yaws = headings(&points);
    let speeds = speeds(&points, &lengths, &yaws, options);
    let mut poses = Vec::new();
    let (mut segment, mut started) = (0, 0.0);
    let count = (options.duration_s * 10.0).round().max(1.0) as i64;
    for number in 0..count {
        let time = number as f64 * 0.1;
        // The last segment before this time; on the path's end the robot hovers.
        let mut fraction = 1.0;
        while segment < lengths.len() {
            let (v0, v1, length) = (speeds[segment], speeds[segment + 1], lengths[segment]);
            let lasts = 2.0 * length / (v0 + v1);
            let into = time - started;
            if into < lasts {
                fraction = (v0 * into + 0.5 * (v1 - v0) / lasts * into * into) / length;
                break;
            }
            started += lasts;
            segment += 1;
        }
        let (from, f) = if segment < lengths.len() { (segment, fraction) } else { (segment.max(1) - 1, 1.0) };
        let to = (from + 1).min(points.len() - 1);
        let position = between(points[from], points[to], f);
        let half = 0.5 * (yaws[from] + (yaws[to] - yaws[from]) * f);
        let pose = Pose::new(position, [0.0, 0.0, sin(half), cos(half)]);
        // Sine and cosine of one angle make a unit quaternion, and cells have finite places.
        poses.push((options.start.plus_micros(number * 100_000), pose.unwrap_or_default()));
    }
    poses
}

/// For each point the direction of motion after it, in radians, without jumps of a full turn. Kept where the
/// path is steep.
fn headings(points: &[[f64; 3]]) -> Vec<f64> {
    let heading = |pair: &[[f64; 3]]| {
        let (dx, dy) = (pair[1][0] - pair[0][0], pair[1][1] - pair[0][1]);
        let flat = (dx * dx + dy * dy).sqrt();
        (flat > 0.2 * distance(pair[0], pair[1])).then(|| atan2(dy, dx))
    };
    let mut last = points.windows(2).find_map(heading).unwrap_or(0.0);
    let mut yaws = Vec::with_capacity(points.len());
    for pair in points.windows(2) {
        if let Some(next) = heading(pair) {
            last += wrapped(next - last);
        }
        yaws.push(last);
    }
    yaws.push(last);
    yaws
}

/// For each point the highest speed at which all limits are kept, from rest to rest.
fn speeds(points: &[[f64; 3]], lengths: &[f64], yaws: &[f64], options: &TrajectoryOptions) -> Vec<f64> {
    let mut speeds = vec![options.speed_m_s; points.len()];
    for i in 0..lengths.len() {
        let turn = (yaws[i + 1] - yaws[i]).abs();
        if turn > 0.0 {
            let limit = lengths[i] * options.yaw_rate_rad_s / turn;
            speeds[i] = speeds[i].min(limit);
            speeds[i + 1] = speeds[i + 1].min(limit);
        }
    }
    slow_in_bends(&mut speeds, points, lengths, options.acceleration_m_s2);
    for end in [0, points.len() - 1] {
        speeds[end] = speeds[end].min(CREEP_M_S);
    }
    slow_to_reach(&mut speeds, lengths, options.acceleration_m_s2);
    speeds
}
