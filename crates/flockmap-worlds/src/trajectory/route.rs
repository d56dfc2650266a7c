//! Where a robot goes: places spread over its region, and short paths between them.

use super::TrajectoryOptions;
use super::region::Region;
use super::space::Space;
use crate::curve::distance;
use crate::random::Random;
use flockmap_plan::lattice::tenths_between;
use flockmap_plan::search::{Search, Ties, straightened};

/// Metres between places that are visited in one round.
const SPACING_M: f64 = 3.0;

/// Most places of one round.
const PLACES_MAX: usize = 400;

/// Metres from anything solid beyond which a path need not keep away further.
const COMFORT_M: f64 = 0.8;

/// Price of a tenth of a cell's side in the open.
const PRICE_OPEN: u32 = 4;

/// Cells of a path that a straight line may stand for.
const LINE_CELLS_MAX: usize = 120;

/// A polyline that stays in the region, long enough for the whole flight at full speed. In metres.
pub(super) fn trajectory(
    space: &Space,
    region: &Region,
    options: &TrajectoryOptions,
    random: &mut Random,
) -> Vec<[f64; 3]> {
    let wanted = options.speed_m_s * options.duration_s + 1.0;
    let mut search = Search::new(space.lattice.count(), Ties::Cost);
    let mut here = region.start;
    let mut line = vec![space.lattice.centre(here)];
    let mut length = 0.0;
    while length < wanted {
        let mut places = places(space, region, here, random);
        while length < wanted && !places.is_empty() {
            let next = places.swap_remove(nearest(space, here, &places, random));
            let cells = path(&mut search, space, region, here, next);
            for cell in shorten(space, region, &cells).into_iter().skip(1) {
                let point = space.lattice.centre(cell);
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
            let (a, b) = (space.lattice.centre(cell), space.lattice.centre(other));
            (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2) >= SPACING_M * SPACING_M
        };
        if places.len() < PLACES_MAX && apart(here) && places.iter().all(|other| apart(*other)) {
            places.push(cell);
        }
    }
    if places.is_empty() {
        // A small region: to its far end and back.
        let origin = space.lattice.centre(here);
        let far = |cell: &u32| distance(space.lattice.centre(*cell as usize), origin);
        let farthest = region.cells.iter().copied().max_by(|a, b| far(a).total_cmp(&far(b)));
        places.push(farthest.map_or(here, |cell| cell as usize));
    }
    places
}

/// The number of a place that is near, not always the nearest.
fn nearest(space: &Space, here: usize, places: &[usize], random: &mut Random) -> usize {
    let from = space.lattice.centre(here);
    let cost = |place: &usize| distance(space.lattice.centre(*place), from) * random.range(1.0, 1.3);
    let costs = places.iter().map(cost).enumerate();
    costs.min_by(|a, b| a.1.total_cmp(&b.1)).map_or(0, |(number, _)| number)
}

/// The cells of the cheapest path from `start` to `goal`, both included and both in the region; a step costs
/// its length, more where it is narrow.
fn path(search: &mut Search, space: &Space, region: &Region, start: usize, goal: usize) -> Vec<usize> {
    let lattice = &space.lattice;
    let goal_index = lattice.index(goal);
    let estimate = |cell: usize| PRICE_OPEN * tenths_between(lattice.index(cell), goal_index);
    search.begin(start, estimate);
    // A region hangs together by faces, so the goal is reached.
    while let Some((cell, cost)) = search.visit().filter(|(cell, _)| *cell != goal) {
        for (next, tenths) in lattice.steps(cell, |next| region.contains(next)) {
            search.reach(next, cell, cost + tenths * price(space, next), estimate);
        }
    }
    search.path_to(goal)
}

/// Price of a cell for each tenth of its side: [`PRICE_OPEN`] in the open, up to 16 where it is narrow.
fn price(space: &Space, cell: usize) -> u32 {
    let near = f64::from(space.openness(cell)).sqrt() * space.lattice.side_m() / COMFORT_M;
    PRICE_OPEN + (12.0 * (1.0 - near).max(0.0)) as u32
}

/// Leaves out cells of a path where a straight line between others is as good: it stays in the region and
/// comes no closer to anything solid than the path did.
fn shorten(space: &Space, region: &Region, path: &[usize]) -> Vec<usize> {
    let fits = |from: usize, to: usize| {
        let tightest = path[from..=to].iter().map(|cell| space.openness(*cell)).min().unwrap_or_default();
        let [a, b] = [from, to].map(|i| space.lattice.centre(path[i]));
        space.lattice.line_fits(a, b, |cell| region.contains(cell) && space.openness(cell) >= tightest)
    };
    straightened(path.len(), LINE_CELLS_MAX, fits).into_iter().map(|i| path[i]).collect()
}
