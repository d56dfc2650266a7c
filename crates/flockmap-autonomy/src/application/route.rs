//! The path through a slab: A* over its cells, then straightened.

use super::slab::Slab;
use flockmap_plan::lattice::tenths_between;
use flockmap_plan::search::{Search, Ties, straightened};
use flockmap_worlds::curve::{distance, line};

/// A point of a route each so many metres.
pub(super) const POINT_EVERY_M: f64 = 0.1;

/// Cells of a path that a straight line may stand for.
const LINE_CELLS_MAX: usize = 39;

/// What a path has to keep to, in metres.
#[derive(Clone, Copy)]
pub(super) struct Keep {
    /// Never nearer to an obstacle than this (centre of the robot to centre of a blocked cell).
    pub(super) clearance_m: f64,
    /// Nearer than this costs more.
    pub(super) comfort_m: f64,
}

/// So near to its start a path may lead through where it is too narrow: out of it.
const ESCAPE_M: f64 = 0.6;

/// Cost of a cell in hundredths of its length. Unknown space counts as free, but of two paths the known one is
/// taken; and a path that was taken before is kept unless another is better by more than this.
const COST_PLAIN: u32 = 100;
const COST_UNKNOWN: u32 = 40;
const COST_NEW: u32 = 15;
const COST_NARROW: f64 = 300.0;
const COST_ESCAPE: u32 = 1_000;

/// A path from one point towards another, as points [`POINT_EVERY_M`] apart. It ends at the target, at the
/// rim of the window where the target lies beyond it, or as near to the target as can be reached. `before` is
/// the path taken so far. O(cells · log cells).
pub(super) fn find(
    slab: &Slab,
    from: [f64; 2],
    to: [f64; 2],
    before: &[[f64; 2]],
    keep: &Keep,
) -> Option<Vec<[f64; 2]>> {
    let start = slab.cell_at(from)?;
    let target = slab.cells.index_at([to[0], to[1], 0.0]);
    let mut is_new = vec![true; slab.cells.count()];
    for [x, y] in before {
        let [x, y, _] = slab.cells.index_at([*x, *y, 0.0]);
        for (dx, dy) in (-2..=2).flat_map(|dx| (-2..=2).map(move |dy| (dx, dy))) {
            if let Some(cell) = slab.cells.number_of([x + dx, y + dy, 0]) {
                is_new[cell] = false;
            }
        }
    }
    let left = |cell: usize| COST_PLAIN * tenths_between(slab.cells.index(cell), target);
    let mut search = Search::new(slab.cells.count(), Ties::Number);
    search.begin(start, left);
    let mut best = (left(start), start);
    while let Some((cell, cost)) = search.visit() {
        best = best.min((left(cell), cell));
        if best.0 == 0 {
            break;
        }
        if slab.is_rim(cell) && cell != start {
            best.1 = cell;
            break;
        }
        for (next, tenths) in slab.cells.steps(cell, |next| may_enter(slab, next, from, keep)) {
            search.reach(next, cell, cost + tenths * weight(slab, next, is_new[next], keep), left);
        }
    }
    let mut points: Vec<[f64; 2]> =
        search.path_to(best.1).into_iter().map(|cell| slab.centre(cell)).collect();
    points[0] = from;
    Some(straighten(slab, &points, keep))
}

/// Whether a path may lead through a cell: far enough from every obstacle, or out of where it is too narrow.
fn may_enter(slab: &Slab, cell: usize, from: [f64; 2], keep: &Keep) -> bool {
    let away = slab.distance[cell];
    away >= keep.clearance_m || (away > 0.0 && distance(slab.centre(cell), from) <= ESCAPE_M)
}

/// What a cell costs that may be entered.
fn weight(slab: &Slab, cell: usize, is_new: bool, keep: &Keep) -> u32 {
    let away = slab.distance[cell];
    let mut weight = COST_PLAIN;
    if away < keep.clearance_m {
        weight += COST_ESCAPE;
    }
    if away < keep.comfort_m {
        let narrow = (keep.comfort_m - away) / (keep.comfort_m - keep.clearance_m);
        weight += (COST_NARROW * narrow.clamp(0.0, 1.0)) as u32;
    }
    if !slab.known[cell] {
        weight += COST_UNKNOWN;
    }
    if is_new {
        weight += COST_NEW;
    }
    weight
}

/// Replaces stretches of a path by straight lines that come no nearer to an obstacle than the stretch did, or
/// stay in comfort. Out of a narrow place it goes cell by cell.
fn straighten(slab: &Slab, points: &[[f64; 2]], keep: &Keep) -> Vec<[f64; 2]> {
    let fits = |from: usize, to: usize| {
        let distances = points[from + 1..=to].iter().map(|point| slab.distance_at(*point));
        let needed = distances.fold(keep.comfort_m, f64::min);
        needed >= keep.clearance_m
            && line(points[from], points[to], POINT_EVERY_M).all(|p| slab.distance_at(p) >= needed)
    };
    let kept = straightened(points.len(), LINE_CELLS_MAX, fits);
    let lines = kept.windows(2).flat_map(|pair| line(points[pair[0]], points[pair[1]], POINT_EVERY_M));
    points.first().copied().into_iter().chain(lines).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const KEEP: Keep = Keep { clearance_m: 0.3, comfort_m: 0.6 };

    /// The first point after the start that is nearer to an obstacle than it may be.
    fn too_near(slab: &Slab, path: &[[f64; 2]]) -> Option<[f64; 2]> {
        let escapes = |point: [f64; 2]| distance(point, path[0]) <= ESCAPE_M + 0.1;
        let narrow = |point: [f64; 2]| slab.distance_at(point) < KEEP.clearance_m;
        path[1..].iter().copied().find(|point| narrow(*point) && !escapes(*point))
    }

    #[test]
    fn a_diagonal_step_does_not_cut_a_blocked_corner() {
        let blocked = [(-3, 3), (-13, -1), (-4, 2), (0, -4), (2, 2), (1, -3), (-7, -6), (0, 2), (-6, 0)];
        let slab = Slab::of_cells(3.0, blocked.map(|(x, y)| [x, y]));
        let from = [0.05; 2];
        let path = find(&slab, from, [-0.85, 0.05], &[], &KEEP).unwrap();
        assert_eq!(too_near(&slab, &path), None);
    }

    proptest! {
        #[test]
        fn a_path_never_comes_nearer_than_it_may(
            blocked in prop::collection::vec((-28..28i32, -28..28i32), 0..60),
            to in (-50..50i32, -50..50i32),
        ) {
            let slab = Slab::of_cells(3.0, blocked.iter().map(|(x, y)| [*x, *y]));
            let (from, to) = ([0.05; 2], [f64::from(to.0) * 0.1 + 0.05, f64::from(to.1) * 0.1 + 0.05]);
            let path = find(&slab, from, to, &[], &KEEP).unwrap();
            prop_assert_eq!(path[0], from);
            for pair in path.windows(2) {
                prop_assert!(distance(pair[0], pair[1]) < POINT_EVERY_M * 1.5);
            }
            prop_assert_eq!(too_near(&slab, &path), None);
            // Nothing near: it gets there, or to the rim.
            let end = path[path.len() - 1];
            if blocked.is_empty() {
                let rim = end.iter().any(|v| v.abs() > 2.9);
                prop_assert!(distance(end, to) < 0.01 || rim, "{:?}", end);
            }
        }
    }

    #[test]
    fn the_path_round_a_wall_is_short_and_a_path_taken_is_kept() {
        // A wall across the path, from y = -1 to 1: as far round the one end as round the other.
        let slab = Slab::of_cells(4.0, (-10..10).map(|y| [10, y]));
        let (from, to) = ([0.05, -0.05], [2.55, -0.05]);
        let path = find(&slab, from, to, &[], &KEEP).unwrap();
        assert!(distance(path[path.len() - 1], to) < 0.01);
        let length: f64 = path.windows(2).map(|pair| distance(pair[0], pair[1])).sum();
        assert!((3.3..5.0).contains(&length), "{length} m");
        let mirrored: Vec<[f64; 2]> = path.iter().map(|[x, y]| [*x, -0.1 - *y]).collect();
        let side = |path: &[[f64; 2]]| path.iter().map(|point| point[1]).sum::<f64>() > 0.0;
        let kept = find(&slab, from, to, &mirrored, &KEEP).unwrap();
        assert_eq!(side(&kept), side(&mirrored));
        assert_ne!(side(&kept), side(&path));
    }

    #[test]
    fn where_there_is_no_path_it_leads_as_near_as_it_can() {
        let closed = (-10..=10).flat_map(|v| [[10, v], [-10, v], [v, 10], [v, -10]]);
        let slab = Slab::of_cells(3.0, closed);
        let path = find(&slab, [0.05, 0.05], [2.05, 0.05], &[], &KEEP).unwrap();
        let end = path[path.len() - 1];
        assert!((0.6..0.8).contains(&end[0]) && end[1].abs() < 0.2, "{end:?}");
    }
}
