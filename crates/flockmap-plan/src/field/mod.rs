//! The Euclidean distance field of a box.

mod cell;
mod inflate;
mod line;
mod passes;
mod query;
mod row;

use core::mem::size_of;

use flockmap_grid::{MapView, Resolution, VoxelBox};

use crate::Obstacles;
use cell::{Cell, Group};
use passes::{Passes, Shape};

pub use query::Clearance;

/// The longest diagonal of a box, in voxels. A squared distance below its square is exact in every number here.
pub const FIELD_DIAGONAL_MAX: u32 = 4096;

/// What a distance field is made of and how large it may be.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct FieldConfig {
    /// What distances are measured to.
    pub obstacles: Obstacles,
    /// Bytes that a field may take, see [`DistanceField::bytes_of`]. Default: 256 MiB.
    pub memory_max: u64,
}

impl Default for FieldConfig {
    fn default() -> Self {
        Self { obstacles: Obstacles::default(), memory_max: 256 << 20 }
    }
}

/// Why there is no field of a box.
#[derive(Clone, Copy, PartialEq, Debug, thiserror::Error)]
pub enum FieldError {
    /// It would take too much.
    #[error(
        "a distance field of {region:?} takes {bytes} bytes, and memory_max allows {memory_max}: ask for a smaller box"
    )]
    TooLarge {
        /// The box.
        region: VoxelBox,
        /// What the field would take.
        bytes: u128,
        /// The limit.
        memory_max: u64,
    },
    /// Its diagonal is longer than [`FIELD_DIAGONAL_MAX`].
    #[error(
        "a distance field of {region:?} would be longer than {FIELD_DIAGONAL_MAX} voxels from corner to corner: ask for a smaller box"
    )]
    TooLong {
        /// The box.
        region: VoxelBox,
    },
}

/// What [`DistanceField::update`] did.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Updated {
    /// Nothing: no block of the box had changed.
    Unchanged,
    /// What depends on the blocks that had changed.
    Partly,
    /// All of it.
    Anew,
}

/// For every voxel of a box, how far the nearest obstacle of the box is.
///
/// Distances are Euclidean, from the centre of the voxel to the centre of the nearest obstacle voxel, and exact: the
/// squared distance in voxels is a whole number and kept as one. An obstacle has distance 0, its neighbour the side of
/// a voxel. (So have it OctoMap's `dynamicEDT3D` and PyPI's `edt`.) The surface of an obstacle is nearer than its
/// centre, by up to √3/2 voxels: [`DistanceField::are_clear`] and [`crate::Collision`] take that into account.
///
/// **Obstacles outside of the box do not count.** Who needs distances up to d right everywhere in a box asks for the
/// box [`grown`] by d.
///
/// Made in three passes (along x from bit planes, then z, then y) after P. Felzenszwalb, D. Huttenlocher, "Distance
/// Transforms of Sampled Functions", Theory of Computing 8 (2012). A line whose distances are short is searched
/// outward, 16 lines at a time, until nothing farther can be nearer; others by their lower envelope. O(voxels) time.
/// `docs/plan-diary.md` has measured times.
#[derive(Clone, Debug)]
pub struct DistanceField {
    config: FieldConfig,
    shape: Shape,
    resolution: Resolution,
    version: u64,
    cells: Cells,
}

#[derive(Clone, Debug)]
enum Cells {
    Small(Passes<u16>),
    Large(Passes<f32>),
}

impl DistanceField {
    /// The field of a box.
    pub fn new(view: &MapView, region: VoxelBox, config: &FieldConfig) -> Result<Self, FieldError> {
        check(&region, config)?;
        let shape = Shape::new(region);
        let cells = if is_small(&region) { Cells::Small(Passes::new()) } else { Cells::Large(Passes::new()) };
        let mut field = Self { config: *config, shape, resolution: view.resolution(), version: 0, cells };
        field.anew(view);
        Ok(field)
    }

    /// The field of another box, or of another map, in the memory of this one: for a box that goes with the robot.
    /// On an error the field stays as it is.
    pub fn move_to(&mut self, view: &MapView, region: VoxelBox) -> Result<(), FieldError> {
        if is_small(&region) != is_small(&self.region()) {
            *self = Self::new(view, region, &self.config)?;
            return Ok(());
        }
        check(&region, &self.config)?;
        self.shape = Shape::new(region);
        self.resolution = view.resolution();
        self.anew(view);
        Ok(())
    }

    /// Brings the field to a newer view of the same map. The field is then equal to one that is made anew; what did
    /// not change is not looked at where [`MapView::changed_since`] knows it.
    pub fn update(&mut self, view: &MapView) -> Updated {
        let changed = if self.resolution == view.resolution() && self.version <= view.version() {
            view.versions_since(self.version)
        } else {
            None
        };
        let Some(changed) = changed else {
            self.resolution = view.resolution();
            self.anew(view);
            return Updated::Anew;
        };
        let (low, high) = (self.region().min().block(), self.region().max().block());
        let mut rows: Vec<[i32; 2]> = changed
            .filter(|(at, _)| (low.x..=high.x).contains(&at.x))
            .filter(|(at, _)| (low.y..=high.y).contains(&at.y) && (low.z..=high.z).contains(&at.z))
            .map(|(at, _)| [at.y, at.z])
            .collect();
        rows.sort_unstable();
        rows.dedup();
        self.version = view.version();
        if rows.is_empty() {
            return Updated::Unchanged;
        }
        match &mut self.cells {
            Cells::Small(passes) => passes.again(&self.shape, view, self.config.obstacles, &rows),
            Cells::Large(passes) => passes.again(&self.shape, view, self.config.obstacles, &rows),
        }
        Updated::Partly
    }

    /// The box.
    pub const fn region(&self) -> VoxelBox {
        self.shape.region
    }

    /// Side of a voxel.
    pub const fn resolution(&self) -> Resolution {
        self.resolution
    }

    /// Version of the view that the field is of.
    pub const fn version(&self) -> u64 {
        self.version
    }

    /// What distances are measured to.
    pub const fn obstacles(&self) -> Obstacles {
        self.config.obstacles
    }

    /// Bytes that the field of a box takes: 6 for each voxel if its diagonal is at most 255 voxels (as of
    /// 147 × 147 × 147), else 12, where x is made up to multiples of 16 from the corner of a block.
    pub fn bytes_of(region: &VoxelBox) -> u128 {
        let group = if is_small(region) { size_of::<Group<u16>>() } else { size_of::<Group<f32>>() };
        Shape::new(*region).len() * 3 * group as u128
    }

    fn anew(&mut self, view: &MapView) {
        self.version = view.version();
        match &mut self.cells {
            Cells::Small(passes) => passes.anew(&self.shape, view, self.config.obstacles),
            Cells::Large(passes) => passes.anew(&self.shape, view, self.config.obstacles),
        }
    }
}

/// The box that is larger by so many voxels on each side, as far as there are voxels.
pub fn grown(region: VoxelBox, voxels: u32) -> VoxelBox {
    use flockmap_grid::{VOXEL_LIMIT, Voxel};
    let by = voxels.min(2 * VOXEL_LIMIT as u32) as i32;
    let (min, max) = (region.min(), region.max());
    let low = [min.x, min.y, min.z].map(|at| (at - by).max(-VOXEL_LIMIT));
    let high = [max.x, max.y, max.z].map(|at| (at + by).min(VOXEL_LIMIT));
    let [low, high] = [low, high].map(|[x, y, z]| Voxel::new(x, y, z));
    VoxelBox::spanning(low, high).unwrap_or(region)
}

fn check(region: &VoxelBox, config: &FieldConfig) -> Result<(), FieldError> {
    if diagonal_squared(region) >= u64::from(FIELD_DIAGONAL_MAX).pow(2) {
        return Err(FieldError::TooLong { region: *region });
    }
    let bytes = DistanceField::bytes_of(region);
    if bytes > config.memory_max.into() {
        return Err(FieldError::TooLarge { region: *region, bytes, memory_max: config.memory_max });
    }
    Ok(())
}

/// Between the centres of opposite corners, in voxels.
fn diagonal_squared(region: &VoxelBox) -> u64 {
    region.size().iter().map(|size| u64::from(size - 1).pow(2)).sum()
}

fn is_small(region: &VoxelBox) -> bool {
    diagonal_squared(region) < u16::NONE.into()
}
