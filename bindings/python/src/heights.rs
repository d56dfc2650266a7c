//! How high what stands in each column of the map is.

use std::path::PathBuf;

use flockmap::{Resolution, VoxelBox};
use numpy::{IntoPyArray, PyArray2, PyArrayMethods};
use pyo3::prelude::*;

use crate::errors;
use crate::given::corners;

/// The lowest and the highest Occupied voxel of each column of a box. Row y, column x, from the lowest on.
#[pyclass(frozen, module = "flockmap", name = "HeightMap")]
pub(crate) struct HeightMap(flockmap_plan::HeightMap);

#[pymethods]
impl HeightMap {
    /// (H, W) float32: metres of the lower face of the lowest Occupied voxel, NaN where there is none.
    fn bottoms<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        py.detach(|| self.0.bottoms_m()).into_pyarray(py).reshape(self.shape())
    }

    /// (H, W) float32: metres of the upper face of the highest Occupied voxel, NaN where there is none.
    fn tops<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        py.detach(|| self.0.tops_m()).into_pyarray(py).reshape(self.shape())
    }

    /// (H, W) bool: whether a voxel of the column is known.
    fn known<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<bool>>> {
        let [height, width] = self.shape();
        let known: Vec<bool> = py.detach(|| {
            (0..height)
                .flat_map(|y| (0..width).map(move |x| (x, y)))
                .map(|(x, y)| self.0.is_known(x, y))
                .collect()
        });
        known.into_pyarray(py).reshape(self.shape())
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
        let ([x, y, _], _) = corners(self.side(), self.0.region());
        [x, y]
    }

    /// Side of a cell in metres.
    #[getter]
    fn resolution(&self) -> f64 {
        self.side().metres()
    }

    /// Writes it as a grey `.png` of 16 bits, in millimetres above the lower face of the box; 0: nothing there.
    fn save(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        py.detach(|| flockmap_io::export_heights(&path, &self.0)).map_err(errors::file)
    }
}

impl HeightMap {
    pub(crate) fn make(py: Python<'_>, view: &flockmap::MapView, region: &VoxelBox) -> PyResult<Self> {
        let heights = py.detach(|| flockmap_plan::HeightMap::new(view, region));
        heights.map(Self).map_err(errors::refused)
    }

    const fn side(&self) -> Resolution {
        self.0.resolution()
    }
}
