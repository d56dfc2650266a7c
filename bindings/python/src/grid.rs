//! A band of heights of the map, seen from above.

use std::path::PathBuf;

use flockmap::VoxelBox;
use flockmap_plan::ColumnRule;
use numpy::{IntoPyArray, PyArray2, PyArrayMethods};
use pyo3::prelude::*;

use crate::errors;

/// What is known of the columns of a box, seen from above: cells that are Occupied if any voxel of their column is, else Free
/// by the rule that was asked for, else Unknown. Row y, column x, from the lowest on; a cell is as wide as a voxel.
#[pyclass(frozen, module = "flockmap", name = "OccupancyGrid")]
pub(crate) struct OccupancyGrid(flockmap_plan::OccupancyGrid);

#[pymethods]
impl OccupancyGrid {
    /// (H, W) int8 as nav_msgs/OccupancyGrid has it: -1 Unknown, 0 Free, 100 Occupied.
    fn to_ros<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<i8>>> {
        let cells = py.detach(|| self.0.to_ros());
        cells.into_pyarray(py).reshape(self.shape())
    }

    /// (H, W) uint8: 0 Unknown, 1 Free, 2 Occupied.
    fn states<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<u8>>> {
        let cells = py.detach(|| self.0.to_bytes([0, 1, 2]));
        cells.into_pyarray(py).reshape(self.shape())
    }

    /// Rows and columns.
    #[getter]
    fn shape(&self) -> [usize; 2] {
        let [width, height] = self.0.size();
        [height, width]
    }

    /// x and y of the lower left corner of the first cell, in metres.
    #[getter]
    fn origin(&self) -> [f64; 2] {
        self.0.origin_m()
    }

    /// Side of a cell in metres.
    #[getter]
    fn resolution(&self) -> f64 {
        self.0.resolution().metres()
    }

    /// Number of Free and of Occupied cells.
    fn count(&self, py: Python<'_>) -> (usize, usize) {
        py.detach(|| self.0.count())
    }

    /// Writes it for Nav2's map_server: a `.pgm` or `.png`, and a `.yaml` beside it.
    fn save(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        py.detach(|| flockmap_io::export_occupancy(&path, &self.0)).map_err(errors::file)
    }
}

impl OccupancyGrid {
    pub(crate) fn make(
        py: Python<'_>,
        view: &flockmap::MapView,
        region: &VoxelBox,
        all_free: bool,
    ) -> PyResult<Self> {
        let rule = if all_free { ColumnRule::AllFree } else { ColumnRule::AnyFree };
        let grid = py.detach(|| flockmap_plan::OccupancyGrid::new(view, region, rule));
        grid.map(Self).map_err(errors::refused)
    }
}
