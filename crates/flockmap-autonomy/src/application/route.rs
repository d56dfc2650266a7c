//! The way through a slab: A* over its cells, then straightened.

use super::slab::{Slab, apart};
use core::cmp::Reverse;
use std::collections::BinaryHeap;

/// A point of a route each so many metres.
pub(super) const POINT_EVERY_M: f64 = 0.1;

/// What a way has to keep to, in metres.
#[derive(Clone, Copy)]
pub(super) struct Keep {
    /// Never nearer to an obstacle than this (centre of the robot to centre of a blocked cell).
    pub(super) clearance_m: f64,
    /// Nearer than this costs more.
    pub(super) comfort_m: f64,
}

/// So near to its start a way may lead through where it is too narrow: out of it.
const ESCAPE_M: f64 = 0.6;

/// Cost of a cell in hundredths of its length. Unknown space counts as free, but of two ways the known one is
/// taken; and a way that was taken before is kept unless another is better by more than this.
const COST_PLAIN: u32 = 100;
const COST_UNKNOWN: u32 = 40;
const COST_NEW: u32 = 15;
const COST_NARROW: f64 = 300.0;
const COST_ESCAPE: u32 = 1_000;

/// A way from one point towards another, as points [`POINT_EVERY_M`] apart. It ends at the target, at the rim of the window
/// where the target lies beyond it, or as near to the target as can be reached. `before` is the way taken so far.
/// O(cells · log cells).
pub(super) fn find(
    slab: &Slab,
    from: [f64; 2],
    to: [f64; 2],
    before: &[[f64; 2]],
    keep: &Keep,
) -> Option<Vec<[f64; 2]>> {
    let start = slab.cell(slab.place_at(from))?;
    let target = slab.place_at(to);
    let mut is_new = vec![true; slab.len()];
    for point in before {
        let [x, y] = slab.place_at(*point);
        for (dx, dy) in (-2..=2).flat_map(|dx| (-2..=2).map(move |dy| (dx, dy))) {
            if let Some(cell) = slab.cell([x + dx, y + dy]) {
                is_new[cell] = false;
            }
        }
    }
    let mut cost = vec![u32::MAX; slab.len()];
    let mut came_from = vec![start; slab.len()];
    let mut open = BinaryHeap::new();
    cost[start] = 0;
    open.push(Reverse((ahead(slab.place(start), target), start)));
    let mut best = (ahead(slab.place(start), target), start);
    while let Some(Reverse((estimate, cell))) = open.pop() {
        let place = slab.place(cell);
        let left = ahead(place, target);
        if estimate > cost[cell] + left {
            continue;
        }
        best = best.min((left, cell));
        if left == 0 || (slab.is_rim(cell) && cell != start) {
            best = (left, cell);
            break;
        }
        for (dx, dy) in [(-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)] {
            let Some(next) = slab.cell([place[0] + dx, place[1] + dy]) else { continue };
            let Some(weight) = weight(slab, next, from, is_new[next], keep) else { continue };
            // A diagonal step passes the corners of the two cells beside it: these have to be open as well.
            let beside = [[place[0] + dx, place[1]], [place[0], place[1] + dy]];
            let is_open = |beside| slab.cell(beside).is_some_and(|cell| may_enter(slab, cell, from, keep));
            if dx != 0 && dy != 0 && !beside.into_iter().all(is_open) {
                continue;
            }
            let length = if dx != 0 && dy != 0 { 14 } else { 10 };
            let reached = cost[cell] + length * weight;
            if reached < cost[next] {
                cost[next] = reached;
                came_from[next] = cell;
                open.push(Reverse((reached + ahead(slab.place(next), target), next)));
            }
        }
    }
    let mut cells = vec![best.1];
    while let Some(last) = cells.last()
        && *last != start
    {
        cells.push(came_from[*last]);
    }
    cells.reverse();
    let mut points: Vec<[f64; 2]> = cells.into_iter().map(|cell| slab.centre(cell)).collect();
    if let Some(first) = points.first_mut() {
        *first = from;
    }
    Some(straighten(slab, &points, keep))
}

/// Least cost from one cell to another.
fn ahead(a: [i32; 2], b: [i32; 2]) -> u32 {
    let [dx, dy] = [a[0].abs_diff(b[0]), a[1].abs_diff(b[1])];
    COST_PLAIN * (10 * dx.max(dy) + 4 * dx.min(dy))
}

/// Whether a way may lead through a cell: far enough from every obstacle, or on the way out of where it is too narrow.
fn may_enter(slab: &Slab, cell: usize, from: [f64; 2], keep: &Keep) -> bool {
    let distance = slab.distance(cell);
    distance >= keep.clearance_m || (distance > 0.0 && apart(slab.centre(cell), from) <= ESCAPE_M)
}

/// What a cell costs, `None` if it cannot be entered.
fn weight(slab: &Slab, cell: usize, from: [f64; 2], is_new: bool, keep: &Keep) -> Option<u32> {
    if !may_enter(slab, cell, from, keep) {
        return None;
    }
    let distance = slab.distance(cell);
    let mut weight = COST_PLAIN;
    if distance < keep.clearance_m {
        weight += COST_ESCAPE;
    }
    if distance < keep.comfort_m {
        let narrow = (keep.comfort_m - distance) / (keep.comfort_m - keep.clearance_m);
        weight += (COST_NARROW * narrow.clamp(0.0, 1.0)) as u32;
    }
    if !slab.is_known(cell) {
        weight += COST_UNKNOWN;
    }
    if is_new {
        weight += COST_NEW;
    }
    Some(weight)
}

/// Replaces stretches of a way by straight lines that come no nearer to an obstacle than the stretch did, or stay in
/// comfort.
fn straighten(slab: &Slab, points: &[[f64; 2]], keep: &Keep) -> Vec<[f64; 2]> {
    let mut way: Vec<[f64; 2]> = points.first().copied().into_iter().collect();
    let mut at = 0;
    while at + 1 < points.len() {
        let mut to = at + 1;
        let mut needed = keep.comfort_m;
        for end in at + 1..points.len().min(at + 40) {
            needed = needed.min(slab.distance_at(points[end]));
            if needed < keep.clearance_m {
                // Out of a narrow place it goes cell by cell.
                break;
            }
            if end > at + 1 && line(points[at], points[end]).all(|p| slab.distance_at(p) >= needed) {
                to = end;
            }
        }
        way.extend(line(points[at], points[to]));
        at = to;
    }
    way
}

/// Points on a straight line at most [`POINT_EVERY_M`] apart, without the first and with the last.
pub(super) fn line(a: [f64; 2], b: [f64; 2]) -> impl Iterator<Item = [f64; 2]> {
    let steps = (apart(a, b) / POINT_EVERY_M).ceil().max(1.0) as u32;
    (1..=steps).map(move |step| {
        let s = f64::from(step) / f64::from(steps);
        [a[0] + (b[0] - a[0]) * s, a[1] + (b[1] - a[1]) * s]
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const KEEP: Keep = Keep { clearance_m: 0.3, comfort_m: 0.6 };

    /// The first point after the start that is nearer to an obstacle than it may be.
    fn too_near(slab: &Slab, way: &[[f64; 2]]) -> Option<[f64; 2]> {
        let escapes = |point: [f64; 2]| apart(point, way[0]) <= ESCAPE_M + 0.1;
        let narrow = |point: [f64; 2]| slab.distance_at(point) < KEEP.clearance_m;
        way[1..].iter().copied().find(|point| narrow(*point) && !escapes(*point))
    }

    #[test]
    fn a_diagonal_step_does_not_cut_a_blocked_corner() {
        let blocked = [(-3, 3), (-13, -1), (-4, 2), (0, -4), (2, 2), (1, -3), (-7, -6), (0, 2), (-6, 0)];
        let slab = Slab::of_cells(3.0, blocked.map(|(x, y)| [x, y]));
        let from = [0.05; 2];
        let way = find(&slab, from, [-0.85, 0.05], &[], &KEEP).unwrap();
        assert_eq!(too_near(&slab, &way), None);
    }

    proptest! {
        #[test]
        fn a_way_never_comes_nearer_than_it_may(
            blocked in prop::collection::vec((-28..28i32, -28..28i32), 0..60),
            to in (-50..50i32, -50..50i32),
        ) {
            let slab = Slab::of_cells(3.0, blocked.iter().map(|(x, y)| [*x, *y]));
            let (from, to) = ([0.05; 2], [f64::from(to.0) * 0.1 + 0.05, f64::from(to.1) * 0.1 + 0.05]);
            let way = find(&slab, from, to, &[], &KEEP).unwrap();
            prop_assert_eq!(way[0], from);
            for pair in way.windows(2) {
                prop_assert!(apart(pair[0], pair[1]) < POINT_EVERY_M * 1.5);
            }
            prop_assert_eq!(too_near(&slab, &way), None);
            // Nothing near: it gets there, or to the rim.
            let end = way[way.len() - 1];
            if blocked.is_empty() {
                let rim = end.iter().any(|v| v.abs() > 2.9);
                prop_assert!(apart(end, to) < 0.01 || rim, "{:?}", end);
            }
        }
    }

    #[test]
    fn the_way_round_a_wall_is_short_and_a_way_taken_is_kept() {
        // A wall across the way, from y = -1 to 1: as far round the one end as round the other.
        let slab = Slab::of_cells(4.0, (-10..10).map(|y| [10, y]));
        let (from, to) = ([0.05, -0.05], [2.55, -0.05]);
        let way = find(&slab, from, to, &[], &KEEP).unwrap();
        assert!(apart(way[way.len() - 1], to) < 0.01);
        let length: f64 = way.windows(2).map(|pair| apart(pair[0], pair[1])).sum();
        assert!((3.3..5.0).contains(&length), "{length} m");
        let mirrored: Vec<[f64; 2]> = way.iter().map(|[x, y]| [*x, -0.1 - *y]).collect();
        let side = |way: &[[f64; 2]]| way.iter().map(|point| point[1]).sum::<f64>() > 0.0;
        let kept = find(&slab, from, to, &mirrored, &KEEP).unwrap();
        assert_eq!(side(&kept), side(&mirrored));
        assert_ne!(side(&kept), side(&way));
    }

    #[test]
    fn where_there_is_no_way_it_leads_as_near_as_it_can() {
        let closed = (-10..=10).flat_map(|v| [[10, v], [-10, v], [v, 10], [v, -10]]);
        let slab = Slab::of_cells(3.0, closed);
        let way = find(&slab, [0.05, 0.05], [2.05, 0.05], &[], &KEEP).unwrap();
        let end = way[way.len() - 1];
        assert!((0.6..0.8).contains(&end[0]) && end[1].abs() < 0.2, "{end:?}");
    }
}
