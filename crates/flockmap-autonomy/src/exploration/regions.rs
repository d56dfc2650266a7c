//! Regions of the ground plan, and how two robots divide them.

use crate::{CellState, NavigationGrid};
use flockmap_worlds::curve::distance;

/// Longest side of a region in metres.
const SIDE_MAX_M: f64 = 5.0;

/// A region of which this share of the cells is Unknown has to be gone to even without a frontier in sight.
const UNKNOWN_SHARE: f64 = 0.4;

/// Seconds of work that a wholly unknown region means.
const WORK_S: f64 = 5.0;

/// Frontier cells that mean a second of work.
const CELLS_PER_S: f64 = 60.0;

/// Metres flown a second, turns and waiting included.
const PACE_M_S: f64 = 1.0;

/// Most of all the work that one of two robots gets, as in RACER.
const WORK_SHARE_MAX: f64 = 0.75;

/// A robot gets a worse share of the work only if it is worse by at least so many seconds: no flickering.
const GAIN_MIN_S: f64 = 1.0;

/// Directions of straight lines that are tried to part the regions of two robots.
const CUTS: u32 = 8;

/// Equal columns of the region to be explored, at most 5 m on a side and of full height.
#[derive(Clone, Debug)]
pub(super) struct Regions {
    low_m: [f64; 2],
    side_m: [f64; 2],
    along: [usize; 2],
}

impl Regions {
    pub(super) fn new(region_m: [[f64; 3]; 2]) -> Self {
        let [low, high] = region_m;
        let along = [0, 1].map(|a| (((high[a] - low[a]) / SIDE_MAX_M - 1e-9).ceil() as usize).clamp(1, 256));
        let side_m = [0, 1].map(|a| (high[a] - low[a]) / along[a] as f64);
        Self { low_m: [low[0], low[1]], side_m, along }
    }

    pub(super) const fn count(&self) -> usize {
        self.along[0] * self.along[1]
    }

    pub(super) fn at(&self, point: [f64; 3]) -> usize {
        let index = |a: usize| {
            let i = ((point[a] - self.low_m[a]) / self.side_m[a]).floor().max(0.0) as usize;
            i.min(self.along[a] - 1)
        };
        index(1) * self.along[0] + index(0)
    }

    /// Its middle on the ground plan.
    pub(super) fn centre(&self, region: usize) -> [f64; 3] {
        let at = [region % self.along[0], region / self.along[0]];
        let [x, y] = [0, 1].map(|a| self.low_m[a] + (at[a] as f64 + 0.5) * self.side_m[a]);
        [x, y, 0.0]
    }

    /// Share of each region's cells that are Unknown.
    pub(super) fn unknown_shares(&self, grid: &NavigationGrid) -> Vec<f64> {
        let [nx, ny, nz] = grid.cells.size();
        let mut counts = vec![[0u32; 2]; self.count()];
        for y in 0..ny {
            for x in 0..nx {
                let [unknown, all] = &mut counts[self.at(grid.cells.centre(grid.cells.number([x, y, 0])))];
                *all += nz as u32;
                *unknown += (0..nz)
                    .filter(|&z| grid.cell_state(grid.cells.number([x, y, z])) == CellState::Unknown)
                    .count() as u32;
            }
        }
        counts.iter().map(|[unknown, all]| f64::from(*unknown) / f64::from((*all).max(1))).collect()
    }
}

/// Seconds of work in each region.
pub(super) fn work(unknown_shares: &[f64], frontier_cells: &[usize]) -> Vec<f64> {
    let one = |(share, cells): (&f64, &usize)| {
        let unknown = if *share > UNKNOWN_SHARE { WORK_S * share } else { 0.0 };
        unknown + *cells as f64 / CELLS_PER_S
    };
    unknown_shares.iter().zip(frontier_cells).map(one).collect()
}

/// Divides regions between two robots, so that the later one is done as early as possible: which regions go to
/// the second. `pool` names the regions, `was_second` who has them now, `work` what is to be done in each.
pub(super) fn divide(
    regions: &Regions,
    pool: &[usize],
    work: &[f64],
    places: [[f64; 3]; 2],
    was_second: &[bool],
) -> Vec<bool> {
    let centre = |i: usize| regions.centre(pool[i]);
    let relevant: Vec<usize> = (0..pool.len()).filter(|i| work[pool[*i]] > 0.0).collect();
    let total: f64 = relevant.iter().map(|i| work[pool[*i]]).sum();
    let cost = |second: &[bool]| {
        let mut seconds = [0.0; 2];
        let mut share = [0.0; 2];
        for robot in 0..2 {
            let mine: Vec<usize> = relevant.iter().copied().filter(|i| second[*i] == (robot == 1)).collect();
            share[robot] = mine.iter().map(|i| work[pool[*i]]).sum();
            let stops: Vec<[f64; 3]> = mine.iter().map(|i| centre(*i)).collect();
            let from = [places[robot][0], places[robot][1], 0.0];
            seconds[robot] = share[robot] + tour_m(from, &stops) / PACE_M_S;
        }
        let over = (share[0].max(share[1]) - WORK_SHARE_MAX * total).max(0.0);
        let over = if relevant.len() > 1 { over } else { 0.0 };
        seconds[0].max(seconds[1]) + 0.2 * (seconds[0] + seconds[1]) + over
    };
    let improved = |mut second: Vec<bool>| {
        let mut best = cost(&second);
        for _ in 0..10 {
            let before = best;
            for &i in &relevant {
                second[i] = !second[i];
                let now = cost(&second);
                if now < best - 1e-9 {
                    best = now;
                } else {
                    second[i] = !second[i];
                }
            }
            if best > before - 1e-6 {
                break;
            }
        }
        (best, second)
    };
    let nearer = |i: usize| {
        let to = centre(i);
        let away = places.map(|p| distance([p[0], p[1], 0.0], to));
        away[1] < away[0]
    };
    let nearest: Vec<bool> = (0..pool.len()).map(nearer).collect();
    // Halves on the two sides of a straight line, whichever is best.
    let halves = (0..2 * CUTS).map(|cut| {
        let angle = f64::from(cut) * core::f64::consts::PI / f64::from(CUTS);
        let (c, s) = (libm::cos(angle), libm::sin(angle));
        let along = |i: &usize| {
            let [x, y, _] = centre(*i);
            x * c + y * s
        };
        let mut order = relevant.clone();
        order.sort_by(|a, b| along(a).total_cmp(&along(b)));
        let mut second = nearest.clone();
        let mut before = 0.0;
        for i in order {
            second[i] = before + 0.5 * work[pool[i]] > 0.5 * total;
            before += work[pool[i]];
        }
        second
    });
    let best_half = halves.map(|second| (cost(&second), second)).min_by(|a, b| a.0.total_cmp(&b.0));
    let fresh = match best_half {
        Some((half_cost, half)) if half_cost <= cost(&nearest) => half,
        _ => nearest,
    };
    let (kept_cost, kept) = improved(was_second.to_vec());
    let (fresh_cost, fresh) = improved(fresh);
    let (cost_new, new) =
        if fresh_cost < kept_cost - GAIN_MIN_S { (fresh_cost, fresh) } else { (kept_cost, kept) };
    if cost_new < cost(was_second) - GAIN_MIN_S { new } else { was_second.to_vec() }
}

/// Length of a tour through all stops, nearest first.
fn tour_m(from: [f64; 3], stops: &[[f64; 3]]) -> f64 {
    let mut left: Vec<[f64; 3]> = stops.to_vec();
    let mut here = from;
    let mut length = 0.0;
    let nearest_of = |here: [f64; 3], left: &[[f64; 3]]| {
        let away = left.iter().map(|stop| distance(here, *stop)).enumerate();
        away.min_by(|a, b| a.1.total_cmp(&b.1))
    };
    while let Some((nearest, away)) = nearest_of(here, &left) {
        length += away;
        here = left.swap_remove(nearest);
    }
    length
}

/// An order in which to visit stops, starting from none of them: nearest first, then made shorter by turning
/// parts round (2-opt). `first` is the cost of going to each first.
pub(super) fn tour(first: &[f64], cost: impl Fn(usize, usize) -> f64) -> Vec<usize> {
    let count = first.len();
    let mut order: Vec<usize> = Vec::with_capacity(count);
    let mut used = vec![false; count];
    while order.len() < count {
        let from_last = |i: usize| order.last().map_or(first[i], |last| cost(*last, i));
        let next = (0..count).filter(|i| !used[*i]).min_by(|a, b| from_last(*a).total_cmp(&from_last(*b)));
        let Some(next) = next else { break };
        used[next] = true;
        order.push(next);
    }
    let leg = |order: &[usize], i: usize| match i {
        0 => first[order[0]],
        i if i < order.len() => cost(order[i - 1], order[i]),
        _ => 0.0,
    };
    for _ in 0..20 {
        let mut better = false;
        for i in 0..count {
            for j in i + 1..count {
                let before = leg(&order, i) + leg(&order, j + 1);
                let start = if i == 0 { first[order[j]] } else { cost(order[i - 1], order[j]) };
                let end = if j + 1 < count { cost(order[i], order[j + 1]) } else { 0.0 };
                if start + end < before - 1e-9 {
                    order[i..=j].reverse();
                    better = true;
                }
            }
        }
        if !better {
            break;
        }
    }
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_robots_at_one_place_divide_a_long_hall_into_two_halves() {
        let regions = Regions::new([[-30.0, -6.0, 0.0], [30.0, 6.0, 3.0]]);
        assert_eq!(regions.count(), 12 * 3);
        let pool: Vec<usize> = (0..regions.count()).collect();
        let work = vec![5.0; regions.count()];
        let second = divide(&regions, &pool, &work, [[0.0; 3], [1.0, 0.0, 0.0]], &vec![false; pool.len()]);
        let ones = second.iter().filter(|is_second| **is_second).count();
        assert!(ones * 2 == pool.len(), "{ones} of {}", pool.len());
        // Each row of the hall is cut once.
        for row in second.chunks(12) {
            let cuts = row.windows(2).filter(|pair| pair[0] != pair[1]).count();
            assert_eq!(cuts, 1, "{second:?}");
        }
    }
}
