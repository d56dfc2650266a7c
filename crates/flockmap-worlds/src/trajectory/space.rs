//! Where one can fly: a coarse grid with the distance of each cell to anything solid.

use super::{TrajectoryError, TrajectoryOptions};
use crate::World;
use flockmap_grid::{Voxel, VoxelBox};
use flockmap_plan::lattice::{Lattice, flood};

/// Cells of the coarse grid for which a step of about 10 cm is taken; larger worlds are searched in larger
/// steps.
const CELLS_WANTED: i64 = 5_000_000;

/// Clearances are distinguished up to this many cells.
const REACH: usize = 16;

/// Not to be flown in.
pub(super) const BLOCKED: u16 = 0;

/// The free space in which robots fly: the largest connected set of cells that keep the clearance.
pub(super) struct Space {
    pub(super) lattice: Lattice,
    /// Metres from any point of the space to anything solid, at least.
    pub(super) clearance_m: f64,
    /// For each cell of the space the square of the least distance from any point in it to anything solid, in
    /// cells, at least 1; [`BLOCKED`] elsewhere.
    open: Vec<u16>,
    /// The cells of the space, ascending.
    pub(super) cells: Vec<u32>,
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
        let lattice = Lattice::new(size).placed(corner_m, [0; 3], step_m);
        let mut solid = vec![false; lattice.count()];
        for cell in world.solid_cells() {
            let at = [cell.x - low.x, cell.y - low.y, cell.z - low.z].map(|v| v as usize / multiple as usize);
            solid[lattice.number(at)] = true;
        }
        let ground = ground(&lattice, &solid);
        let distance = distances(&lattice, &solid, REACH);
        drop(solid);
        let known_free = |at: [usize; 3]| {
            let [x, y, z] = at.map(|v| v as i32 * multiple as i32);
            let cells = VoxelBox::new(Voxel::new(low.x + x, low.y + y, low.z + z), [multiple; 3]);
            // Unknown cells at the far edge of the world do not count against the rest of theirs.
            let inside = cells.map(|cells| cells.intersection(&bounds).unwrap_or(cells));
            inside.is_none_or(|cells| cells.voxels().all(|cell| world.is_known_free(cell).unwrap_or(true)))
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
            if let Some((clearance_m, cells)) = widest(&lattice, &candidates, &distance, options) {
                let mut open = vec![BLOCKED; lattice.count()];
                for &cell in &cells {
                    open[cell as usize] = distance[cell as usize];
                }
                return Ok(Self { lattice, clearance_m, open, cells });
            }
        }
        Err(TrajectoryError::NoSpace {
            size_m: extent,
            step_m,
            clearance_m: options.clearance_min_m,
            heights: bands.to_vec(),
        })
    }

    /// Square of the distance of a cell to anything solid, in cells; [`BLOCKED`] outside of the space.
    pub(super) fn openness(&self, number: usize) -> u16 {
        self.open[number]
    }
}

/// Area over which the cells lie, in m².
pub(super) fn area_m2(lattice: &Lattice, cells: &[u32]) -> f64 {
    let [nx, ny, _] = lattice.size();
    let mut columns = vec![false; nx * ny];
    for &cell in cells {
        columns[cell as usize % (nx * ny)] = true;
    }
    columns.iter().filter(|c| **c).count() as f64 * lattice.side_m() * lattice.side_m()
}

/// For each cell the square of the least distance between any point of it and any point of the marked cells,
/// in cells, so 0 for the marked and their neighbours; exact up to `reach` (at most 255), and `reach`²
/// beyond.
pub(super) fn distances(lattice: &Lattice, marked: &[bool], reach: usize) -> Vec<u16> {
    let far = (reach * reach) as u16;
    let mut squares: Vec<u16> = marked.iter().map(|s| if *s { 0 } else { far }).collect();
    // Faces are one cell nearer than centres.
    lattice.spread(&mut squares, |cells| ((cells - 1) * (cells - 1)) as u16, u16::saturating_add);
    squares
}

/// The largest of the sets of candidates that fit and hang together by faces, ascending.
pub(super) fn largest_part(lattice: &Lattice, candidates: &[u32], fits: impl Fn(usize) -> bool) -> Vec<u32> {
    let mut open = vec![false; lattice.count()];
    for &cell in candidates {
        open[cell as usize] = fits(cell as usize);
    }
    lattice.largest_part(open)
}

/// Height of the ground in each column, in metres above the grid: the lowest thing within 1 m. Where nothing
/// is seen at all, the ground of the nearest column that has one.
fn ground(lattice: &Lattice, solid: &[bool]) -> Vec<f64> {
    let [nx, ny, nz] = lattice.size();
    let (columns, none) = (Lattice::new([nx, ny, 1]), u32::MAX);
    let lowest = |column: usize| (0..nz).find(|z| solid[z * nx * ny + column]).map_or(none, |z| z as u32);
    let lowest: Vec<u32> = (0..nx * ny).map(lowest).collect();
    let reach = (1.0 / lattice.side_m()).ceil() as usize;
    let along_x = window_min(&columns, &lowest, 0, reach);
    let mut ground = window_min(&columns, &along_x, 1, reach);
    // Columns without a ground take it from their neighbours, ring by ring.
    let known = (0..ground.len() as u32).filter(|column| ground[*column as usize] != none).collect();
    let enter = |from: usize, column: usize| {
        let is_new = ground[column] == none;
        ground[column] = if is_new { ground[from] } else { ground[column] };
        is_new
    };
    flood(known, |column| columns.beside(column), enter);
    ground.iter().map(|z| f64::from(*z) * lattice.side_m()).collect()
}

/// The largest connected set at the largest clearance that does not cost more than a fifth of the area.
fn widest(
    lattice: &Lattice,
    candidates: &[u32],
    distance: &[u16],
    options: &TrajectoryOptions,
) -> Option<(f64, Vec<u32>)> {
    let (most, least) = (options.clearance_m, options.clearance_min_m);
    let tries = [least, least + (most - least) / 3.0, least + (most - least) * 2.0 / 3.0, most];
    let mut found: Option<(f64, Vec<u32>)> = None;
    let mut area_wanted = 0.0;
    for (number, clearance) in tries.into_iter().enumerate() {
        let cells = largest_part(lattice, candidates, |cell| {
            f64::from(distance[cell]).sqrt() * lattice.side_m() >= clearance - 1e-9
        });
        let area = area_m2(lattice, &cells);
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

/// The least value within `reach` places along one axis, for each cell.
fn window_min(cells: &Lattice, values: &[u32], axis: usize, reach: usize) -> Vec<u32> {
    let last = cells.size()[axis] - 1;
    let least = |cell: usize| {
        let mut place = cells.place(cell);
        let window = place[axis].saturating_sub(reach)..=(place[axis] + reach).min(last);
        let values = window.map(|at| {
            place[axis] = at;
            values[cells.number(place)]
        });
        values.min().unwrap_or(u32::MAX)
    };
    (0..cells.count()).map(least).collect()
}
