//! Boxes of cubic cells in space, numbered: what planners divide space into.

use flockmap_grid::{Resolution, VoxelBox};

/// A box of cells, numbered with x fastest.
///
/// The indices of a cell count from an origin at which cells have a corner; its place counts from the lowest cell
/// of the box.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Lattice {
    size: [usize; 3],
    low: [i32; 3],
    origin_m: [f64; 3],
    side_m: f64,
}

/// Length of a step to a cell that differs in so many axes, in tenths of a side.
const TENTHS: [u32; 4] = [0, 10, 14, 17];

impl Lattice {
    /// So many cells of 1 m along x, y and z from 0 on.
    pub const fn new(size: [usize; 3]) -> Self {
        Self { size, low: [0; 3], origin_m: [0.0; 3], side_m: 1.0 }
    }

    /// The same number of cells with this side, counted from this origin, of which `low` has the lowest indices.
    #[must_use]
    pub const fn placed(self, origin_m: [f64; 3], low: [i32; 3], side_m: f64) -> Self {
        Self { low, origin_m, side_m, ..self }
    }

    /// The voxels of a box: their indices and places are those in their grid.
    pub fn of_voxels(region: &VoxelBox, resolution: Resolution) -> Self {
        let low = region.min();
        let size = region.size().map(|cells| cells as usize);
        Self::new(size).placed([0.0; 3], [low.x, low.y, low.z], resolution.metres())
    }

    /// Cells along x, y and z.
    pub const fn size(&self) -> [usize; 3] {
        self.size
    }

    /// Number of all cells.
    pub const fn count(&self) -> usize {
        self.size[0] * self.size[1] * self.size[2]
    }

    /// The indices of the lowest and of the highest cell.
    pub fn ends(&self) -> [[i32; 3]; 2] {
        [self.low, core::array::from_fn(|a| self.low[a] + (self.size[a] as i32 - 1))]
    }

    /// Side of a cell in metres.
    pub const fn side_m(&self) -> f64 {
        self.side_m
    }

    /// The number of the cell at this place, which must lie in the box.
    pub const fn number(&self, place: [usize; 3]) -> usize {
        (place[2] * self.size[1] + place[1]) * self.size[0] + place[0]
    }

    /// The place of a cell.
    pub const fn place(&self, number: usize) -> [usize; 3] {
        let [nx, ny, _] = self.size;
        [number % nx, number / nx % ny, number / nx / ny]
    }

    /// The indices of a cell.
    pub fn index(&self, number: usize) -> [i32; 3] {
        let place = self.place(number);
        core::array::from_fn(|a| self.low[a] + place[a] as i32)
    }

    /// The number of the cell with these indices; `None` outside of the box.
    #[inline]
    pub fn number_of(&self, index: [i32; 3]) -> Option<usize> {
        let mut place = [0; 3];
        for a in 0..3 {
            place[a] = usize::try_from(i64::from(index[a]) - i64::from(self.low[a])).ok()?;
            if place[a] >= self.size[a] {
                return None;
            }
        }
        Some(self.number(place))
    }

    /// The indices of the cell at a point in metres, in the box or not.
    pub fn index_at(&self, point: [f64; 3]) -> [i32; 3] {
        core::array::from_fn(|a| ((point[a] - self.origin_m[a]) / self.side_m).floor() as i32)
    }

    /// The number of the cell at a point in metres; `None` outside of the box.
    pub fn cell_at(&self, point: [f64; 3]) -> Option<usize> {
        let is_number = point.iter().all(|v| !v.is_nan());
        self.number_of(self.index_at(point)).filter(|_| is_number)
    }

    /// The centre of a cell in metres.
    pub fn centre(&self, number: usize) -> [f64; 3] {
        let place = self.place(number);
        core::array::from_fn(|a| {
            self.origin_m[a] + (f64::from(self.low[a]) + place[a] as f64 + 0.5) * self.side_m
        })
    }

    /// The middle of the centres of these cells.
    pub fn middle(&self, cells: &[u32]) -> [f64; 3] {
        let mut sum = [0.0; 3];
        for &cell in cells {
            let centre = self.centre(cell as usize);
            for a in 0..3 {
                sum[a] += centre[a];
            }
        }
        sum.map(|v| v / cells.len().max(1) as f64)
    }

    /// The cells whose centre may be within so many metres of a point, and some more.
    pub fn near(&self, point: [f64; 3], reach_m: f64) -> impl Iterator<Item = usize> + use<> {
        let (lattice, [first, last]) = (*self, self.ends());
        let [low, high] = [-reach_m, reach_m].map(|reach| self.index_at(point.map(|v| v + reach)));
        let span = move |a: usize| low[a].max(first[a])..=high[a].min(last[a]);
        span(2).flat_map(move |z| {
            span(1).flat_map(move |y| span(0).filter_map(move |x| lattice.number_of([x, y, z])))
        })
    }

    /// The cells that share a face with a cell.
    pub fn beside(&self, number: usize) -> impl Iterator<Item = usize> + use<> {
        let [nx, ny, nz] = self.size;
        let [x, y, z] = self.place(number);
        [
            (x > 0, number.wrapping_sub(1)),
            (x + 1 < nx, number + 1),
            (y > 0, number.wrapping_sub(nx)),
            (y + 1 < ny, number + nx),
            (z > 0, number.wrapping_sub(nx * ny)),
            (z + 1 < nz, number + nx * ny),
        ]
        .into_iter()
        .filter_map(|(inside, next)| inside.then_some(next))
    }

    /// The cells around a cell (up to 26), each with the length of the step there in tenths of a side.
    pub fn around(&self, number: usize) -> impl Iterator<Item = (usize, u32)> + use<> {
        let (at, lattice) = (self.place(number), *self);
        (0..27usize).filter(|k| *k != 13).filter_map(move |k| {
            let delta = [k % 3, k / 3 % 3, k / 9];
            let mut next = [0; 3];
            for a in 0..3 {
                next[a] = (at[a] + delta[a]).checked_sub(1).filter(|v| *v < lattice.size[a])?;
            }
            let axes = delta.iter().filter(|d| **d != 1).count();
            Some((lattice.number(next), TENTHS[axes]))
        })
    }

    /// The open cells around a cell to which a straight step cuts no corner of a cell that is not open: all
    /// cells of the box between the two are open.
    pub fn steps(&self, cell: usize, is_open: impl Fn(usize) -> bool) -> impl Iterator<Item = (usize, u32)> {
        let (lattice, a) = (*self, self.place(cell));
        self.around(cell).filter(move |&(next, tenths)| {
            let cuts_no_corner = || {
                let b = lattice.place(next);
                (1..7).all(|mask| {
                    let between = core::array::from_fn(|i| if mask >> i & 1 == 0 { a[i] } else { b[i] });
                    between == a || between == b || is_open(lattice.number(between))
                })
            };
            is_open(next) && (tenths == TENTHS[1] || cuts_no_corner())
        })
    }

    /// Whether every cell that the line between two points in metres touches lies in the box and `fits`;
    /// asked for one after the other.
    pub fn line_fits(&self, a: [f64; 3], b: [f64; 3], mut fits: impl FnMut(usize) -> bool) -> bool {
        let (Some(from), Some(to)) = (self.cell_at(a), self.cell_at(b)) else { return false };
        let (mut at, goal) = (self.place(from), self.place(to));
        // Share of the line at which it crosses the next face along an axis; nothing is left to cross once
        // the place is the goal's.
        let crossing = |axis: usize, at: [usize; 3]| {
            let face = at[axis] + usize::from(goal[axis] > at[axis]);
            if goal[axis] == at[axis] {
                f64::INFINITY
            } else {
                let face_m = self.origin_m[axis] + (f64::from(self.low[axis]) + face as f64) * self.side_m;
                (face_m - a[axis]) / (b[axis] - a[axis])
            }
        };
        let mut next: [f64; 3] = core::array::from_fn(|axis| crossing(axis, at));
        loop {
            if !fits(self.number(at)) {
                return false;
            }
            let flat = usize::from(next[1] < next[0]);
            let axis = if next[2] < next[flat] { 2 } else { flat };
            if next[axis] == f64::INFINITY {
                return true;
            }
            at[axis] = if goal[axis] > at[axis] { at[axis] + 1 } else { at[axis] - 1 };
            next[axis] = crossing(axis, at);
        }
    }

    /// The largest set of open cells that hang together by faces, ascending; of two of a size the one with the
    /// lowest cell.
    pub fn largest_part(&self, mut open: Vec<bool>) -> Vec<u32> {
        let mut best = Vec::new();
        for first in 0..self.count() {
            if core::mem::take(&mut open[first]) {
                let enter = |_, next: usize| core::mem::take(&mut open[next]);
                let part = flood(vec![first as u32], |cell| self.beside(cell), enter);
                if part.len() > best.len() {
                    best = part;
                }
            }
        }
        best.sort_unstable();
        best
    }

    /// The distance of each cell to the nearest of some, for a distance that can be found axis by axis.
    /// `values` holds 0 for these cells and the highest value for others; `step` is the distance of so many
    /// cells along one axis, and `join` makes one distance of those along two axes.
    pub fn spread<T: Copy + Ord>(
        &self,
        values: &mut [T],
        step: impl Fn(usize) -> T,
        join: impl Fn(T, T) -> T,
    ) {
        let [nx, ny, nz] = self.size;
        let mut line = Vec::new();
        for (length, stride) in [(nx, 1), (ny, nx), (nz, nx * ny)] {
            for start in (0..values.len()).filter(|number| number / stride % length == 0) {
                line.clear();
                line.extend((0..length).map(|i| values[start + i * stride]));
                if line.iter().all(|value| *value == line[0]) {
                    continue;
                }
                for i in 0..length {
                    let mut best = line[i];
                    for d in 1..length {
                        // Nothing that is as far or farther along this axis alone can be nearer.
                        let along = step(d);
                        if along >= best {
                            break;
                        }
                        if i >= d {
                            best = best.min(join(line[i - d], along));
                        }
                        if i + d < length {
                            best = best.min(join(line[i + d], along));
                        }
                    }
                    values[start + i * stride] = best;
                }
            }
        }
    }
}

/// Straight from one point to the other.
pub(crate) fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|i| (a[i] - b[i]) * (a[i] - b[i])).sum::<f64>().sqrt()
}

/// Length of the shortest path between two cells by their indices, with diagonals, in tenths of a side (a
/// diagonal across two axes counts 14, across three 17).
pub fn tenths_between(a: [i32; 3], b: [i32; 3]) -> u32 {
    let mut d: [u32; 3] = core::array::from_fn(|i| a[i].abs_diff(b[i]));
    d.sort_unstable();
    17 * d[0] + 14 * (d[1] - d[0]) + 10 * (d[2] - d[1])
}

/// The cells that can be reached from the first ones, in the order in which they are: nearest first. `beside`
/// names the next cells of a cell; `enter(from, next)` says whether one is to be entered, once and for all.
pub fn flood<I: Iterator<Item = usize>>(
    mut cells: Vec<u32>,
    beside: impl Fn(usize) -> I,
    mut enter: impl FnMut(usize, usize) -> bool,
) -> Vec<u32> {
    let mut done = 0;
    while let Some(&cell) = cells.get(done) {
        cells
            .extend(beside(cell as usize).filter(|next| enter(cell as usize, *next)).map(|next| next as u32));
        done += 1;
    }
    cells
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SIZE: [usize; 3] = [7, 5, 4];

    fn cell() -> impl Strategy<Value = usize> {
        0..Lattice::new(SIZE).count()
    }

    proptest! {
        #[test]
        fn neighbours_are_the_cells_one_step_away(cell in cell()) {
            let lattice = Lattice::new(SIZE);
            let at = lattice.place(cell);
            prop_assert_eq!(lattice.number(at), cell);
            let steps = |other: usize| {
                let d: [usize; 3] = core::array::from_fn(|a| at[a].abs_diff(lattice.place(other)[a]));
                (d.iter().all(|d| *d <= 1), d.iter().filter(|d| **d != 0).count())
            };
            let near: Vec<(usize, u32)> = (0..lattice.count())
                .filter(|other| *other != cell && steps(*other).0)
                .map(|other| (other, TENTHS[steps(other).1]))
                .collect();
            prop_assert_eq!(lattice.around(cell).collect::<Vec<_>>(), &near[..]);
            let mut beside: Vec<usize> = lattice.beside(cell).collect();
            beside.sort_unstable();
            let faces: Vec<usize> = near.iter().filter(|n| n.1 == 10).map(|n| n.0).collect();
            prop_assert_eq!(beside, faces);
        }

        #[test]
        fn a_line_goes_by_faces_from_its_first_cell_to_its_last(
            a in prop::array::uniform3(0.0..1.0f64), b in prop::array::uniform3(0.0..1.0f64),
        ) {
            let lattice = Lattice::new(SIZE);
            let point = |p: [f64; 3]| -> [f64; 3] { core::array::from_fn(|i| p[i] * SIZE[i] as f64) };
            let (a, b) = (point(a), point(b));
            let [from, to] = [a, b].map(|point| lattice.cell_at(point).unwrap());
            let mut cells = Vec::new();
            let all = lattice.line_fits(a, b, |cell| {
                cells.push(cell);
                true
            });
            prop_assert!(all);
            prop_assert_eq!((cells[0], cells[cells.len() - 1]), (from, to));
            prop_assert!(cells.windows(2).all(|w| lattice.beside(w[0]).any(|next| next == w[1])));
            let steps: usize = (0..3).map(|i| lattice.place(from)[i].abs_diff(lattice.place(to)[i])).sum();
            prop_assert_eq!(cells.len(), steps + 1);
            prop_assert!(!lattice.line_fits(a, b, |cell| cell != to));
        }
    }

    #[test]
    fn points_outside_have_no_cell() {
        let lattice = Lattice::new(SIZE);
        assert_eq!(lattice.cell_at([6.9, 4.9, 3.9]), Some(lattice.count() - 1));
        for outside in [[-0.1, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0, 0.0, f64::NAN]] {
            assert_eq!(lattice.cell_at(outside), None);
        }
    }
}
