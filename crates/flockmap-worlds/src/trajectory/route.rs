//! Where a robot goes: places spread over its region, and short paths between them.

use super::TrajectoryOptions;
use super::region::Region;
use super::space::Space;
use crate::curve::distance;
use crate::random::Random;
use core::cmp::Reverse;
use std::collections::BinaryHeap;

/// Metres between places that are visited in one round.
const SPACING_M: f64 = 3.0;

/// Most places of one round.
const PLACES_MAX: usize = 400;

/// Metres from anything solid beyond which a path need not keep away further.
const COMFORT_M: f64 = 0.8;

/// A polyline that stays in the region, long enough for the whole flight at full speed. In metres.
pub(super) fn trajectory(
    space: &Space,
    region: &Region,
    options: &TrajectoryOptions,
    random: &mut Random,
) -> Vec<[f64; 3]> {
    let wanted = options.speed_m_s * options.duration_s + 1.0;
    let mut search = Search::new(space, region);
    let mut here = region.start;
    let mut line = vec![space.centre(here)];
    let mut length = 0.0;
    while length < wanted {
        let mut places = places(space, region, here, random);
        while length < wanted && !places.is_empty() {
            let next = places.swap_remove(nearest(space, here, &places, random));
            let cells = search.path(here, next);
            for cell in shorten(space, region, &cells).into_iter().skip(1) {
                let point = space.centre(cell);
                length += distance(point, line[line.len() - 1]);
                line.push(point);
            }
            here = next;
        }
    }
    line
}

/// Places to visit, none near another; at least one.
fn places(space: &Space, region: &Region, here: usize, random: &mut Random) -> Vec<usize> {
    let mut places: Vec<usize> = Vec::new();
    let pick = |random: &mut Random| region.cells[random.below(region.cells.len() as u64) as usize] as usize;
    for _ in 0..3_000 {
        let cell = pick(random);
        let apart = |other: usize| {
            let (a, b) = (space.centre(cell), space.centre(other));
            (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2) >= SPACING_M * SPACING_M
        };
        if places.len() < PLACES_MAX && apart(here) && places.iter().all(|other| apart(*other)) {
            places.push(cell);
        }
    }
    if places.is_empty() {
        // A small region: to its far end and back.
        let origin = space.centre(here);
        let far = |cell: &u32| distance(space.centre(*cell as usize), origin);
        let farthest = region.cells.iter().copied().max_by(|a, b| far(a).total_cmp(&far(b)));
        places.push(farthest.map_or(here, |cell| cell as usize));
    }
    places
}

/// The number of a place that is near, not always the nearest.
fn nearest(space: &Space, here: usize, places: &[usize], random: &mut Random) -> usize {
    let from = space.centre(here);
    let mut best = (f64::INFINITY, 0);
    for (number, place) in places.iter().enumerate() {
        let cost = distance(space.centre(*place), from) * random.range(1.0, 1.3);
        if cost < best.0 {
            best = (cost, number);
        }
    }
    best.1
}

/// A* over the cells of a region; a step costs its length, more where it is narrow.
struct Search<'a> {
    space: &'a Space,
    region: &'a Region,
    round: u32,
    /// For each cell the round that reached it, the cost then, and where from.
    reached: Vec<(u32, u32, u32)>,
}

impl<'a> Search<'a> {
    fn new(space: &'a Space, region: &'a Region) -> Self {
        Self { space, region, round: 0, reached: vec![(0, 0, 0); space.count()] }
    }

    /// The cells from `start` to `goal`, both included. Both must lie in the region.
    fn path(&mut self, start: usize, goal: usize) -> Vec<usize> {
        self.round += 1;
        let mut queue = BinaryHeap::new();
        self.reached[start] = (self.round, 0, start as u32);
        queue.push(Reverse((self.estimate(start, goal), 0, start as u32)));
        while let Some(Reverse((_, cost, cell))) = queue.pop() {
            let cell = cell as usize;
            if cell == goal {
                break;
            }
            if cost > self.reached[cell].1 {
                continue;
            }
            for (next, axes) in self.space.lattice().around(cell) {
                if !self.region.contains(next) || (axes > 1 && !self.free_between(cell, next)) {
                    continue;
                }
                let total = cost + [0, 10, 14, 17][axes] * self.price(next);
                let (round, old, _) = self.reached[next];
                if round != self.round || total < old {
                    self.reached[next] = (self.round, total, cell as u32);
                    queue.push(Reverse((total + self.estimate(next, goal), total, next as u32)));
                }
            }
        }
        let mut path = vec![goal];
        let mut cell = goal;
        while cell != start {
            // A region hangs together by faces, so the goal was reached.
            cell = self.reached[cell].2 as usize;
            path.push(cell);
        }
        path.reverse();
        path
    }

    /// Price of a cell for each tenth of its side: 4 in the open, up to 16 where it is narrow.
    fn price(&self, cell: usize) -> u32 {
        let near = f64::from(self.space.openness(cell)).sqrt() * self.space.step_m() / COMFORT_M;
        4 + (12.0 * (1.0 - near).max(0.0)) as u32
    }

    /// No more than the true cost: a path of diagonals in the open.
    fn estimate(&self, cell: usize, goal: usize) -> u32 {
        4 * self.space.lattice().tenths_between(cell, goal)
    }

    /// Whether all cells of the box between two diagonal neighbours belong to the region, so that no corner
    /// is cut.
    fn free_between(&self, cell: usize, next: usize) -> bool {
        self.space.lattice().corners_are_open(cell, next, |between| self.region.contains(between))
    }
}

/// Leaves out cells of a path where a straight line between others is as good: it stays in the region and
/// comes no closer to anything solid than the path did.
fn shorten(space: &Space, region: &Region, path: &[usize]) -> Vec<usize> {
    let mut short = vec![path[0]];
    let mut from = 0;
    while from + 1 < path.len() {
        let mut to = from + 1;
        let mut tightest = space.openness(path[from]).min(space.openness(path[to]));
        let mut best = to;
        // Look a good way ahead; a line may become free again after a corner.
        while to + 1 < path.len() && to - from < 120 {
            to += 1;
            tightest = tightest.min(space.openness(path[to]));
            if line_is_free(space, region, space.centre(path[from]), space.centre(path[to]), tightest) {
                best = to;
            }
        }
        short.push(path[best]);
        from = best;
    }
    short
}

/// Whether a line stays in the region and in cells at least this open.
fn line_is_free(space: &Space, region: &Region, a: [f64; 3], b: [f64; 3], openness: u16) -> bool {
    space.line_fits(a, b, |cell| region.contains(cell) && space.openness(cell) >= openness)
}
