//! Shortest ways through a navigation grid.

use super::NavigationGrid;
use core::cmp::Reverse;
use std::collections::BinaryHeap;
use thiserror::Error;

/// Price of a tenth of a cell's side where there is room, and where it is narrow.
const PRICE_OPEN: u32 = 2;
const PRICE_CROWDED: u32 = 5;

/// Price of a tenth of a cell's side on the way out of a place that is not passable.
const PRICE_ESCAPE: u32 = 40;

/// Cells from the start within which a way may lead out of cells that are not passable.
const ESCAPE_CELLS: usize = 4;

/// Cells of a way that a straight line may stand for.
const LINE_CELLS_MAX: usize = 120;

/// A way that is asked for.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct RouteQuery {
    /// Where it begins, in metres.
    pub from: [f64; 3],
    /// Where it ends, in metres. The cell there must be passable.
    pub to: [f64; 3],
    /// Whether it may lead through Unknown cells.
    pub unknown_ok: bool,
    /// Cells that are looked at before the search gives up; some 0.3 µs each.
    pub expansions_max: usize,
}

/// Why there is no way.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Error)]
#[non_exhaustive]
pub enum NoRoute {
    /// The start lies outside of the grid's region, or in a cell from which nothing passable is near.
    #[error("there is no way out of the start: it lies outside of the region, or nothing passable is near")]
    Start,
    /// The end lies outside of the grid's region or in a cell that is not passable.
    #[error("the end is outside of the region or not passable")]
    End,
    /// All cells that can be reached were looked at.
    #[error("the end cannot be reached from the start")]
    Unreachable,
    /// The limit of the search came first.
    #[error("the search gave up after {expansions} cells: allow more, or go in smaller steps")]
    GaveUp {
        /// Cells looked at.
        expansions: usize,
    },
}

/// Finds ways through one grid. Holds the memory of the search: 12 bytes a cell.
#[derive(Clone, Debug)]
pub struct Router {
    round: u32,
    /// For each cell the round that reached it, the cost then, and where from.
    reached: Vec<(u32, u32, u32)>,
    queue: BinaryHeap<Reverse<(u32, u32, u32)>>,
}

impl Router {
    /// For a grid of this many cells.
    pub fn new(grid: &NavigationGrid) -> Self {
        Self { round: 0, reached: vec![(0, 0, 0); grid.count()], queue: BinaryHeap::new() }
    }

    /// The shortest way from cell to cell (26 neighbours, no corner cut; A*), where crowded cells count two
    /// and a half times, then straightened: as points in metres, `from` first and `to` last. Every straight
    /// piece stays in passable cells, and in uncrowded ones wherever the cells of the way did. From a
    /// place that is not passable the way leads out over at most 4 cells that are not Occupied.
    ///
    /// `avoid` names cells that are not to be entered for other reasons. The grid must be the one that this
    /// router was made for, or one of the same size.
    ///
    /// # Errors
    /// [`NoRoute`] says why there is none.
    pub fn route(
        &mut self,
        grid: &NavigationGrid,
        query: &RouteQuery,
        avoid: impl Fn(usize) -> bool,
    ) -> Result<Vec<[f64; 3]>, NoRoute> {
        let start = grid.cell_at(query.from).ok_or(NoRoute::Start)?;
        let is_open = |cell: usize| grid.is_passable(cell, query.unknown_ok) && !avoid(cell);
        let goal = grid.cell_at(query.to).filter(|goal| is_open(*goal)).ok_or(NoRoute::End)?;
        let mut expansions = 0;
        self.begin(start);
        self.queue.push(Reverse((estimate(grid, start, goal), 0, start as u32)));
        let mut found = false;
        while let Some(Reverse((_, cost, cell))) = self.queue.pop() {
            let cell = cell as usize;
            if cell == goal {
                found = true;
                break;
            }
            if cost > self.reached[cell].1 {
                continue;
            }
            if expansions == query.expansions_max {
                return Err(NoRoute::GaveUp { expansions });
            }
            expansions += 1;
            self.expand(grid, start, cell, cost, &is_open, |next| estimate(grid, next, goal));
        }
        if !found {
            return Err(if expansions <= 1 { NoRoute::Start } else { NoRoute::Unreachable });
        }
        let mut cells = vec![goal];
        let mut cell = goal;
        while cell != start {
            cell = self.reached[cell].2 as usize;
            cells.push(cell);
        }
        cells.reverse();
        Ok(straighten(grid, query, &cells, &is_open))
    }

    /// Finds the cost of the way to every cell that can be reached from a place within `metres_max`; ask for
    /// them with [`Self::metres_to`] until the next search. Rules as for [`Self::route`].
    pub fn flood(
        &mut self,
        grid: &NavigationGrid,
        from: [f64; 3],
        metres_max: f64,
        unknown_ok: bool,
        avoid: impl Fn(usize) -> bool,
    ) {
        self.begin(usize::MAX);
        let Some(start) = grid.cell_at(from) else { return };
        let is_open = |cell: usize| grid.is_passable(cell, unknown_ok) && !avoid(cell);
        self.reached[start] = (self.round, 0, start as u32);
        self.queue.push(Reverse((0, 0, start as u32)));
        let cost_max = (metres_max / grid.cell_m() * f64::from(10 * PRICE_OPEN)).min(4e9) as u32;
        while let Some(Reverse((_, cost, cell))) = self.queue.pop() {
            if cost > cost_max {
                break;
            }
            if cost == self.reached[cell as usize].1 {
                self.expand(grid, start, cell as usize, cost, &is_open, |_| 0);
            }
        }
    }

    /// Length in metres of the way found to a cell by the last [`Self::flood`] (crowded pieces count two and
    /// a half times); `None` if it was not reached.
    pub fn metres_to(&self, grid: &NavigationGrid, number: usize) -> Option<f64> {
        let (round, cost, _) = self.reached[number];
        (round == self.round).then(|| f64::from(cost) / f64::from(10 * PRICE_OPEN) * grid.cell_m())
    }

    fn begin(&mut self, start: usize) {
        if self.round == u32::MAX {
            self.round = 0;
            self.reached.fill((0, 0, 0));
        }
        self.round += 1;
        self.queue.clear();
        if start < self.reached.len() {
            self.reached[start] = (self.round, 0, start as u32);
        }
    }

    fn expand(
        &mut self,
        grid: &NavigationGrid,
        start: usize,
        cell: usize,
        cost: u32,
        is_open: &impl Fn(usize) -> bool,
        estimate: impl Fn(usize) -> u32,
    ) {
        let inside = is_open(cell);
        for (next, axes) in grid.cells().around(cell) {
            let price = if is_open(next) {
                // Out of a closed cell corners do not matter any more.
                if axes > 1 && inside && !grid.cells().corners_are_open(cell, next, is_open) {
                    continue;
                }
                if grid.is_crowded(next) { PRICE_CROWDED } else { PRICE_OPEN }
            } else if !inside && may_escape(grid, start, next) {
                PRICE_ESCAPE
            } else {
                continue;
            };
            let total = cost + [0, 10, 14, 17][axes] * price;
            let (round, old, _) = self.reached[next];
            if round != self.round || total < old {
                self.reached[next] = (self.round, total, cell as u32);
                self.queue.push(Reverse((total + estimate(next), total, next as u32)));
            }
        }
    }
}

/// Whether a way out of a closed start may lead over this closed cell.
fn may_escape(grid: &NavigationGrid, start: usize, cell: usize) -> bool {
    let (a, b) = (grid.place(start), grid.place(cell));
    grid.cell_state(cell) != super::CellState::Occupied && (0..3).all(|i| a[i].abs_diff(b[i]) <= ESCAPE_CELLS)
}

/// No more than the true cost: a way of diagonals where there is room.
fn estimate(grid: &NavigationGrid, cell: usize, goal: usize) -> u32 {
    PRICE_OPEN * grid.cells().tenths_between(cell, goal)
}

/// Leaves out cells of a way where a straight line between others is as good.
fn straighten(
    grid: &NavigationGrid,
    query: &RouteQuery,
    cells: &[usize],
    is_open: &impl Fn(usize) -> bool,
) -> Vec<[f64; 3]> {
    let last = cells.len() - 1;
    let point = |i: usize| match i {
        0 => query.from,
        i if i == last => query.to,
        i => grid.centre(cells[i]),
    };
    let mut line = vec![query.from];
    let mut from = 0;
    while from < last {
        let mut best = from + 1;
        let mut crowded = grid.is_crowded(cells[from]);
        for (to, cell) in cells.iter().enumerate().skip(from + 1).take(LINE_CELLS_MAX) {
            crowded |= grid.is_crowded(*cell);
            let fits = |cell: usize| is_open(cell) && (crowded || !grid.is_crowded(cell));
            if to > from + 1 && grid.line_fits(point(from), point(to), fits) {
                best = to;
            }
        }
        line.push(point(best));
        from = best;
    }
    if line.len() == 1 {
        line.push(query.to);
    }
    line
}
