//! Shortest paths through a navigation grid.

use super::CellState;
use super::NavigationGrid;
use flockmap_plan::lattice::tenths_between;
use flockmap_plan::search::{Search, Ties, straightened};
use thiserror::Error;

/// Price of a tenth of a cell's side where there is room, and where it is narrow.
const PRICE_OPEN: u32 = 2;
const PRICE_CROWDED: u32 = 5;

/// Price of a tenth of a cell's side on the path out of a place that is not passable.
const PRICE_ESCAPE: u32 = 40;

/// Cells from the start within which a path may lead out of cells that are not passable.
const ESCAPE_CELLS: usize = 4;

/// Cells of a path that a straight line may stand for.
const LINE_CELLS_MAX: usize = 120;

/// A path that is asked for.
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

/// Why there is no path.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Error)]
#[non_exhaustive]
pub enum NoRoute {
    /// The start lies outside of the grid's region, or in a cell from which nothing passable is near.
    #[error("there is no path out of the start: it lies outside of the region, or nothing passable is near")]
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

/// Finds paths through one grid. Holds the memory of the search: 12 bytes a cell.
#[derive(Clone, Debug)]
pub struct Router {
    search: Search,
}

impl Router {
    /// For a grid of this many cells.
    pub fn new(grid: &NavigationGrid) -> Self {
        Self { search: Search::new(grid.count(), Ties::Cost) }
    }

    /// The shortest path from cell to cell (26 neighbours, no corner cut; A*), where crowded cells count two
    /// and a half times, then straightened: as points in metres, `from` first and `to` last. Every straight
    /// piece stays in passable cells, and in uncrowded ones wherever the cells of the path did. From a
    /// place that is not passable the path leads out over at most 4 cells that are not Occupied.
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
        let start = grid.cells.cell_at(query.from).ok_or(NoRoute::Start)?;
        let is_open = |cell: usize| grid.is_passable(cell, query.unknown_ok) && !avoid(cell);
        let goal = grid.cells.cell_at(query.to).filter(|goal| is_open(*goal)).ok_or(NoRoute::End)?;
        let goal_index = grid.cells.index(goal);
        // No more than the true cost: a path of diagonals where there is room.
        let estimate = |cell: usize| PRICE_OPEN * tenths_between(grid.cells.index(cell), goal_index);
        let mut expansions = 0;
        self.search.begin(start, estimate);
        while let Some((cell, cost)) = self.search.visit() {
            if cell == goal {
                return Ok(straighten(grid, query, &self.search.path_to(goal), is_open));
            }
            if expansions == query.expansions_max {
                return Err(NoRoute::GaveUp { expansions });
            }
            expansions += 1;
            self.expand(grid, start, (cell, cost), &is_open, estimate);
        }
        Err(if expansions <= 1 { NoRoute::Start } else { NoRoute::Unreachable })
    }

    /// Finds the cost of the path to every cell that can be reached from a place within `metres_max`; ask for
    /// them with [`Self::metres_to`] until the next search. Rules as for [`Self::route`], and never through
    /// Unknown cells.
    pub fn flood(
        &mut self,
        grid: &NavigationGrid,
        from: [f64; 3],
        metres_max: f64,
        avoid: impl Fn(usize) -> bool,
    ) {
        self.search.clear();
        let Some(start) = grid.cells.cell_at(from) else { return };
        let is_open = |cell: usize| grid.is_passable(cell, false) && !avoid(cell);
        let cost_max = (metres_max / grid.cells.side_m() * f64::from(10 * PRICE_OPEN)).min(4e9) as u32;
        self.search.begin(start, |_| 0);
        while let Some((cell, cost)) = self.search.visit().filter(|(_, cost)| *cost <= cost_max) {
            self.expand(grid, start, (cell, cost), &is_open, |_| 0);
        }
    }

    /// Length in metres of the path found to a cell by the last [`Self::flood`] (crowded pieces count two and
    /// a half times); `None` if it was not reached.
    pub fn metres_to(&self, grid: &NavigationGrid, number: usize) -> Option<f64> {
        let cost = self.search.cost(number)?;
        Some(f64::from(cost) / f64::from(10 * PRICE_OPEN) * grid.cells.side_m())
    }

    fn expand(
        &mut self,
        grid: &NavigationGrid,
        start: usize,
        (cell, cost): (usize, u32),
        is_open: &impl Fn(usize) -> bool,
        estimate: impl Fn(usize) -> u32,
    ) {
        let inside = is_open(cell);
        let price = |next| if grid.is_crowded(next) { PRICE_CROWDED } else { PRICE_OPEN };
        let mut reach = |next, cost| self.search.reach(next, cell, cost, &estimate);
        if inside {
            for (next, tenths) in grid.cells.steps(cell, is_open) {
                reach(next, cost + tenths * price(next));
            }
            return;
        }
        // Out of a closed cell corners do not matter.
        for (next, tenths) in grid.cells.around(cell) {
            if is_open(next) {
                reach(next, cost + tenths * price(next));
            } else if may_escape(grid, start, next) {
                reach(next, cost + tenths * PRICE_ESCAPE);
            }
        }
    }
}

/// Whether a path out of a closed start may lead over this closed cell.
fn may_escape(grid: &NavigationGrid, start: usize, cell: usize) -> bool {
    let (a, b) = (grid.cells.place(start), grid.cells.place(cell));
    grid.cell_state(cell) != CellState::Occupied && (0..3).all(|i| a[i].abs_diff(b[i]) <= ESCAPE_CELLS)
}

/// Leaves out cells of a path where a straight line between others is as good.
fn straighten(
    grid: &NavigationGrid,
    query: &RouteQuery,
    cells: &[usize],
    is_open: impl Fn(usize) -> bool,
) -> Vec<[f64; 3]> {
    let mut points: Vec<[f64; 3]> = cells.iter().map(|cell| grid.cells.centre(*cell)).collect();
    points[0] = query.from;
    // A path within one cell has two points, too.
    points.resize(points.len().max(2), query.to);
    let last = points.len() - 1;
    points[last] = query.to;
    let fits = |from: usize, to: usize| {
        let crowded = cells[from..=to].iter().any(|cell| grid.is_crowded(*cell));
        let fits = |cell: usize| is_open(cell) && (crowded || !grid.is_crowded(cell));
        grid.cells.line_fits(points[from], points[to], fits)
    };
    straightened(points.len(), LINE_CELLS_MAX, fits).into_iter().map(|i| points[i]).collect()
}
