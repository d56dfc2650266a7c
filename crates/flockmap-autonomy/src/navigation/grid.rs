//! A planner's coarse picture of a fused map.

use core::ops::{AddAssign, SubAssign};
use flockmap_grid::{BlockIndex, MapView, Plane, Resolution, State, StateBlock, Voxel, VoxelBox, set_bits};
use flockmap_plan::lattice::Lattice;
use flockmap_worlds::curve::distance;
use std::collections::{BTreeMap, BTreeSet};
use thiserror::Error;

/// Most cells of a grid: 2²⁴, for which it takes 260 MiB.
const CELLS_MAX: u64 = 1 << 24;

/// What a navigation grid is made for.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct NavigationConfig {
    /// Side of a voxel of the map.
    pub resolution: Resolution,
    /// Lowest and highest corner of the part of the map that is of interest, in metres. Made larger to whole
    /// cells. At most 2²⁴ cells.
    pub region_m: [[f64; 3]; 2],
    /// Side of a cell in metres; rounded to a whole number of voxels, 1 … 8. Default 0.2.
    pub cell_m: f64,
    /// Least distance in metres between any point of a passable cell and any Occupied voxel, at most 8 cells.
    /// Default 0.3.
    pub clearance_m: f64,
    /// Cells nearer than this to an Occupied voxel are avoided where there is another path that is not much
    /// longer. Metres, at most 8 cells. Default 0.5.
    pub comfort_m: f64,
}

impl NavigationConfig {
    /// The defaults for a part of a map.
    pub const fn new(resolution: Resolution, region_m: [[f64; 3]; 2]) -> Self {
        Self { resolution, region_m, cell_m: 0.2, clearance_m: 0.3, comfort_m: 0.5 }
    }
}

/// Why there is no grid.
#[derive(Clone, PartialEq, Debug, Error)]
#[non_exhaustive]
pub enum NavigationError {
    /// The region is empty, not finite, or out of reach of voxel indices.
    #[error("region_m is {0:?}, expected a lower and a higher corner, finite and within 2^28 voxels of 0")]
    Region([[f64; 3]; 2]),
    /// Too many cells.
    #[error(
        "a region of {cells:?} cells of {cell_m} m is too large: take larger cells or a smaller region (at most 2^24 cells)"
    )]
    TooLarge {
        /// Cells along x, y, z.
        cells: [u32; 3],
        /// Side of a cell in metres.
        cell_m: f64,
    },
    /// A distance that cannot be kept.
    #[error("{name} is {value} m, expected 0 to {max} (8 cells)")]
    Distance {
        /// Of `clearance_m` and `comfort_m`.
        name: &'static str,
        /// What it was.
        value: f64,
        /// What it may be.
        max: f64,
    },
}

/// What a planner makes of the voxels of a cell.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum CellState {
    /// Less than half of its voxels are known, and none is Occupied.
    Unknown,
    /// At least half of its voxels are Free, and none is Occupied. Single voxels that no ray met make no cell
    /// Unknown.
    Free,
    /// At least one of its voxels is Occupied.
    Occupied,
}

/// A coarse picture of a part of a fused map, kept up to date with it: for each cell its state, and whether a
/// robot fits there. Cells are numbered, x fastest.
///
/// Memory: 16 bytes a cell, and 150 bytes for each block of the map in the region.
#[derive(Clone, Debug)]
pub struct NavigationGrid {
    /// Voxels along a side of a cell.
    multiple: i32,
    /// The region in cells.
    pub(crate) cells: Lattice,
    /// The region in voxels.
    region: VoxelBox,
    /// Voxels that can block or crowd a cell of the region.
    pub(crate) reached: VoxelBox,
    counts: Vec<Counts>,
    /// For each place of a voxel in its cell the cells that it blocks or crowds.
    kernels: Vec<Vec<Near>>,
    /// What was taken in of each block so far.
    blocks: BTreeMap<BlockIndex, StateBlock>,
    version: u64,
}

/// What is in a cell and near it.
#[derive(Clone, Copy, Debug, Default)]
struct Counts {
    /// Voxels of the cell.
    free: u16,
    occupied: u16,
    /// Occupied voxels nearer than the clearance, and nearer than the comfort.
    blocking: u32,
    crowding: u32,
    is_assumed_free: bool,
}

/// A cell near a voxel, relative to the voxel's own cell.
#[derive(Clone, Copy, Debug)]
struct Near {
    offset: [i32; 3],
    blocks: bool,
    crowds: bool,
}

impl NavigationGrid {
    /// A grid in which all is Unknown.
    ///
    /// # Errors
    /// [`NavigationError`] says what cannot work and what would.
    pub fn new(config: &NavigationConfig) -> Result<Self, NavigationError> {
        let side = config.resolution.metres();
        let multiple = ((config.cell_m / side).round() as i32).clamp(1, 8);
        let cell_m = side * f64::from(multiple);
        let bad_region = || NavigationError::Region(config.region_m);
        let [low_m, high_m] = config.region_m;
        if (0..3).any(|a| low_m[a].partial_cmp(&high_m[a]) != Some(core::cmp::Ordering::Less)) {
            return Err(bad_region());
        }
        // A hair inside, so that a face on a cell's border does not take in the next cell.
        let hair = side * 1e-6;
        let low = config.resolution.voxel_at(low_m.map(|v| v + hair)).ok_or_else(bad_region)?;
        let high = config.resolution.voxel_at(high_m.map(|v| v - hair)).ok_or_else(bad_region)?;
        let low = [low.x, low.y, low.z].map(|v| v.div_euclid(multiple));
        let high = [high.x, high.y, high.z].map(|v| v.div_euclid(multiple));
        let cells: [u32; 3] = core::array::from_fn(|a| high[a].abs_diff(low[a]) + 1);
        let count = cells.iter().try_fold(1u64, |n, &c| n.checked_mul(u64::from(c)));
        let count =
            count.filter(|&n| n <= CELLS_MAX).ok_or(NavigationError::TooLarge { cells, cell_m })? as usize;
        let max = 8.0 * cell_m;
        for (name, value) in [("clearance_m", config.clearance_m), ("comfort_m", config.comfort_m)] {
            if !(0.0..=max).contains(&value) {
                return Err(NavigationError::Distance { name, value, max });
            }
        }
        let corner = |c: [i32; 3], up: i32| {
            let [x, y, z] = c.map(|v| v * multiple + up);
            Voxel::new(x, y, z)
        };
        let region = VoxelBox::spanning(corner(low, 0), corner(high, multiple - 1)).ok_or_else(bad_region)?;
        let reach = (config.clearance_m.max(config.comfort_m) / side).ceil() as i32;
        let (min, max) = (region.min(), region.max());
        let reached = VoxelBox::spanning(
            Voxel::new(min.x - reach, min.y - reach, min.z - reach),
            Voxel::new(max.x + reach, max.y + reach, max.z + reach),
        );
        Ok(Self {
            multiple,
            cells: Lattice::new(cells.map(|c| c as usize)).placed([0.0; 3], low, cell_m),
            region,
            reached: reached.ok_or_else(bad_region)?,
            counts: vec![Counts::default(); count],
            kernels: kernels(multiple, config.clearance_m / side, config.comfort_m / side),
            blocks: BTreeMap::new(),
            version: 0,
        })
    }

    /// Takes in what changed in the map since the last call. Always the same map: one grid follows one robot.
    ///
    /// Cost: O(blocks of the map) for the search, and some microseconds for each voxel that became or ceased
    /// to be Occupied.
    pub fn update(&mut self, map: &MapView) {
        if map.version() == self.version {
            return;
        }
        let everything = || {
            let all = self.blocks.keys().copied().chain(map.blocks().map(|(index, _)| index));
            all.collect::<BTreeSet<_>>().into_iter().collect()
        };
        for index in map.changed_since(self.version).unwrap_or_else(everything) {
            self.take_in(index, map.block(index).unwrap_or_default());
        }
        self.version = map.version();
    }

    /// Takes the cells within a distance (metres) of a place for Free as long as nothing in them is Occupied:
    /// where a robot starts, it can see nothing below itself.
    pub fn assume_free(&mut self, place: [f64; 3], radius_m: f64) {
        for cell in self.cells.near(place, radius_m) {
            self.counts[cell].is_assumed_free |= distance(self.cells.centre(cell), place) <= radius_m;
        }
    }

    /// Number of cells.
    pub const fn count(&self) -> usize {
        self.counts.len()
    }

    /// The cells, without what is in them.
    pub const fn cells(&self) -> &Lattice {
        &self.cells
    }

    /// The voxels of the map that the grid covers.
    pub const fn region(&self) -> VoxelBox {
        self.region
    }

    /// State of a cell by its number, which must be below [`Self::count`].
    pub fn cell_state(&self, number: usize) -> CellState {
        let voxels = (self.multiple * self.multiple * self.multiple) as u16;
        let counts = &self.counts[number];
        if counts.occupied > 0 {
            CellState::Occupied
        } else if counts.free * 2 >= voxels || counts.is_assumed_free {
            CellState::Free
        } else {
            CellState::Unknown
        }
    }

    /// Whether a robot may be anywhere in a cell: it is Free (or Unknown, if `unknown_ok`) and no Occupied
    /// voxel is nearer than the clearance.
    pub fn is_passable(&self, number: usize, unknown_ok: bool) -> bool {
        self.counts[number].blocking == 0
            && match self.cell_state(number) {
                CellState::Free => true,
                CellState::Unknown => unknown_ok,
                CellState::Occupied => false,
            }
    }

    /// Whether an Occupied voxel is nearer to a cell than comfort wants.
    pub fn is_crowded(&self, number: usize) -> bool {
        self.counts[number].crowding > 0
    }

    /// Puts the states of a block in the place of those taken in before.
    pub(crate) fn take_in(&mut self, index: BlockIndex, new: StateBlock) {
        if index.voxel_box().intersection(&self.reached).is_none() {
            return;
        }
        let old = if new.is_empty() { self.blocks.remove(&index) } else { self.blocks.insert(index, new) }
            .unwrap_or_default();
        let differ = |new: &Plane, old: &Plane| core::array::from_fn(|z| new[z] ^ old[z]);
        for bit in set_bits(&differ(new.free(), old.free())) {
            self.count_free(index.voxel(bit), new.get(bit) == State::Free);
        }
        for bit in set_bits(&differ(new.occupied(), old.occupied())) {
            self.count_occupied(index.voxel(bit), new.get(bit) == State::Occupied);
        }
    }

    fn count_free(&mut self, voxel: Voxel, more: bool) {
        let index = [voxel.x, voxel.y, voxel.z].map(|v| v.div_euclid(self.multiple));
        if let Some(cell) = self.cells.number_of(index) {
            change(&mut self.counts[cell].free, more);
        }
    }

    fn count_occupied(&mut self, voxel: Voxel, more: bool) {
        let (m, voxel) = (self.multiple, [voxel.x, voxel.y, voxel.z]);
        let index = voxel.map(|v| v.div_euclid(m));
        let phase = voxel.map(|v| v.rem_euclid(m));
        if let Some(cell) = self.cells.number_of(index) {
            change(&mut self.counts[cell].occupied, more);
        }
        for near in &self.kernels[((phase[2] * m + phase[1]) * m + phase[0]) as usize] {
            let at = core::array::from_fn(|a| index[a] + near.offset[a]);
            if let Some(cell) = self.cells.number_of(at) {
                if near.blocks {
                    change(&mut self.counts[cell].blocking, more);
                }
                if near.crowds {
                    change(&mut self.counts[cell].crowding, more);
                }
            }
        }
    }
}

/// Counts one more or one less.
fn change<T: AddAssign + SubAssign + From<bool>>(count: &mut T, more: bool) {
    if more { *count += true.into() } else { *count -= true.into() }
}

/// For each place of a voxel in its cell, x fastest, the cells nearer than `clearance` and `comfort` voxels.
fn kernels(multiple: i32, clearance: f64, comfort: f64) -> Vec<Vec<Near>> {
    let reach = (clearance.max(comfort) / f64::from(multiple)).ceil() as i32 + 1;
    let places =
        (0..multiple.pow(3)).map(|p| [p % multiple, p / multiple % multiple, p / multiple / multiple]);
    places
        .map(|phase| {
            let mut kernel = Vec::new();
            for number in 0..(2 * reach + 1).pow(3) {
                let side = 2 * reach + 1;
                let offset = [number % side, number / side % side, number / side / side].map(|v| v - reach);
                // Between the faces of the voxel and of the cell.
                let gap = |a: usize| {
                    let (low, high) = (offset[a] * multiple, offset[a] * multiple + multiple);
                    (low - phase[a] - 1).max(phase[a] - high).max(0)
                };
                let away = f64::from((0..3).map(|a| gap(a) * gap(a)).sum::<i32>()).sqrt();
                // The hair keeps distances that are meant to be equal on the near side of rounding.
                let near = Near { offset, blocks: away < clearance - 1e-9, crowds: away < comfort - 1e-9 };
                if near.blocks || near.crowds {
                    kernel.push(near);
                }
            }
            kernel
        })
        .collect()
}
