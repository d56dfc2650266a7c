//! How high what stands in each column of a box is.

use flockmap_grid::{MapView, Plane, Resolution, VoxelBox};

use crate::columns::Columns;
use crate::space::TooLarge;

/// Most cells, in whole tiles of 8 × 8: 2²⁴ (410 × 410 m at 0.1 m), which take 130 MiB.
const CELLS_MAX: u64 = 1 << 24;

/// The lowest and the highest Occupied voxel of each column of a box, and whether anything of the column is known.
///
/// Cells are counted from the lowest x and y; a cell is as wide as a voxel. 8 bytes and a bit a cell.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct HeightMap {
    resolution: Resolution,
    columns: Columns,
    known: Vec<u64>,
    /// Row by row; the highest value where nothing is Occupied.
    lowest: Vec<i32>,
    /// The lowest value where nothing is Occupied.
    highest: Vec<i32>,
}

impl HeightMap {
    /// The columns of a box. O(columns, and blocks of the box or of the regions of the map that it meets,
    /// whichever are fewer).
    ///
    /// # Errors
    /// The box has more than 2²⁴ columns, in whole tiles of 8 × 8.
    pub fn new(view: &MapView, region: &VoxelBox) -> Result<Self, TooLarge> {
        let columns = Columns::new("a height map", region, CELLS_MAX)?;
        let ([width, height], [nx, ny], low) = (columns.size(), columns.tiles(), region.min());
        let mut known = vec![0; nx * ny];
        let (mut lowest, mut highest) = (vec![i32::MAX; width * height], vec![i32::MIN; width * height]);
        view.for_each_in(region, |index, block| {
            let (corner, slices, tile) = (index.corner(), columns.slices(index), columns.tile_of(index));
            known[tile] |= block.known()[slices.clone()].iter().fold(0, |all, slice| all | slice);
            // The columns of the box that a word names.
            let cells = |mut word: u64| {
                core::iter::from_fn(move || {
                    let bit = word.trailing_zeros() as i32;
                    (word != 0).then(|| word &= word - 1)?;
                    Some((corner.x + (bit & 7) - low.x, corner.y + (bit >> 3) - low.y))
                })
                .filter(|(x, y)| {
                    (0..width as i64).contains(&(*x).into()) && (0..height as i64).contains(&(*y).into())
                })
                .map(|(x, y)| y as usize * width + x as usize)
            };
            for (z, first) in firsts(block.occupied(), slices.clone()) {
                cells(first).for_each(|cell| lowest[cell] = lowest[cell].min(corner.z + z as i32));
            }
            for (z, first) in firsts(block.occupied(), slices.rev()) {
                cells(first).for_each(|cell| highest[cell] = highest[cell].max(corner.z + z as i32));
            }
        });
        columns.trim(&mut known);
        Ok(Self { resolution: view.resolution(), columns, known, lowest, highest })
    }

    /// Side of a cell.
    pub const fn resolution(&self) -> Resolution {
        self.resolution
    }

    /// The box whose columns these are.
    pub const fn region(&self) -> &VoxelBox {
        self.columns.region()
    }

    /// Cells along x and y.
    pub const fn size(&self) -> [usize; 2] {
        self.columns.size()
    }

    /// Whether a voxel of the column of a cell is known; `false` outside of the map.
    pub fn is_known(&self, x: usize, y: usize) -> bool {
        self.columns.bit_of(x, y).is_some_and(|(tile, bit)| self.known[tile] >> bit & 1 == 1)
    }

    /// Index along z of the lowest Occupied voxel of a column; `None` if there is none.
    pub fn lowest(&self, x: usize, y: usize) -> Option<i32> {
        self.columns.bit_of(x, y)?;
        Some(self.lowest[y * self.size()[0] + x]).filter(|z| *z != i32::MAX)
    }

    /// Index along z of the highest Occupied voxel of a column; `None` if there is none.
    pub fn highest(&self, x: usize, y: usize) -> Option<i32> {
        self.columns.bit_of(x, y)?;
        Some(self.highest[y * self.size()[0] + x]).filter(|z| *z != i32::MIN)
    }

    /// Height in metres of the lower face of the lowest Occupied voxel of each column, NaN where there is none; row
    /// by row from the lowest y, x fastest.
    pub fn bottoms_m(&self) -> Vec<f32> {
        let face = |z: &i32| if *z == i32::MAX { f32::NAN } else { self.metres(*z) };
        self.lowest.iter().map(face).collect()
    }

    /// Height in metres of the upper face of the highest Occupied voxel of each column, NaN where there is none; in
    /// the same order.
    pub fn tops_m(&self) -> Vec<f32> {
        let face = |z: &i32| if *z == i32::MIN { f32::NAN } else { self.metres(*z + 1) };
        self.highest.iter().map(face).collect()
    }

    fn metres(&self, z: i32) -> f32 {
        (f64::from(z) * self.resolution.metres()) as f32
    }
}

/// For each slice, in this order, the columns in which it is the first to have a bit.
fn firsts(plane: &Plane, slices: impl Iterator<Item = usize>) -> impl Iterator<Item = (usize, u64)> {
    let mut seen = 0;
    slices.map(move |z| {
        let first = plane[z] & !seen;
        seen |= first;
        (z, first)
    })
}
