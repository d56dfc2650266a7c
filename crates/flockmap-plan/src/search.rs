//! Paths of least cost over numbered cells.

use core::cmp::Reverse;
use std::collections::BinaryHeap;

/// Which cell comes first of those over which whole paths are estimated to cost the same.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Ties {
    /// The one that is reached at the least cost; of those the one with the lowest number.
    Cost,
    /// The one with the lowest number.
    Number,
}

/// A search for paths of least cost from one cell: A*, or Dijkstra's where all estimates are 0. Its user says
/// which cells are beside a cell and what they cost:
///
/// ```
/// use flockmap_plan::search::{Search, Ties};
///
/// // From 3 to 0 on a line of cells, of which each costs its number.
/// let mut search = Search::new(5, Ties::Cost);
/// search.begin(3, |_| 0);
/// while let Some((cell, cost)) = search.visit() {
///     for next in [cell.wrapping_sub(1), cell + 1].into_iter().filter(|next| *next < 5) {
///         search.reach(next, cell, cost + next as u32, |_| 0);
///     }
/// }
/// assert_eq!((search.cost(0), search.path_to(0)), (Some(3), vec![3, 2, 1, 0]));
/// ```
///
/// The same costs give the same paths on every machine, in whatever order the cells beside a cell are
/// reached. 12 bytes a cell, which are used again by the next search.
#[derive(Clone, Debug)]
pub struct Search {
    ties: Ties,
    round: u32,
    /// For each cell the round that reached it, the cost then, and where from.
    reached: Vec<(u32, u32, u32)>,
    /// Estimate of the whole path, what decides ties, cell, cost so far.
    queue: BinaryHeap<Reverse<(u32, u32, u32, u32)>>,
}

impl Search {
    /// For so many cells.
    pub fn new(cells: usize, ties: Ties) -> Self {
        Self { ties, round: 0, reached: vec![(0, 0, 0); cells], queue: BinaryHeap::new() }
    }

    /// Forgets the last search.
    pub fn clear(&mut self) {
        if self.round == u32::MAX {
            self.round = 0;
            self.reached.fill((0, 0, 0));
        }
        self.round += 1;
        self.queue.clear();
    }

    /// Begins a new search from this cell. `estimate` is never more than what the path from a cell to the
    /// goal costs.
    pub fn begin(&mut self, start: usize, estimate: impl Fn(usize) -> u32) {
        self.clear();
        self.reach(start, start, 0, estimate);
    }

    /// The next cell to go on from, and the cost of the path there. `None`: all was visited.
    pub fn visit(&mut self) -> Option<(usize, u32)> {
        while let Some(Reverse((_, _, cell, cost))) = self.queue.pop() {
            if cost == self.reached[cell as usize].1 {
                return Some((cell as usize, cost));
            }
        }
        None
    }

    /// Takes note of a path to a cell, by way of `from`, if it is the cheapest so far.
    pub fn reach(&mut self, cell: usize, from: usize, cost: u32, estimate: impl Fn(usize) -> u32) {
        if self.cost(cell).is_none_or(|old| cost < old) {
            self.reached[cell] = (self.round, cost, from as u32);
            let tie = if self.ties == Ties::Cost { cost } else { 0 };
            self.queue.push(Reverse((cost + estimate(cell), tie, cell as u32, cost)));
        }
    }

    /// What the path to a cell costs as far as it was searched; `None` if the cell was not reached.
    pub fn cost(&self, cell: usize) -> Option<u32> {
        let (round, cost, _) = self.reached[cell];
        (round == self.round).then_some(cost)
    }

    /// The cells of the path to a cell that was reached, the start first.
    pub fn path_to(&self, mut cell: usize) -> Vec<usize> {
        let mut path = vec![cell];
        while self.reached[cell].2 as usize != cell {
            cell = self.reached[cell].2 as usize;
            path.push(cell);
        }
        path.reverse();
        path
    }
}

/// The points of a path that remain where straight lines stand for stretches of it, by their numbers: from
/// each the last of the next `reach` points to which a line `fits`, or the next one.
pub fn straightened(points: usize, reach: usize, fits: impl Fn(usize, usize) -> bool) -> Vec<usize> {
    let mut kept = vec![0];
    let mut from = 0;
    while from + 1 < points {
        let farthest = (from + reach).min(points - 1);
        from = (from + 2..=farthest).rev().find(|to| fits(from, *to)).unwrap_or(from + 1);
        kept.push(from);
    }
    kept
}
