//! Robots keep clear of each other.

use crate::NavigationGrid;
use flockmap_worlds::curve::{distance, line};

/// Metres added to distances between paths for the space between their samples.
const SAMPLE_SLACK_M: f64 = 0.06;

/// What a robot knows of another: where it is and where it is going.
#[derive(Clone, Debug)]
pub(super) struct Mate {
    pub(super) number: usize,
    /// Its path until it could come to rest, its position first.
    pub(super) stopping_path: Vec<[f64; 3]>,
    /// The path that it would take if nobody were on it.
    pub(super) intended: Option<Vec<[f64; 3]>>,
}

/// Whether all points of two paths are at least this far apart.
pub(super) fn are_apart(a: &[[f64; 3]], b: &[[f64; 3]], separation_m: f64) -> bool {
    a.iter().all(|p| b.iter().all(|q| distance(*p, *q) >= separation_m + SAMPLE_SLACK_M))
}

/// Metres from a point to the nearest point of a path.
pub(super) fn metres_to_path(point: [f64; 3], path: &[[f64; 3]]) -> f64 {
    path.iter().map(|p| distance(point, *p)).fold(f64::INFINITY, f64::min)
}

/// Cells nearer than this to where others are and will be until they could stop, ascending.
pub(super) fn cells_near(grid: &NavigationGrid, mates: &[Mate], wide_m: f64) -> Vec<usize> {
    let mut cells = Vec::new();
    for mate in mates {
        let mut last: Option<[f64; 3]> = None;
        for &point in &mate.stopping_path {
            // Every 20 cm and the ends will do.
            let is_end = mate.stopping_path.last() == Some(&point);
            if is_end || last.is_none_or(|last| distance(last, point) >= 0.2) {
                last = Some(point);
                let near = grid.cells.near(point, wide_m);
                cells.extend(near.filter(|cell| distance(grid.cells.centre(*cell), point) < wide_m));
            }
        }
    }
    cells.sort_unstable();
    cells.dedup();
    cells
}

/// A polyline with points at most 10 cm apart.
pub(super) fn dense(path: &[[f64; 3]]) -> Vec<[f64; 3]> {
    let rest = path.windows(2).flat_map(|pair| line(pair[0], pair[1], 0.1));
    path.first().copied().into_iter().chain(rest).collect()
}
