//! The distance field of a box.

use std::sync::{PoisonError, RwLock};

use flockmap::Voxel;
use flockmap_plan::{FieldConfig, Updated};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArray3, PyArrayMethods};
use pyo3::prelude::*;

use crate::arrays::{Points, rows, triple};
use crate::errors::{self, Error};
use crate::given::{Corners, corners, obstacles, region};
use crate::map_view::MapView;

/// Distances, and their gradients.
type Clearances<'py> = (Bound<'py, PyArray1<f64>>, Bound<'py, PyArray2<f64>>);

/// For every voxel of a box, how far the nearest obstacle of the box is: Euclidean, from centre to centre, exact. Obstacles
/// outside of the box do not count.
///
/// Several threads may ask one field; an `update` waits for them, without the GIL.
#[pyclass(frozen, module = "flockmap", name = "DistanceField")]
pub(crate) struct DistanceField {
    field: RwLock<flockmap_plan::DistanceField>,
}

#[pymethods]
impl DistanceField {
    /// The field of a box of a view.
    ///
    /// box: two corners in metres; at most 4,096 voxels from corner to corner.
    /// obstacles: "occupied" (Unknown counts as free) or "not-free" (Unknown is an obstacle).
    /// memory_max: bytes that the field may take: 6 for each voxel, 12 if it is longer than 255 voxels from corner to corner.
    #[new]
    #[pyo3(signature = (view, r#box, obstacles="occupied", memory_max=256 << 20))]
    fn new(
        py: Python<'_>,
        view: &MapView,
        r#box: &Bound<'_, PyAny>,
        obstacles: &str,
        memory_max: u64,
    ) -> PyResult<Self> {
        Self::make(py, view, r#box, obstacles, memory_max)
    }

    /// Brings the field to a newer view of the same map; only what can differ is done again. Returns "unchanged", "partly"
    /// or "anew".
    fn update(&self, py: Python<'_>, view: &MapView) -> &'static str {
        let updated =
            py.detach(|| self.field.write().unwrap_or_else(PoisonError::into_inner).update(&view.0));
        match updated {
            Updated::Unchanged => "unchanged",
            Updated::Partly => "partly",
            Updated::Anew => "anew",
        }
    }

    /// Takes another box, or another map, in the same memory.
    fn move_to(&self, py: Python<'_>, view: &MapView, r#box: &Bound<'_, PyAny>) -> PyResult<()> {
        let region = region(view.0.resolution(), r#box)?;
        py.detach(|| self.field.write().unwrap_or_else(PoisonError::into_inner).move_to(&view.0, region))
            .map_err(errors::refused)
    }

    /// Distance in metres and its gradient (3,) at a point (3,) of metres, interpolated between the centres of voxels; None
    /// outside of the box. Infinity and 0 if there is no obstacle.
    fn at(&self, py: Python<'_>, point: &Bound<'_, PyAny>) -> PyResult<Option<(f64, [f64; 3])>> {
        let point = triple("point", point)?;
        let found = self.read(py, |field| field.at(point));
        Ok(found.map(|clearance| (clearance.distance_m, clearance.gradient)))
    }

    /// Distances of all voxels of the box: (X, Y, Z) float32, metres; infinity if there is no obstacle. Element [x, y, z] is
    /// of the voxel `low` + (x, y, z).
    fn distances<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        let (size, numbers) = self.read(py, |field| {
            let (region, side) = (field.region(), field.resolution().metres());
            let size = region.size().map(|n| n as usize);
            let mut numbers = Vec::with_capacity(size.iter().product());
            let (low, high) = (region.min(), region.max());
            for x in low.x..=high.x {
                for y in low.y..=high.y {
                    numbers.extend((low.z..=high.z).map(|z| {
                        let squared = field.squared_voxels(Voxel::new(x, y, z));
                        squared.map_or(f32::INFINITY, |squared| (f64::from(squared).sqrt() * side) as f32)
                    }));
                }
            }
            (size, numbers)
        });
        numbers.into_pyarray(py).reshape(size)
    }

    /// `at` for many points (N, 3): distances (N,) float64 and gradients (N, 3) float64; NaN outside of the box.
    fn clearances<'py>(&self, py: Python<'py>, points: &Bound<'py, PyAny>) -> PyResult<Clearances<'py>> {
        let points = Points::new("points", points)?;
        let (distances, gradients) = self.read(py, |field| {
            let mut both = vec![(0.0, [0.0; 3]); points.len()];
            points.chunks(&mut both, |points, both| {
                let mut found = ([0.0; 512], [[0.0; 3]; 512]);
                field.clearances(points, &mut found.0, &mut found.1);
                both.iter_mut().zip(found.0).zip(found.1).for_each(|((both, d), g)| *both = (d, g));
            });
            both.into_iter().unzip::<_, _, Vec<f64>, Vec<[f64; 3]>>()
        });
        Ok((distances.into_pyarray(py), rows(py, gradients)?))
    }

    /// Whether the spheres of `radius` metres about points (N, 3) surely keep clear of every obstacle, taken as full cubes:
    /// (N,) bool. Some that just pass are false. False outside of the box.
    fn are_clear<'py>(
        &self,
        py: Python<'py>,
        points: &Bound<'py, PyAny>,
        radius: f64,
    ) -> PyResult<Bound<'py, PyArray1<bool>>> {
        let points = Points::new("points", points)?;
        if !(radius >= 0.0 && radius.is_finite()) {
            return Err(Error::new_err(format!("radius is {radius}, expected 0 or more metres")));
        }
        let clear = self.read(py, |field| {
            let mut clear = vec![false; points.len()];
            points.chunks(&mut clear, |points, clear| field.are_clear(points, radius, clear));
            clear
        });
        Ok(clear.into_pyarray(py))
    }

    /// The corners of the box in metres.
    #[getter]
    fn r#box(&self, py: Python<'_>) -> Corners {
        self.read(py, |field| corners(field.resolution(), &field.region()))
    }

    /// Index of the lowest voxel of the box.
    #[getter]
    fn low(&self, py: Python<'_>) -> [i32; 3] {
        let low = self.read(py, |field| field.region().min());
        [low.x, low.y, low.z]
    }

    /// Side of a voxel in metres.
    #[getter]
    fn resolution(&self, py: Python<'_>) -> f64 {
        self.read(py, |field| field.resolution().metres())
    }

    /// Version of the view that the field is of.
    #[getter]
    fn version(&self, py: Python<'_>) -> u64 {
        self.read(py, flockmap_plan::DistanceField::version)
    }
}

impl DistanceField {
    pub(crate) fn make(
        py: Python<'_>,
        view: &MapView,
        given: &Bound<'_, PyAny>,
        name: &str,
        memory_max: u64,
    ) -> PyResult<Self> {
        let region = region(view.0.resolution(), given)?;
        let config = FieldConfig { obstacles: obstacles(name)?, memory_max };
        let field = py.detach(|| flockmap_plan::DistanceField::new(&view.0, region, &config));
        Ok(Self { field: RwLock::new(field.map_err(errors::refused)?) })
    }

    fn read<R: Send>(
        &self,
        py: Python<'_>,
        ask: impl FnOnce(&flockmap_plan::DistanceField) -> R + Send,
    ) -> R {
        py.detach(|| ask(&self.field.read().unwrap_or_else(PoisonError::into_inner)))
    }
}
