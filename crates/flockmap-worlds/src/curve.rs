//! Paths as points close together, and how fast they can be flown.

/// Metres between samples of a path.
pub const SAMPLE_M: f64 = 0.05;

/// Speed at the start and end of a path, in m/s: next to nothing, but not nothing, so that it ends.
pub const CREEP_M_S: f64 = 0.01;

/// Metres between two points.
pub fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|i| (a[i] - b[i]) * (a[i] - b[i])).sum::<f64>().sqrt()
}

/// The point `reach` metres from `from` in the direction of `to`.
pub fn towards(from: [f64; 3], to: [f64; 3], reach: f64) -> [f64; 3] {
    let s = reach / distance(from, to).max(1e-9);
    core::array::from_fn(|i| from[i] + (to[i] - from[i]) * s)
}

/// A quadratic Bézier curve, sampled.
pub fn bend(a: [f64; 3], b: [f64; 3], c: [f64; 3]) -> Vec<[f64; 3]> {
    let steps = ((distance(a, b) + distance(b, c)) / SAMPLE_M).ceil() as u32;
    let at =
        |s: f64| core::array::from_fn(|i| (1.0 - s) * ((1.0 - s) * a[i] + 2.0 * s * b[i]) + s * s * c[i]);
    (0..=steps).map(|step| at(f64::from(step) / f64::from(steps))).collect()
}

/// Goes on from the last of the points (there must be one) straight to `to`.
pub fn straight(points: &mut Vec<[f64; 3]>, to: [f64; 3]) {
    let from = points[points.len() - 1];
    let steps = (distance(from, to) / SAMPLE_M).ceil() as u32;
    for step in 1..=steps {
        let s = f64::from(step) / f64::from(steps);
        points.push(core::array::from_fn(|i| from[i] + (to[i] - from[i]) * s));
    }
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
