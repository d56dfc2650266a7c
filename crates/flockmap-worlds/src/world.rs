//! Worlds to fly in: solid cells and exact ray casts.

mod draw;
mod forest;
mod indoor;
mod open;
mod surface;
mod thicket;

use crate::cells::{CellSet, TooLarge};
use flockmap_grid::{Resolution, State, Voxel, VoxelBox};
use std::sync::OnceLock;
use thiserror::Error;

pub use open::OpenError;
pub(crate) use surface::{Surface, SurfacePoint};

/// Most points or boxes that a world is made from: 50 million (600 MB while it is built).
const PARTS_MAX: usize = 50_000_000;

/// A world that does not move: a set of solid cells (cubes) in a box, right-handed, z up, in metres.
///
/// Memory: 520 bytes for each 16³ cells that hold something and 5 bytes for each 16³ cells of the box, at
/// most 2²⁴ of the latter and 2¹⁸ of the former (together 210 MiB; twice that with known free cells). Polar
/// scans add its surface: 28 bytes a point, at most 8 million points, and for a moment up to 700 MB while it
/// is taken.
#[derive(Clone, Debug)]
pub struct World {
    resolution: Resolution,
    solid: CellSet,
    /// Cells known to be free, where the source of the world says so; everything else is not to be flown in.
    free: Option<CellSet>,
    /// Its surface as points, taken when it is first asked for.
    surface: OnceLock<Surface>,
}

/// What a ray ran into.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Hit {
    /// The solid cell.
    pub cell: Voxel,
    /// Metres from the origin of the ray to where it enters the cell; 0 if the origin lies in it.
    pub distance_m: f64,
    /// The point of entry, moved inside of the cell by at most 1 % of its side on each axis, so that rounding
    /// can never put it into the (empty) neighbour.
    pub point: [f64; 3],
}

/// Why a world cannot be made.
#[derive(Clone, PartialEq, Debug, Error)]
#[non_exhaustive]
pub enum WorldError {
    /// There is nothing solid in the input.
    #[error("the world has no solid cell: it needs at least one finite point or one Occupied box")]
    Empty,
    /// More cells than a world may hold.
    #[error(
        "a world of {size_m:?} m at cells of {resolution_m} m is too large: larger cells or a smaller part of it will fit \
         (at most 2^24 blocks of 16 cells cubed, 2^18 of them with something in it)"
    )]
    TooLarge {
        /// Size of the bounding box in metres.
        size_m: [f64; 3],
        /// Side of a cell in metres.
        resolution_m: f64,
    },
    /// More points or boxes than are read.
    #[error("more than 50,000,000 points or boxes: thin them out first")]
    TooManyParts,
    /// A point or box is not finite or too far from the origin for the cell size.
    #[error(
        "part number {index} lies out of reach: {place}; coordinates of a world must be finite and within 2^28 cells of 0"
    )]
    OutOfReach {
        /// Which point or box, counted from 0.
        index: usize,
        /// What it says.
        place: String,
    },
}

impl World {
    /// A world from a point cloud: every cell that holds a point is solid. Coordinates in metres; of large
    /// ones (UTM) subtract an offset first, so that they stay within 2²⁸ cells of 0.
    pub fn from_points(
        points: impl IntoIterator<Item = [f64; 3]>,
        resolution: Resolution,
    ) -> Result<Self, WorldError> {
        let boxes = points.into_iter().enumerate().map(|(index, point)| {
            let cell = resolution.voxel_at(point).and_then(|voxel| VoxelBox::spanning(voxel, voxel));
            let out_of_reach = || WorldError::OutOfReach { index, place: format!("point {point:?} m") };
            Ok((cell.ok_or_else(out_of_reach)?, State::Occupied))
        });
        Self::from_parts(boxes, resolution, false)
    }

    /// A world from boxes with a state, such as the leaves of an OctoMap: Occupied boxes are solid, Free
    /// boxes are where one may fly, and of all else nothing is known (it is not solid, but nobody flies
    /// there).
    pub fn from_states(
        boxes: impl IntoIterator<Item = (VoxelBox, State)>,
        resolution: Resolution,
    ) -> Result<Self, WorldError> {
        Self::from_parts(boxes.into_iter().map(Ok), resolution, true)
    }

    /// Side of a cell.
    pub const fn resolution(&self) -> Resolution {
        self.resolution
    }

    /// The box of the world, in cells. Nothing is solid outside of it and nobody flies there.
    pub const fn bounds(&self) -> VoxelBox {
        self.solid.region()
    }

    /// Whether the cell is solid.
    pub fn is_solid(&self, cell: Voxel) -> bool {
        self.solid.contains(cell)
    }

    /// Whether any cell of a box is solid.
    pub fn is_any_solid(&self, cells: &VoxelBox) -> bool {
        self.solid.contains_any(cells)
    }

    /// Whether it is known that the cell is free; `None` if the source of the world does not say.
    pub fn is_known_free(&self, cell: Voxel) -> Option<bool> {
        self.free.as_ref().map(|free| free.contains(cell))
    }

    /// Every solid cell, in an order that depends only on which cells there are.
    pub fn solid_cells(&self) -> impl Iterator<Item = Voxel> + '_ {
        self.solid.iter()
    }

    /// The first solid cell on a ray of at most `range_m` metres. `direction` need not have length 1. `None`
    /// if there is none, or if a number is not finite.
    ///
    /// Exact: the same cell as a walk from cell to cell would find, and the same on every machine. Empty
    /// space is skipped in blocks of 4 and of 16 cells and more; about 0.3 µs for a ray in the forest.
    pub fn cast_ray(&self, origin: [f64; 3], direction: [f64; 3], range_m: f64) -> Option<Hit> {
        let length = direction.iter().map(|d| d * d).sum::<f64>().sqrt();
        if !(length > 0.0 && length.is_finite() && range_m >= 0.0) {
            return None;
        }
        let side = self.resolution.metres();
        let start = origin.map(|p| p / side);
        let unit = direction.map(|d| d / length);
        let (cell, along) = self.solid.cast(start, unit, range_m / side)?;
        let index = [cell.x, cell.y, cell.z];
        let point = core::array::from_fn(|a| {
            let low = f64::from(index[a]);
            (start[a] + unit[a] * along).clamp(low + 0.01, low + 0.99) * side
        });
        Some(Hit { cell, distance_m: along * side, point })
    }

    /// The surface as points, for renderings that paint points. Taken once and shared by all who ask.
    pub(crate) fn surface(&self) -> &Surface {
        self.surface.get_or_init(|| Surface::new(&self.solid, self.resolution))
    }

    /// A number that two worlds share only if they are the same: 64-bit FNV-1a over cell size, box and cells.
    pub fn digest(&self) -> u64 {
        let mut digest = 0xcbf2_9ce4_8422_2325_u64;
        let mut add = |value: u64| {
            for byte in value.to_le_bytes() {
                digest = (digest ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
            }
        };
        add(u64::from(self.resolution.micrometres()));
        for corner in [self.bounds().min(), self.bounds().max()] {
            [corner.x, corner.y, corner.z].into_iter().for_each(|v| add(v as u64));
        }
        for set in [Some(&self.solid), self.free.as_ref()].into_iter().flatten() {
            for (corner, brick) in set.bricks() {
                [corner.x, corner.y, corner.z].into_iter().for_each(|v| add(v as u64));
                add(brick);
            }
        }
        digest
    }

    fn from_parts(
        parts: impl Iterator<Item = Result<(VoxelBox, State), WorldError>>,
        resolution: Resolution,
        knows_free: bool,
    ) -> Result<Self, WorldError> {
        let mut boxes = Vec::new();
        let mut bounds: Option<VoxelBox> = None;
        let mut any_solid = false;
        for part in parts {
            let (region, state) = part?;
            if state == State::Unknown {
                continue;
            }
            if boxes.len() == PARTS_MAX {
                return Err(WorldError::TooManyParts);
            }
            any_solid |= state == State::Occupied;
            bounds = Some(bounds.map_or(region, |b| b.union(&region)));
            boxes.push((region, state));
        }
        let bounds = bounds.filter(|_| any_solid).ok_or(WorldError::Empty)?;
        let too_large = |TooLarge| WorldError::TooLarge {
            size_m: bounds.size().map(|n| f64::from(n) * resolution.metres()),
            resolution_m: resolution.metres(),
        };
        let mut solid = CellSet::new(bounds).map_err(too_large)?;
        let mut free = if knows_free { Some(CellSet::new(bounds).map_err(too_large)?) } else { None };
        for (region, state) in boxes {
            let set = if state == State::Occupied { Some(&mut solid) } else { free.as_mut() };
            if let Some(set) = set {
                set.insert_box(&region).map_err(too_large)?;
            }
        }
        Ok(Self::sealed(resolution, solid, free))
    }

    fn sealed(resolution: Resolution, mut solid: CellSet, free: Option<CellSet>) -> Self {
        solid.seal();
        Self { resolution, solid, free, surface: OnceLock::new() }
    }
}
