//! Robots keep out of each other's way.

use crate::curve::distance;

/// Metres added to distances between paths for the space between their samples.
const SAMPLE_SLACK_M: f64 = 0.06;

/// What a robot knows of another: where it is and where it is going.
#[derive(Clone, Debug)]
pub(super) struct Mate {
    pub(super) number: usize,
    /// Its path until it could come to rest, its position first.
    pub(super) stopping_path: Vec<[f64; 3]>,
    /// The way that it would go if nobody were in it.
    pub(super) wish: Option<Vec<[f64; 3]>>,
}

/// Whether all points of two paths are at least this far apart.
pub(super) fn are_apart(a: &[[f64; 3]], b: &[[f64; 3]], separation_m: f64) -> bool {
    a.iter().all(|p| b.iter().all(|q| distance(*p, *q) >= separation_m + SAMPLE_SLACK_M))
}

/// Metres from a point to the nearest point of a path.
pub(super) fn metres_to_path(point: [f64; 3], path: &[[f64; 3]]) -> f64 {
    path.iter().map(|p| distance(point, *p)).fold(f64::INFINITY, f64::min)
}
