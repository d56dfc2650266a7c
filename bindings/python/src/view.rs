//! What is asked of a map.

use std::path::PathBuf;

use flockmap::{RayEnd, State, Voxel, VoxelBox};
use flockmap_io::{ExportOptions, export_map};
use numpy::{IntoPyArray, PyArray1, PyArray2};
use pyo3::prelude::*;

use crate::arrays::{Points, number_of, rows, voxels_with_states};
use crate::collision::Collision;
use crate::errors::{self, Error};
use crate::field::DistanceField;
use crate::frontiers::{Frontier, frontier_voxels, frontiers};
use crate::given::{Corners, columns, corners, region, resolution};
use crate::grid::OccupancyGrid;
use crate::heights::HeightMap;
use crate::map_view::MapView;

/// Indices and states of voxels.
type Voxels<'py> = (Bound<'py, PyArray2<i32>>, Bound<'py, PyArray1<u8>>);

/// Ends, voxels and distances of rays.
type Rays<'py> = (Bound<'py, PyArray1<u8>>, Bound<'py, PyArray2<i32>>, Bound<'py, PyArray1<f64>>);

#[pymethods]
impl MapView {
    /// A map of given voxels.
    ///
    /// indices: (N, 3) whole numbers. states: (N,) 0, 1 or 2. Of two for one voxel the later wins.
    #[staticmethod]
    #[pyo3(signature = (resolution, indices, states))]
    fn from_voxels(
        py: Python<'_>,
        resolution: f64,
        indices: &Bound<'_, PyAny>,
        states: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let side = self::resolution(resolution)?;
        let voxels = voxels_with_states(indices, states)?;
        let limit = flockmap::grid::VOXEL_LIMIT;
        let is_within =
            |v: &Voxel| [v.x, v.y, v.z].iter().all(|at| at.unsigned_abs() <= limit.unsigned_abs());
        if let Some((voxel, _)) = voxels.iter().find(|(voxel, _)| !is_within(voxel)) {
            let text =
                format!("indices: voxel {voxel:?} lies beyond the grid, which goes to ±{limit} on each axis");
            return Err(Error::new_err(text));
        }
        Ok(py.detach(|| Self::of(side, voxels.into_iter())))
    }

    /// Reads a map: an OctoMap `.bt`, a `.ply` or `.pcd` that `save` wrote, or a point cloud (`.ply`, `.pcd`, `.las`, `.laz`),
    /// of which every voxel of `resolution` metres with a point is Occupied. A map has its own resolution.
    #[staticmethod]
    #[pyo3(signature = (path, resolution=0.1))]
    fn load(py: Python<'_>, path: PathBuf, resolution: f64) -> PyResult<Self> {
        let side = self::resolution(resolution)?;
        py.detach(|| flockmap_io::read_map(&path, side).map(|map| Self::of(map.resolution, map.voxels)))
            .map_err(errors::file)
    }

    /// Side of a voxel in metres.
    #[getter]
    fn resolution(&self) -> f64 {
        self.0.resolution().metres()
    }

    /// Goes up with every change of the map.
    #[getter]
    const fn version(&self) -> u64 {
        self.0.version()
    }

    /// Number of Free and of Occupied voxels.
    fn count(&self, py: Python<'_>) -> (usize, usize) {
        py.detach(|| self.0.count())
    }

    /// The corners in metres of the smallest box that holds every known voxel; None if nothing is known.
    fn bounding_box(&self, py: Python<'_>) -> Option<Corners> {
        py.detach(|| self.0.bounding_box()).map(|bounds| corners(self.0.resolution(), &bounds))
    }

    /// States at points.
    ///
    /// xyz: (N, 3) float32 or float64, metres. Returns (N,) uint8: 0 Unknown, 1 Free, 2 Occupied. Unknown too where there
    /// are no voxels, and for what is no number.
    fn states<'py>(&self, py: Python<'py>, xyz: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray1<u8>>> {
        let points = Points::new("xyz", xyz)?;
        let numbers = py.detach(|| {
            let mut numbers = vec![0; points.len()];
            let mut found = vec![State::Unknown; 512];
            points.chunks(&mut numbers, |points, numbers| {
                let found = &mut found[..points.len()];
                // Both are as long.
                flockmap_plan::states(&self.0, points, found).unwrap_or_default();
                numbers.iter_mut().zip(found).for_each(|(number, state)| *number = number_of(*state));
            });
            numbers
        });
        Ok(numbers.into_pyarray(py))
    }

    /// Known voxels, of a box or all: indices (N, 3) int32 and states (N,) uint8, in no particular order.
    #[pyo3(signature = (r#box=None))]
    fn voxels<'py>(&self, py: Python<'py>, r#box: Option<&Bound<'py, PyAny>>) -> PyResult<Voxels<'py>> {
        let region = self.region(r#box)?;
        let (indices, states) = py.detach(|| {
            let (mut indices, mut states) = (Vec::new(), Vec::new());
            self.each(region, |voxel, state| {
                indices.push([voxel.x, voxel.y, voxel.z]);
                states.push(number_of(state));
            });
            (indices, states)
        });
        Ok((rows(py, indices)?, states.into_pyarray(py)))
    }

    /// Centres of the Occupied voxels, of a box or all: (N, 3) float64, metres.
    #[pyo3(signature = (r#box=None))]
    fn occupied_points<'py>(
        &self,
        py: Python<'py>,
        r#box: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        self.centres(py, r#box, State::Occupied)
    }

    /// Centres of the Free voxels, of a box or all: (N, 3) float64, metres.
    #[pyo3(signature = (r#box=None))]
    fn free_points<'py>(
        &self,
        py: Python<'py>,
        r#box: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        self.centres(py, r#box, State::Free)
    }

    /// Follows straight lines to the first voxel that is Occupied, or Unknown if `through_unknown` is false.
    ///
    /// a, b: (N, 3) metres, or one of them (3,) for all rays. Returns
    /// - (N,) uint8: 2 it met an Occupied voxel, 0 it met an Unknown one, 1 it reached its end,
    /// - (N, 3) int32: that voxel; 0 where it reached its end,
    /// - (N,) float64: metres from a to where it enters that voxel; infinity where it reached its end.
    #[pyo3(signature = (a, b, through_unknown=false))]
    fn cast_rays<'py>(
        &self,
        py: Python<'py>,
        a: &Bound<'py, PyAny>,
        b: &Bound<'py, PyAny>,
        through_unknown: bool,
    ) -> PyResult<Rays<'py>> {
        let ((a, _), (b, _)) = (Points::one_or_many("a", a)?, Points::one_or_many("b", b)?);
        let count = if a.len() == 1 { b.len() } else { a.len() };
        if b.len() != count && b.len() != 1 {
            let text =
                format!("a has {} points and b has {}, expected as many, or one of them", a.len(), b.len());
            return Err(Error::new_err(text));
        }
        let cast = py.detach(|| {
            let all = |points: &Points| match &points.to_f64()[..] {
                [one] => vec![*one; count],
                many => many.to_vec(),
            };
            let mut ends = vec![RayEnd::Clear; count];
            flockmap_plan::cast_rays(&self.0, &all(&a), &all(&b), through_unknown, &mut ends)?;
            let mut found = (Vec::new(), Vec::new(), Vec::new());
            for end in ends {
                let (state, voxel, metres) = match end {
                    RayEnd::Occupied { voxel, distance_m } => (2, voxel, distance_m),
                    RayEnd::Unknown { voxel, distance_m } => (0, voxel, distance_m),
                    RayEnd::Clear => (1, Voxel::default(), f64::INFINITY),
                };
                found.0.push(state);
                found.1.push([voxel.x, voxel.y, voxel.z]);
                found.2.push(metres);
            }
            Ok(found)
        });
        let (states, voxels, metres) =
            cast.map_err(|error: flockmap_plan::QuestionError| errors::refused(error))?;
        Ok((states.into_pyarray(py), rows(py, voxels)?, metres.into_pyarray(py)))
    }

    /// Blocks of 8 × 8 × 8 voxels that changed after `version` had this value: (N, 3) int32, the index of a voxel divided
    /// by 8, rounded down. None if that is not known any more: then everything may have changed.
    fn changed_since<'py>(
        &self,
        py: Python<'py>,
        version: u64,
    ) -> PyResult<Option<Bound<'py, PyArray2<i32>>>> {
        let changed = py.detach(|| self.0.changed_since(version));
        let indices = changed.map(|blocks| blocks.iter().map(|at| [at.x, at.y, at.z]).collect());
        indices.map(|indices| rows(py, indices)).transpose()
    }

    /// How far the nearest obstacle of a box is, for every voxel of it: see DistanceField.
    #[pyo3(signature = (r#box, obstacles="occupied", memory_max=256 << 20))]
    fn distance_field(
        &self,
        py: Python<'_>,
        r#box: &Bound<'_, PyAny>,
        obstacles: &str,
        memory_max: u64,
    ) -> PyResult<DistanceField> {
        DistanceField::make(py, self, r#box, obstacles, memory_max)
    }

    /// Whether bodies collide with obstacles: see Collision.
    #[pyo3(signature = (obstacles="occupied"))]
    fn collision(&self, obstacles: &str) -> PyResult<Collision> {
        Collision::make(self, obstacles)
    }

    /// The map between two heights, seen from above: see OccupancyGrid.
    ///
    /// z0, z1: metres in the frame of the map; None: as far as the map is known.
    /// area: ((x, y), (x, y)) in metres; None: as far as the map is known.
    /// all_free: a cell is Free only if all voxels of its column are; else if any is and none is Occupied.
    #[pyo3(signature = (z0=None, z1=None, area=None, all_free=false))]
    fn occupancy_grid(
        &self,
        py: Python<'_>,
        z0: Option<f64>,
        z1: Option<f64>,
        area: Option<([f64; 2], [f64; 2])>,
        all_free: bool,
    ) -> PyResult<OccupancyGrid> {
        let region = py.detach(|| columns(&self.0, z0, z1, area))?;
        OccupancyGrid::make(py, &self.0, &region, all_free)
    }

    /// The lowest and the highest obstacle of each column: see HeightMap. Arguments as for `occupancy_grid`.
    #[pyo3(signature = (z0=None, z1=None, area=None))]
    fn height_map(
        &self,
        py: Python<'_>,
        z0: Option<f64>,
        z1: Option<f64>,
        area: Option<([f64; 2], [f64; 2])>,
    ) -> PyResult<HeightMap> {
        let region = py.detach(|| columns(&self.0, z0, z1, area))?;
        HeightMap::make(py, &self.0, &region)
    }

    /// Free voxels of a box beside Unknown ones of it, in clusters that reach at most `reach` metres from their first voxel
    /// and have at least `cells_min`: see Frontier.
    #[pyo3(signature = (r#box=None, reach=1.5, cells_min=6))]
    fn frontiers(
        &self,
        py: Python<'_>,
        r#box: Option<&Bound<'_, PyAny>>,
        reach: f64,
        cells_min: usize,
    ) -> PyResult<Vec<Frontier>> {
        let region = self.region(r#box)?;
        frontiers(py, &self.0, region, reach, cells_min)
    }

    /// Free voxels of a box that share a face with an Unknown voxel of the box: indices (N, 3) int32.
    #[pyo3(signature = (r#box=None))]
    fn frontier_voxels<'py>(
        &self,
        py: Python<'py>,
        r#box: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyArray2<i32>>> {
        let region = self.region(r#box)?;
        frontier_voxels(py, &self.0, region)
    }

    /// Writes the map by the ending of the path: `.ply` or `.pcd` with the centre of each voxel in metres, or an OctoMap
    /// `.bt`. Returns the number of voxels written.
    ///
    /// free: whether `.ply` and `.pcd` hold Free voxels too, with a state for each. A `.bt` always does.
    #[pyo3(signature = (path, free=true))]
    fn save(&self, py: Python<'_>, path: PathBuf, free: bool) -> PyResult<u64> {
        let options = ExportOptions { free };
        py.detach(|| export_map(&path, self.0.resolution(), self.0.voxels(), &options)).map_err(errors::file)
    }

    fn __repr__(&self) -> String {
        format!("MapView(resolution={}, version={})", self.0.resolution().metres(), self.0.version())
    }
}

impl MapView {
    /// A map of voxels that lie within the grid.
    fn of(side: flockmap::Resolution, voxels: impl Iterator<Item = (Voxel, State)>) -> Self {
        let mut blocks = std::collections::BTreeMap::<_, flockmap::grid::StateBlock>::new();
        for (voxel, state) in voxels {
            blocks.entry(voxel.block()).or_default().set(flockmap::grid::voxel_bit(voxel), state);
        }
        let mut view = flockmap::MapView::new(side);
        for (index, block) in &blocks {
            view.set_block(*index, block);
        }
        Self(view)
    }

    fn region(&self, given: Option<&Bound<'_, PyAny>>) -> PyResult<Option<VoxelBox>> {
        given.map(|given| region(self.0.resolution(), given)).transpose()
    }

    fn each(&self, region: Option<VoxelBox>, mut take: impl FnMut(Voxel, State)) {
        match region {
            Some(region) => self.0.voxels_in(&region).for_each(|(voxel, state)| take(voxel, state)),
            None => self.0.voxels().for_each(|(voxel, state)| take(voxel, state)),
        }
    }

    fn centres<'py>(
        &self,
        py: Python<'py>,
        given: Option<&Bound<'py, PyAny>>,
        wanted: State,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let region = self.region(given)?;
        let centres = py.detach(|| {
            let (side, mut centres) = (self.0.resolution(), Vec::new());
            self.each(region, |voxel, state| {
                if state == wanted {
                    centres.push(side.centre(voxel));
                }
            });
            centres
        });
        rows(py, centres)
    }
}
