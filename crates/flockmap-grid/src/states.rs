//! States of voxels from a mapper elsewhere, in place of scans.

use crate::pose::MARGIN;
use crate::{PoseError, Resolution, Stamp, State, VOXEL_LIMIT, Voxel, VoxelBox};

/// What a mapper elsewhere (OctoMap, Bonxai, ROG-Map, nvblox, wavemap, …) says of the map. It enters where the
/// observations of the own mapper do: [`Mapper::insert_states`](crate::Mapper::insert_states).
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct StatesUpdate<'a> {
    /// When it was observed, on the robot's clock.
    pub stamp: Stamp,
    /// Side of the voxels. It must be the robot's own: a map is not resampled here, since that would turn one
    /// voxel into many or many into one, which only the mapper that made them can do right. Whoever has a
    /// finer map gives the robot a resolution that its own divides, and takes for each of the larger voxels
    /// Occupied if one within is, else Free if all are.
    pub resolution: Resolution,
    /// Where the sensor was: metres, in the frame of the map. Give it where it is known: the codec needs fewer
    /// bytes then (`docs/sensor-input.md` has how many), and a map that is full forgets what is far from there.
    /// `None`: a place behind the mean of what was observed stands for it, see there.
    pub sensor: Option<[f64; 3]>,
    /// The voxels.
    pub states: States<'a>,
}

/// The voxels of an update. Voxel (i, j, k) is the cube from (i, j, k) · resolution on, in the frame of the map.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum States<'a> {
    /// Single voxels, each of them observed at the stamp, whether it changes or not. Of two for one voxel the
    /// later wins. Unknown takes back what the robot itself knew. At most [`StatesUpdate::VOXELS_MAX`].
    Voxels(&'a [(Voxel, State)]),
    /// All voxels of a box, such as the local map that others publish. It is compared with what was there:
    /// only voxels whose state differs count as observed, and all others stay as they are, with the stamp
    /// that they have. At most [`StatesUpdate::BOX_VOXELS_MAX`].
    Box {
        /// Which voxels.
        region: VoxelBox,
        /// One for each: x runs fastest, then y, then z.
        states: &'a [State],
        /// Whether Unknown takes back what the robot itself knew. Else it leaves it, as fits a local map that
        /// moves along and knows nothing yet of where it came to.
        clear_unknown: bool,
    },
}

/// Why an update was refused. Nothing has been changed then.
#[derive(Clone, Copy, PartialEq, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StatesError {
    /// Voxels of another size.
    #[error(
        "voxels of {got:?}, expected {expected:?} as this robot has: configure both maps alike, or bring the states to its voxels \
         first"
    )]
    Resolution {
        /// Of the update.
        got: Resolution,
        /// The robot's.
        expected: Resolution,
    },
    /// The place of the sensor is none, or lies beyond the grid.
    #[error("place of the sensor: {0}")]
    Sensor(#[from] PoseError),
    /// More voxels than an update may have.
    #[error("{got} voxels, expected at most {max} in an update: give them in several")]
    TooMany {
        /// As given.
        got: u128,
        /// The limit.
        max: usize,
    },
    /// A box has more or fewer states than voxels.
    #[error("{got} states for a {region:?}, which has {} voxels", region.volume())]
    BoxStates {
        /// States given.
        got: usize,
        /// The box.
        region: VoxelBox,
    },
    /// A voxel lies where the grid ends.
    #[error(
        "voxel {voxel:?} lies beyond the grid, which goes to ±{limit} on each axis: take indices from an origin near the robots"
    )]
    BeyondGrid {
        /// As given.
        voxel: Voxel,
        /// The farthest from the origin that a voxel may be on each axis.
        limit: i32,
    },
}

impl StatesUpdate<'_> {
    /// Most voxels of [`States::Voxels`]. Taking them in needs up to 80 bytes each for a moment; and for each block
    /// that is kept, what is reported of it, 216 bytes.
    pub const VOXELS_MAX: usize = 1 << 22;
    /// Most voxels of [`States::Box`]. Taking them in needs up to 80 bytes for each block of 8³ of them for a moment,
    /// and the same report.
    pub const BOX_VOXELS_MAX: usize = 1 << 25;

    /// Whether a robot with this resolution can take it in. O(voxels) for single ones, O(1) for a box.
    ///
    /// # Errors
    /// [`StatesError`] says what was wrong.
    pub fn check(&self, resolution: Resolution) -> Result<(), StatesError> {
        if self.resolution != resolution {
            return Err(StatesError::Resolution { got: self.resolution, expected: resolution });
        }
        if let Some(sensor) = self.sensor {
            resolution.check_position(sensor)?;
        }
        let limited = |got: u128, max: usize| {
            if got > max as u128 { Err(StatesError::TooMany { got, max }) } else { Ok(()) }
        };
        let within = |voxel: Voxel| {
            let limit = VOXEL_LIMIT - MARGIN;
            let is_within = [voxel.x, voxel.y, voxel.z].iter().all(|at| (-limit..=limit).contains(at));
            if is_within { Ok(()) } else { Err(StatesError::BeyondGrid { voxel, limit }) }
        };
        match self.states {
            States::Voxels(voxels) => {
                limited(voxels.len() as u128, Self::VOXELS_MAX)?;
                voxels.iter().try_for_each(|(voxel, _)| within(*voxel))
            }
            States::Box { region, states, .. } => {
                limited(region.volume(), Self::BOX_VOXELS_MAX)?;
                within(region.min())?;
                within(region.max())?;
                let fits = region.volume() == states.len() as u128;
                fits.then_some(()).ok_or(StatesError::BoxStates { got: states.len(), region })
            }
        }
    }
}
