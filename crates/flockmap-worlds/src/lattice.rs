//! Cells of a box in a row: what grids for finding ways share. Knows indices, and of metres only what it is told.

/// A box of cells, numbered with x fastest. Indices count from its lowest corner.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Lattice {
    size: [usize; 3],
}

impl Lattice {
    /// So many cells along x, y and z.
    pub const fn new(size: [usize; 3]) -> Self {
        Self { size }
    }

    /// Cells along x, y and z.
    pub const fn size(&self) -> [usize; 3] {
        self.size
    }

    /// Number of all cells.
    pub const fn count(&self) -> usize {
        self.size[0] * self.size[1] * self.size[2]
    }

    /// The number of the cell at these indices, which must lie in the box.
    pub const fn number(&self, at: [usize; 3]) -> usize {
        (at[2] * self.size[1] + at[1]) * self.size[0] + at[0]
    }

    /// The indices of a cell.
    pub const fn place(&self, number: usize) -> [usize; 3] {
        let [nx, ny, _] = self.size;
        [number % nx, number / nx % ny, number / nx / ny]
    }

    /// The number of the cell at these indices, rounded down; `None` outside of the box.
    pub fn number_at(&self, index: [f64; 3]) -> Option<usize> {
        let mut at = [0; 3];
        for a in 0..3 {
            let index = index[a].floor();
            if !(index >= 0.0 && index < self.size[a] as f64) {
                return None;
            }
            at[a] = index as usize;
        }
        Some(self.number(at))
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

    /// The cells around a cell (up to 26), each with how many axes it differs in.
    pub fn around(&self, number: usize) -> impl Iterator<Item = (usize, usize)> + use<> {
        let (at, lattice) = (self.place(number), *self);
        (0..27usize).filter(|k| *k != 13).filter_map(move |k| {
            let delta = [k % 3, k / 3 % 3, k / 9];
            let mut next = [0; 3];
            for a in 0..3 {
                next[a] = (at[a] + delta[a]).checked_sub(1).filter(|v| *v < lattice.size[a])?;
            }
            let axes = delta.iter().filter(|d| **d != 1).count();
            Some((lattice.number(next), axes))
        })
    }

    /// Whether all cells of the box between two diagonal neighbours, these two left out, are open: a way that
    /// goes from one to the other then cuts no corner.
    pub fn corners_are_open(&self, cell: usize, next: usize, is_open: impl Fn(usize) -> bool) -> bool {
        let (a, b) = (self.place(cell), self.place(next));
        (1..7).all(|mask| {
            let between = core::array::from_fn(|i| if mask >> i & 1 == 0 { a[i] } else { b[i] });
            is_open(self.number(between))
        })
    }

    /// Length of the shortest way from cell to cell with diagonals, in tenths of a side (a diagonal across
    /// two axes counts 14, across three 17).
    pub fn tenths_between(&self, cell: usize, goal: usize) -> u32 {
        let (a, b) = (self.place(cell), self.place(goal));
        let mut d: [usize; 3] = core::array::from_fn(|i| a[i].abs_diff(b[i]));
        d.sort_unstable();
        (17 * d[0] + 14 * (d[1] - d[0]) + 10 * (d[2] - d[1])) as u32
    }

    /// Whether every cell that the line between two points touches `fits`; asked for one after the other. The
    /// points lie in the cells `from` and `to`; `face_m` tells where the lower face of an index is along an axis.
    pub fn line_fits(
        &self,
        (a, from): ([f64; 3], usize),
        (b, to): ([f64; 3], usize),
        face_m: impl Fn(usize, usize) -> f64,
        mut fits: impl FnMut(usize) -> bool,
    ) -> bool {
        let (mut at, goal) = (self.place(from), self.place(to));
        // Share of the line at which it crosses the next face along an axis; nothing is left to cross once
        // the index is the goal's.
        let crossing = |axis: usize, at: [usize; 3]| {
            let face = at[axis] + usize::from(goal[axis] > at[axis]);
            if goal[axis] == at[axis] {
                f64::INFINITY
            } else {
                (face_m(axis, face) - a[axis]) / (b[axis] - a[axis])
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
            let near: Vec<(usize, usize)> = (0..lattice.count())
                .filter(|other| *other != cell && steps(*other).0)
                .map(|other| (other, steps(other).1))
                .collect();
            prop_assert_eq!(lattice.around(cell).collect::<Vec<_>>(), &near[..]);
            let mut beside: Vec<usize> = lattice.beside(cell).collect();
            beside.sort_unstable();
            let faces: Vec<usize> = near.iter().filter(|n| n.1 == 1).map(|n| n.0).collect();
            prop_assert_eq!(beside, faces);
        }

        #[test]
        fn a_line_goes_by_faces_from_its_first_cell_to_its_last(
            a in prop::array::uniform3(0.0..1.0f64), b in prop::array::uniform3(0.0..1.0f64),
        ) {
            let lattice = Lattice::new(SIZE);
            let point = |p: [f64; 3]| -> [f64; 3] { core::array::from_fn(|i| p[i] * SIZE[i] as f64) };
            let (a, b) = (point(a), point(b));
            let (Some(from), Some(to)) = (lattice.number_at(a), lattice.number_at(b)) else {
                unreachable!()
            };
            let mut cells = Vec::new();
            let all = lattice.line_fits((a, from), (b, to), |_, face| face as f64, |cell| {
                cells.push(cell);
                true
            });
            prop_assert!(all);
            prop_assert_eq!((cells[0], cells[cells.len() - 1]), (from, to));
            prop_assert!(cells.windows(2).all(|w| lattice.beside(w[0]).any(|next| next == w[1])));
            let steps: usize = (0..3).map(|i| lattice.place(from)[i].abs_diff(lattice.place(to)[i])).sum();
            prop_assert_eq!(cells.len(), steps + 1);
            prop_assert!(!lattice.line_fits((a, from), (b, to), |_, face| face as f64, |cell| cell != to));
        }
    }

    #[test]
    fn points_outside_have_no_cell() {
        let lattice = Lattice::new(SIZE);
        assert_eq!(lattice.number_at([6.9, 4.9, 3.9]), Some(lattice.count() - 1));
        for outside in [[-0.1, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0, 0.0, f64::NAN]] {
            assert_eq!(lattice.number_at(outside), None);
        }
    }
}
