//! A plane or a band of heights of a map, as planners in two dimensions want it.

use flockmap_grid::{MapView, Resolution, State, VoxelBox};

use crate::columns::Columns;
use crate::space::TooLarge;

/// Most cells, in whole tiles of 8 × 8: 2²⁶ (819 × 819 m at 0.1 m), which take 16 MiB.
const CELLS_MAX: u64 = 1 << 26;

/// When a cell is Free, of whose column no voxel is Occupied.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub enum ColumnRule {
    /// At least one voxel of its column is Free: what `octomap_server` projects, and users of Nav2 expect. A part
    /// of the column may be Unknown, so use it where the ground robot's sensor sees the whole band anyway.
    #[default]
    AnyFree,
    /// Every voxel of its column is Free: for a robot that fills the band, and must not meet what nobody has seen.
    AllFree,
}

/// What is known of the columns of a box, seen from above: one voxel high it is a slice of the map, higher it is a
/// band of heights.
///
/// A cell is Occupied if any voxel of its column is; else Free by a [`ColumnRule`]; else Unknown. Cells are counted
/// from the lowest x and y; a cell is as wide as a voxel. Two bits a cell.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct OccupancyGrid {
    resolution: Resolution,
    columns: Columns,
    free: Vec<u64>,
    occupied: Vec<u64>,
}

impl OccupancyGrid {
    /// The columns of a box. O(blocks of the box or of the regions of the map that it meets, whichever are fewer).
    ///
    /// # Errors
    /// The box has more than 2²⁶ columns, in whole tiles of 8 × 8.
    pub fn new(view: &MapView, region: &VoxelBox, rule: ColumnRule) -> Result<Self, TooLarge> {
        let columns = Columns::new("an occupancy grid", region, CELLS_MAX)?;
        let [nx, ny] = columns.tiles();
        let mut occupied = vec![0; nx * ny];
        let mut free = match rule {
            ColumnRule::AnyFree => {
                let mut free = vec![0; nx * ny];
                view.for_each_in(region, |index, block| {
                    let (tile, slices) = (columns.tile_of(index), columns.slices(index));
                    occupied[tile] |=
                        block.occupied()[slices.clone()].iter().fold(0, |all, slice| all | slice);
                    free[tile] |= block.free()[slices].iter().fold(0, |all, slice| all | slice);
                });
                free
            }
            ColumnRule::AllFree => {
                let mut columns_of = vec![(u64::MAX, 0); nx * ny];
                view.for_each_in(region, |index, block| {
                    let (tile, slices) = (columns.tile_of(index), columns.slices(index));
                    occupied[tile] |=
                        block.occupied()[slices.clone()].iter().fold(0, |all, slice| all | slice);
                    let (free, layers) = &mut columns_of[tile];
                    *free &= block.free()[slices].iter().fold(u64::MAX, |all, slice| all & slice);
                    *layers += 1;
                });
                // Of a block that is not there nothing is Free.
                let of_tile = |(free, layers)| if layers == columns.layers() { free } else { 0 };
                columns_of.into_iter().map(of_tile).collect()
            }
        };
        for (free, occupied) in free.iter_mut().zip(&occupied) {
            *free &= !occupied;
        }
        columns.trim(&mut free);
        columns.trim(&mut occupied);
        Ok(Self { resolution: view.resolution(), columns, free, occupied })
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

    /// The lower left corner of the first cell in metres, in the frame of the map.
    pub fn origin_m(&self) -> [f64; 2] {
        let low = self.region().min();
        // Whole micrometres, so that −3 m is not −3.0000000000000004.
        let metres = |v: i32| (i64::from(v) * i64::from(self.resolution.micrometres())) as f64 / 1e6;
        [low.x, low.y].map(metres)
    }

    /// State of a cell; Unknown outside of the grid.
    pub fn state(&self, x: usize, y: usize) -> State {
        match self.columns.bit_of(x, y) {
            Some((tile, bit)) if self.occupied[tile] >> bit & 1 == 1 => State::Occupied,
            Some((tile, bit)) if self.free[tile] >> bit & 1 == 1 => State::Free,
            _ => State::Unknown,
        }
    }

    /// Number of Free and of Occupied cells.
    pub fn count(&self) -> (usize, usize) {
        let ones = |words: &[u64]| words.iter().map(|word| word.count_ones() as usize).sum();
        (ones(&self.free), ones(&self.occupied))
    }

    /// The data of a `nav_msgs/OccupancyGrid`: −1 Unknown, 0 Free, 100 Occupied; row by row from the lowest y, x
    /// fastest. Its `info` has `resolution`, `width` and `height` as [`Self::size`], and as the position of
    /// `origin` [`Self::origin_m`], without a rotation. A byte a cell.
    pub fn to_ros(&self) -> Vec<i8> {
        // -1 as a byte is 255.
        self.to_bytes([255, 0, 100]).into_iter().map(|byte| byte as i8).collect()
    }

    /// A byte for each cell that is Unknown, Free or Occupied, in the same order.
    pub fn to_bytes(&self, shades: [u8; 3]) -> Vec<u8> {
        let ([width, height], [nx, _], before) = (self.size(), self.columns.tiles(), self.columns.before());
        let [unknown, free, occupied] = shades.map(|shade| u64::from(shade) * ONES);
        let mut bytes = Vec::with_capacity(width * height);
        let mut row = vec![0; nx * 8];
        for y in before[1]..before[1] + height {
            let tiles = y / 8 * nx..(y / 8 + 1) * nx;
            let words = self.free[tiles.clone()].iter().zip(&self.occupied[tiles]);
            for (eight, (free_word, occupied_word)) in row.chunks_exact_mut(8).zip(words) {
                let [is_free, is_occupied] = [free_word, occupied_word]
                    .map(|word| BYTES_OF_BITS[usize::from((word >> (y % 8 * 8)) as u8)]);
                let shade = unknown ^ (is_free & (unknown ^ free)) ^ (is_occupied & (unknown ^ occupied));
                eight.copy_from_slice(&shade.to_le_bytes());
            }
            bytes.extend_from_slice(&row[before[0]..before[0] + width]);
        }
        bytes
    }
}

/// 1 in each of eight bytes.
const ONES: u64 = 0x0101_0101_0101_0101;

/// Of eight bits a byte for each, the lowest first: 255 where it is set, or 0.
static BYTES_OF_BITS: [u64; 256] = {
    let mut table = [0; 256];
    let mut bits = 0;
    while bits < 256 {
        // Each byte keeps its own bit; with 127 more, its highest bit says whether it was set.
        let own = (bits as u64 * ONES) & 0x8040_2010_0804_0201;
        table[bits] = ((own + 0x7f * ONES) >> 7 & ONES) * 0xff;
        bits += 1;
    }
    table
};
