//! Where the known meets the unknown.

use flockmap::VoxelBox;
use flockmap::grid::set_bits;
use flockmap_plan::{FrontierConfig, frontier_cells};
use numpy::PyArray2;
use pyo3::prelude::*;

use crate::arrays::rows;
use crate::errors::{self, Error};
use crate::given::{Corners, corners};

/// Free voxels beside Unknown ones, near each other.
#[pyclass(frozen, module = "flockmap", name = "Frontier")]
pub(crate) struct Frontier {
    /// The middle of the centres of its voxels: (x, y, z) in metres. It need not lie in one of them.
    #[pyo3(get)]
    centroid: [f64; 3],
    /// The corners in metres of the smallest box that holds them.
    #[pyo3(get)]
    bounds: Corners,
    voxels: Vec<[i32; 3]>,
}

#[pymethods]
impl Frontier {
    /// Indices of its voxels: (N, 3) int32.
    #[getter]
    fn voxels<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<i32>>> {
        rows(py, self.voxels.clone())
    }

    /// Number of its voxels.
    fn __len__(&self) -> usize {
        self.voxels.len()
    }

    fn __repr__(&self) -> String {
        format!("Frontier({} voxels, centroid={:?})", self.voxels.len(), self.centroid)
    }
}

/// The clusters of a box, or of all of the map.
pub(crate) fn frontiers(
    py: Python<'_>,
    view: &flockmap::MapView,
    region: Option<VoxelBox>,
    reach_m: f64,
    cells_min: usize,
) -> PyResult<Vec<Frontier>> {
    if !(reach_m >= 0.0 && reach_m.is_finite()) {
        return Err(Error::new_err(format!("reach is {reach_m}, expected 0 or more metres")));
    }
    let config = FrontierConfig { reach_m, cells_min };
    let found = py.detach(|| {
        let region = region.or_else(|| around(view));
        region.map_or_else(|| Ok(Vec::new()), |region| flockmap_plan::frontiers(view, &region, &config))
    });
    let frontier = |found: flockmap_plan::Frontier| Frontier {
        centroid: found.centroid_m,
        bounds: corners(view.resolution(), &found.bounds),
        voxels: found.voxels.iter().map(|voxel| [voxel.x, voxel.y, voxel.z]).collect(),
    };
    Ok(found.map_err(errors::refused)?.into_iter().map(frontier).collect())
}

/// The frontier voxels of a box, or of all of the map.
pub(crate) fn frontier_voxels<'py>(
    py: Python<'py>,
    view: &flockmap::MapView,
    region: Option<VoxelBox>,
) -> PyResult<Bound<'py, PyArray2<i32>>> {
    let found = py.detach(|| {
        let cells = region.or_else(|| around(view)).map(|region| frontier_cells(view, &region));
        let cells = cells.into_iter().flatten();
        let voxels = cells.flat_map(|(index, plane)| set_bits(&plane).map(move |bit| index.voxel(bit)));
        voxels.map(|voxel| [voxel.x, voxel.y, voxel.z]).collect()
    });
    rows(py, found)
}

/// All of the map, and the Unknown beside it.
fn around(view: &flockmap::MapView) -> Option<VoxelBox> {
    view.bounding_box().map(|bounds| flockmap_plan::grown(bounds, 1))
}
