//! Paths as points close together, and how fast they can be flown.

use core::f64::consts::{PI, TAU};

/// Metres between samples of a path.
pub const SAMPLE_M: f64 = 0.05;

/// Metres before a corner at which it is begun to be rounded.
pub const CORNER_M: f64 = 1.2;

/// Speed at the start and end of a path, in m/s: next to nothing, but not nothing, so that it ends.
pub const CREEP_M_S: f64 = 0.01;

/// Metres between two points.
pub fn distance<const N: usize>(a: [f64; N], b: [f64; N]) -> f64 {
    (0..N).map(|i| (a[i] - b[i]) * (a[i] - b[i])).sum::<f64>().sqrt()
}

/// The point at this share of the straight line from `a` to `b`.
pub fn between<const N: usize>(a: [f64; N], b: [f64; N], share: f64) -> [f64; N] {
    core::array::from_fn(|i| a[i] + (b[i] - a[i]) * share)
}

/// Points on the straight line from `a` to `b`, at most `every_m` metres apart; without `a`, and `b` at the end.
pub fn line<const N: usize>(a: [f64; N], b: [f64; N], every_m: f64) -> impl Iterator<Item = [f64; N]> {
    let steps = (distance(a, b) / every_m).ceil() as u32;
    (1..=steps).map(move |step| between(a, b, f64::from(step) / f64::from(steps)))
}

/// The point `reach` metres from `from` in the direction of `to`.
pub fn towards(from: [f64; 3], to: [f64; 3], reach: f64) -> [f64; 3] {
    between(from, to, reach / distance(from, to).max(1e-9))
}

/// A quadratic Bézier curve, sampled.
fn bend(a: [f64; 3], b: [f64; 3], c: [f64; 3]) -> Vec<[f64; 3]> {
    let steps = ((distance(a, b) + distance(b, c)) / SAMPLE_M).ceil() as u32;
    let at =
        |s: f64| core::array::from_fn(|i| (1.0 - s) * ((1.0 - s) * a[i] + 2.0 * s * b[i]) + s * s * c[i]);
    (0..=steps).map(|step| at(f64::from(step) / f64::from(steps))).collect()
}

/// Goes on from the last of the points (there must be one) straight to `to`.
fn straight(points: &mut Vec<[f64; 3]>, to: [f64; 3]) {
    points.extend(line(points[points.len() - 1], to, SAMPLE_M));
}

/// Lowers speeds so that no point of a path asks for more acceleration across it. `lengths` are those between
/// the points.
pub fn slow_in_bends(speeds: &mut [f64], points: &[[f64; 3]], lengths: &[f64], acceleration_m_s2: f64) {
    for i in 1..lengths.len() {
        // How much the direction changes here, over the length it takes.
        let bend = (0..3)
            .map(|a| {
                let into = (points[i][a] - points[i - 1][a]) / lengths[i - 1];
                let out = (points[i + 1][a] - points[i][a]) / lengths[i];
                (out - into) * (out - into)
            })
            .sum::<f64>()
            .sqrt();
        if bend > 1e-9 {
            let reach = 0.5 * (lengths[i - 1] + lengths[i]);
            speeds[i] = speeds[i].min((acceleration_m_s2 * reach / bend).sqrt());
        }
    }
}

/// Lowers speeds so that each can be reached from its neighbours by speeding up and braking within a limit.
pub fn slow_to_reach(speeds: &mut [f64], lengths: &[f64], acceleration_m_s2: f64) {
    let reachable = |from: f64, length: f64| (from * from + 2.0 * acceleration_m_s2 * length).sqrt();
    for i in 1..speeds.len() {
        speeds[i] = speeds[i].min(reachable(speeds[i - 1], lengths[i - 1]));
    }
    for i in (1..speeds.len()).rev() {
        speeds[i - 1] = speeds[i - 1].min(reachable(speeds[i], lengths[i - 1]));
    }
}

/// Samples of the committed path and on along the waypoints, corners rounded; at the end of the committed path at
/// most `tail_m` metres before it. Also how many samples of the committed path are left.
pub fn rounded(
    committed: &[[f64; 3]],
    tail_m: f64,
    waypoints: &[[f64; 3]],
    fits: impl Fn([f64; 3], [f64; 3]) -> bool,
) -> (Vec<[f64; 3]>, usize) {
    let mut points = committed.to_vec();
    let mut kept = points.len();
    let mut line = vec![points[points.len() - 1]];
    for &waypoint in waypoints {
        if distance(waypoint, line[line.len() - 1]) > 1e-6 {
            line.push(waypoint);
        }
    }
    for i in 0..line.len() - 1 {
        let (corner, after) = (line[i], line[i + 1]);
        let before_m = if i == 0 { tail_m } else { 0.5 * distance(line[i - 1], corner) };
        let mut cut = CORNER_M.min(before_m).min(0.5 * distance(corner, after));
        let mut arc = Vec::new();
        while cut > SAMPLE_M {
            let before = if i == 0 { point_before(&points, cut) } else { towards(corner, line[i - 1], cut) };
            arc = bend(before, corner, towards(corner, after, cut));
            if arc.windows(2).all(|pair| fits(pair[0], pair[1])) {
                break;
            }
            arc.clear();
            cut /= 2.0;
        }
        match arc.first() {
            Some(&start) if i == 0 => {
                shorten_by(&mut points, cut);
                kept = points.len();
                points.push(start);
            }
            Some(&start) => straight(&mut points, start),
            None => straight(&mut points, corner),
        }
        points.extend(arc.into_iter().skip(1));
    }
    if line.len() > 1 {
        straight(&mut points, line[line.len() - 1]);
    }
    // What was committed stays sample by sample.
    let mut samples: Vec<[f64; 3]> = points.iter().take(kept).copied().collect();
    for &point in points.iter().skip(kept) {
        if distance(samples[samples.len() - 1], point) > 1e-6 {
            samples.push(point);
        }
    }
    (samples, kept)
}

/// An angle as −π … π.
pub fn wrapped(angle: f64) -> f64 {
    let turn = angle % TAU;
    if turn > PI {
        turn - TAU
    } else if turn < -PI {
        turn + TAU
    } else {
        turn
    }
}

/// The point on the straight end of a path that lies `reach` metres before its end.
fn point_before(path: &[[f64; 3]], reach: f64) -> [f64; 3] {
    let end = path[path.len() - 1];
    let start = path.iter().rev().find(|p| distance(**p, end) >= reach - 1e-9).unwrap_or(&path[0]);
    towards(end, *start, reach)
}

/// Takes the samples within `reach` metres of the end off a path; the first always stays.
fn shorten_by(path: &mut Vec<[f64; 3]>, reach: f64) {
    let end = path[path.len() - 1];
    while path.len() > 1 && distance(path[path.len() - 1], end) < reach {
        path.pop();
    }
}
