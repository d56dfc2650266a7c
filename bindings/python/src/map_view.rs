//! The fused map at one moment. `view` has what is asked of it, and makes products that take it in turn.

use pyo3::prelude::*;

/// The map of a robot at one moment: voxels that are Unknown (0), Free (1) or Occupied (2). It stays as it is while the
/// robot goes on, and outlives it.
///
/// Positions are metres in the frame of the robot's map. Voxel (i, j, k) is the cube from (i, j, k) · resolution on. A
/// `box` is a pair of corners in metres, ((x, y, z), (x, y, z)), the first below the second on each axis.
#[pyclass(frozen, module = "flockmap", name = "MapView")]
pub(crate) struct MapView(pub(crate) flockmap::MapView);
