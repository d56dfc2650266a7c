//! Where one can fly: a coarse grid with the distance of each cell to anything solid.

use super::{TrajectoryError, TrajectoryOptions};
use crate::World;
use crate::lattice::Lattice;
use flockmap_grid::{Voxel, VoxelBox};

/// Cells of the coarse grid for which a step of about 10 cm is taken; larger worlds are searched in larger
/// steps.
const CELLS_WANTED: i64 = 5_000_000;

/// Clearances are told apart up to this many cells.
const REACH: usize = 16;

/// Not to be flown in.
pub(super) const BLOCKED: u16 = 0;

/// The free space in which robots fly: the largest connected set of cells that keep the clearance.
pub(super) struct Space {
    lattice: Lattice,
    /// Metres of the lowest corner of the grid.
    corner_m: [f64; 3],
    step_m: f64,
    clearance_m: f64,
    /// For each cell of the space the square of the least distance from any point in it to anything solid, in
    /// cells, at least 1; [`BLOCKED`] elsewhere.
    open: Vec<u16>,
    /// The cells of the space, ascending.
    cells: Vec<u32>,
}

impl Space {
    pub(super) fn new(world: &World, options: &TrajectoryOptions) -> Result<Self, TrajectoryError> {
        let side = world.resolution().metres();
        let bounds = world.bounds();
        let extent = bounds.size().map(|n| f64::from(n) * side);
        let cells_at = |m: u32| -> i64 {
            bounds.size().iter().map(|&n| i64::from(n.div_ceil(m))).fold(1, i64::saturating_mul)
        };
        let mut multiple = ((0.1 / side).round() as u32).max(1);
        while cells_at(multiple) > CELLS_WANTED {
            multiple += 1;
        }
        let step_m = f64::from(multiple) * side;
        let low = bounds.min();
        let size = bounds.size().map(|n| n.div_ceil(multiple) as usize);
        let corner_m = [low.x, low.y, low.z].map(|v| f64::from(v) * side);
        let lattice = Lattice::new(size);
        let mut grid =
            Self { lattice, corner_m, step_m, clearance_m: 0.0, open: Vec::new(), cells: Vec::new() };

        let count = lattice.count();
        let mut solid = vec![false; count];
        for cell in world.solid_cells() {
            let at = [cell.x - low.x, cell.y - low.y, cell.z - low.z].map(|v| v as usize / multiple as usize);
            solid[lattice.number(at)] = true;
        }
        let ground = grid.ground(&solid);
        let distance = grid.distances(&solid, REACH);
        drop(solid);
        let known_free = |at: [usize; 3]| {
            let [x, y, z] = at.map(|v| v as i32 * multiple as i32);
            let cells = VoxelBox::new(Voxel::new(low.x + x, low.y + y, low.z + z), [multiple; 3]);
            cells.is_none_or(|mut cells| {
                // Unknown cells at the far edge of the world do not count against the rest of theirs.
                if let Some(inside) = cells.intersection(&bounds) {
                    cells = inside;
                }
                cells.voxels().all(|cell| world.is_known_free(cell).unwrap_or(true))
            })
        };

        // Heights as asked for, then with more freedom, since a ground is not always seen.
        let [floor, top] = options.height_m;
        let bands = [[floor, top], [floor / 2.0, top + 1.0], [0.0, f64::MAX]];
        for band in bands {
            let mut candidates = Vec::new();
            for (number, &away) in distance.iter().enumerate() {
                let at = lattice.place(number);
                let above = (at[2] as f64 + 0.5) * step_m - ground[at[1] * size[0] + at[0]];
                if band[0] <= above && above <= band[1] && away > BLOCKED && known_free(at) {
                    candidates.push(number as u32);
                }
            }
            if let Some((clearance_m, cells)) = grid.widest(&candidates, &distance, options) {
                grid.clearance_m = clearance_m;
                grid.open = vec![BLOCKED; count];
                for &cell in &cells {
                    grid.open[cell as usize] = distance[cell as usize];
                }
                grid.cells = cells;
                return Ok(grid);
            }
        }
        Err(TrajectoryError::NoSpace {
            size_m: extent,
            step_m,
            clearance_m: options.clearance_min_m,
            heights: bands.to_vec(),
        })
    }

    /// Metres from any point of the space to anything solid, at least.
    pub(super) const fn clearance_m(&self) -> f64 {
        self.clearance_m
    }

    pub(super) const fn step_m(&self) -> f64 {
        self.step_m
    }

    /// The cells of the space, ascending.
    pub(super) fn cells(&self) -> &[u32] {
        &self.cells
    }

    /// Square of the distance of a cell to anything solid, in cells; [`BLOCKED`] outside of the space.
    pub(super) fn openness(&self, number: usize) -> u16 {
        self.open[number]
    }

    /// Number of all cells of the grid.
    pub(super) const fn count(&self) -> usize {
        self.open.len()
    }

    /// The cells without what is in them.
    pub(super) const fn lattice(&self) -> &Lattice {
        &self.lattice
    }

    /// The centre of a cell in metres.
    pub(super) fn centre(&self, number: usize) -> [f64; 3] {
        let at = self.lattice.place(number);
        core::array::from_fn(|a| self.corner_m[a] + (at[a] as f64 + 0.5) * self.step_m)
    }

    /// The cell at a point in metres, if it lies in the grid.
    pub(super) fn cell_at(&self, point: [f64; 3]) -> Option<usize> {
        self.lattice.number_at(core::array::from_fn(|a| (point[a] - self.corner_m[a]) / self.step_m))
    }

    /// Whether every cell that the line from `a` to `b` touches is in the grid and `fits`.
    pub(super) fn line_fits(&self, a: [f64; 3], b: [f64; 3], fits: impl Fn(usize) -> bool) -> bool {
        let (Some(from), Some(to)) = (self.cell_at(a), self.cell_at(b)) else { return false };
        let face_m = |axis: usize, face: usize| self.corner_m[axis] + face as f64 * self.step_m;
        self.lattice.line_fits((a, from), (b, to), face_m, fits)
    }

    /// Area over which the cells lie, in m².
    pub(super) fn area_m2(&self, cells: &[u32]) -> f64 {
        let mut columns = vec![false; self.lattice.size()[0] * self.lattice.size()[1]];
        for &cell in cells {
            columns[cell as usize % (self.lattice.size()[0] * self.lattice.size()[1])] = true;
        }
        columns.iter().filter(|c| **c).count() as f64 * self.step_m * self.step_m
    }

    /// Height of the ground in each column, in metres above the grid: the lowest thing within 1 m. Where
    /// nothing is seen at all, the ground of the nearest column that has one.
    fn ground(&self, solid: &[bool]) -> Vec<f64> {
        let [nx, ny, nz] = self.lattice.size();
        let none = u32::MAX;
        let mut lowest = vec![none; nx * ny];
        for z in (0..nz).rev() {
            for column in 0..nx * ny {
                if solid[z * nx * ny + column] {
                    lowest[column] = z as u32;
                }
            }
        }
        let reach = (1.0 / self.step_m).ceil() as usize;
        let along_x = window_min(&lowest, nx, ny, 1, nx, reach);
        let mut ground = window_min(&along_x, ny, nx, nx, 1, reach);
        // Columns without a ground take it from their neighbours, ring by ring.
        let mut front: Vec<usize> = (0..nx * ny).filter(|c| ground[*c] != none).collect();
        while !front.is_empty() {
            let mut next = Vec::new();
            for column in front {
                let (x, y) = (column % nx, column / nx);
                let around = [
                    (x > 0).then(|| column - 1),
                    (x + 1 < nx).then_some(column + 1),
                    (y > 0).then(|| column - nx),
                    (y + 1 < ny).then_some(column + nx),
                ];
                for other in around.into_iter().flatten() {
                    if ground[other] == none {
                        ground[other] = ground[column];
                        next.push(other);
                    }
                }
            }
            front = next;
        }
        ground.iter().map(|z| f64::from(*z) * self.step_m).collect()
    }

    /// For each cell the square of the least distance between any point of it and any point of the marked
    /// cells, in cells, so 0 for the marked and their neighbours; exact up to `reach` (at most 255), and
    /// `reach`² beyond.
    pub(super) fn distances(&self, marked: &[bool], reach: usize) -> Vec<u16> {
        let far = (reach * reach) as u16;
        let [nx, ny, nz] = self.lattice.size();
        let mut squares: Vec<u16> = marked.iter().map(|s| if *s { 0 } else { far }).collect();
        for (length, stride) in [(nx, 1), (ny, nx), (nz, nx * ny)] {
            let mut line = vec![0u16; length];
            for start in (0..squares.len()).filter(|number| number / stride % length == 0) {
                for (i, slot) in line.iter_mut().enumerate() {
                    *slot = squares[start + i * stride];
                }
                if line.iter().all(|square| *square == far) {
                    continue;
                }
                for i in 0..length {
                    let mut best = line[i];
                    for d in 1..=reach {
                        // Faces are one cell nearer than centres.
                        let gap = ((d - 1) * (d - 1)) as u16;
                        if gap >= best {
                            break;
                        }
                        if i >= d {
                            best = best.min(line[i - d].saturating_add(gap));
                        }
                        if i + d < length {
                            best = best.min(line[i + d].saturating_add(gap));
                        }
                    }
                    squares[start + i * stride] = best;
                }
            }
        }
        squares
    }

    /// The largest connected set at the largest clearance that does not cost more than a fifth of the area.
    fn widest(
        &self,
        candidates: &[u32],
        distance: &[u16],
        options: &TrajectoryOptions,
    ) -> Option<(f64, Vec<u32>)> {
        let (most, least) = (options.clearance_m, options.clearance_min_m);
        let tries = [least, least + (most - least) / 3.0, least + (most - least) * 2.0 / 3.0, most];
        let mut found: Option<(f64, Vec<u32>)> = None;
        let mut area_wanted = 0.0;
        for (number, clearance) in tries.into_iter().enumerate() {
            let cells = self.largest_component(candidates, |cell| {
                f64::from(distance[cell]).sqrt() * self.step_m >= clearance - 1e-9
            });
            let area = self.area_m2(&cells);
            if number == 0 {
                // Less than one square metre is no place to fly.
                if area < 1.0 {
                    return None;
                }
                area_wanted = 0.8 * area;
            }
            if area >= area_wanted {
                found = Some((clearance, cells));
            }
        }
        found
    }

    /// The largest set of candidates that hang together by faces, ascending; of two of a size the one with
    /// the lowest cell.
    pub(super) fn largest_component(&self, candidates: &[u32], fits: impl Fn(usize) -> bool) -> Vec<u32> {
        let count = self.lattice.size().iter().product();
        let mut open = vec![false; count];
        for &cell in candidates {
            open[cell as usize] = fits(cell as usize);
        }
        let mut best = Vec::new();
        for &first in candidates {
            if open[first as usize] {
                open[first as usize] = false;
                let mut component = vec![first];
                let mut done = 0;
                while done < component.len() {
                    for next in self.lattice.beside(component[done] as usize) {
                        if open[next] {
                            open[next] = false;
                            component.push(next as u32);
                        }
                    }
                    done += 1;
                }
                if component.len() > best.len() {
                    best = component;
                }
            }
        }
        best.sort_unstable();
        best
    }
}

/// The least value within `reach` places along one axis of a two-dimensional array.
fn window_min(
    values: &[u32],
    length: usize,
    lines: usize,
    stride: usize,
    line_stride: usize,
    reach: usize,
) -> Vec<u32> {
    let mut result = values.to_vec();
    for line in 0..lines {
        for i in 0..length {
            let window = i.saturating_sub(reach)..=(i + reach).min(length - 1);
            let least = window.map(|j| values[line * line_stride + j * stride]).min();
            result[line * line_stride + i * stride] = least.unwrap_or(u32::MAX);
        }
    }
    result
}
