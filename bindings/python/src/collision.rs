//! Whether bodies collide with the voxels of a map.

use flockmap_plan::Obstacles;
use numpy::{IntoPyArray, PyArray1};
use pyo3::prelude::*;

use crate::arrays::{Points, triple};
use crate::errors;
use crate::given::{obstacles, pose};
use crate::map_view::MapView;

/// Whether bodies collide with the obstacles of a view, as full cubes; exact. Touching counts. Metres, in the frame of the
/// map. A question that would look at more than 2²⁰ blocks of 8³ voxels is refused.
#[pyclass(frozen, module = "flockmap", name = "Collision")]
pub(crate) struct Collision {
    view: flockmap::MapView,
    obstacles: Obstacles,
}

#[pymethods]
impl Collision {
    /// For the obstacles of a view: "occupied" (Unknown counts as free) or "not-free" (Unknown is an obstacle).
    #[new]
    #[pyo3(signature = (view, obstacles="occupied"))]
    fn new(view: &MapView, obstacles: &str) -> PyResult<Self> {
        Self::make(view, obstacles)
    }

    /// The index of an obstacle that a sphere meets, or None. centre: (3,), radius: metres.
    fn sphere(&self, py: Python<'_>, centre: &Bound<'_, PyAny>, radius: f64) -> PyResult<Option<[i32; 3]>> {
        let centre = triple("centre", centre)?;
        self.ask(py, |collision| collision.sphere(centre, radius)).map(|voxel| voxel.map(index))
    }

    /// Whether each of many spheres meets an obstacle: (N,) bool. centres: (N, 3).
    fn spheres<'py>(
        &self,
        py: Python<'py>,
        centres: &Bound<'py, PyAny>,
        radius: f64,
    ) -> PyResult<Bound<'py, PyArray1<bool>>> {
        let centres = Points::new("centres", centres)?;
        let collides = self.ask(py, |collision| {
            let (mut collides, mut result) = (vec![false; centres.len()], Ok(()));
            centres.chunks(&mut collides, |centres, collides| {
                if result.is_ok() {
                    result = collision.spheres(centres, radius, collides);
                }
            });
            result.map(|()| collides)
        })?;
        Ok(collides.into_pyarray(py))
    }

    /// The index of an obstacle that an axis-aligned box meets, or None. low, high: (3,).
    fn aligned_box(
        &self,
        py: Python<'_>,
        low: &Bound<'_, PyAny>,
        high: &Bound<'_, PyAny>,
    ) -> PyResult<Option<[i32; 3]>> {
        let (low, high) = (triple("low", low)?, triple("high", high)?);
        self.ask(py, |collision| collision.aligned_box(low, high)).map(|voxel| voxel.map(index))
    }

    /// The index of an obstacle that a turned box meets, or None. T_map_body: (4, 4), the pose of its centre; half: (3,) metres
    /// from the centre to its faces along its own axes.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    fn oriented_box(
        &self,
        py: Python<'_>,
        T_map_body: &Bound<'_, PyAny>,
        half: &Bound<'_, PyAny>,
    ) -> PyResult<Option<[i32; 3]>> {
        let (pose, half) = (pose("T_map_body", T_map_body)?, triple("half", half)?);
        self.ask(py, |collision| collision.oriented_box(&pose, half)).map(|voxel| voxel.map(index))
    }

    /// What a sphere meets first on the straight way from `a` to `b`: the index of the obstacle, and metres gone by then; or
    /// None.
    fn swept_sphere(
        &self,
        py: Python<'_>,
        a: &Bound<'_, PyAny>,
        b: &Bound<'_, PyAny>,
        radius: f64,
    ) -> PyResult<Option<([i32; 3], f64)>> {
        let (a, b) = (triple("a", a)?, triple("b", b)?);
        let hit = self.ask(py, |collision| collision.swept_sphere(a, b, radius))?;
        Ok(hit.map(|hit| (index(hit.voxel), hit.along_m)))
    }

    /// What a sphere meets first on the way along points (N, 3): on which part (0 is from the first point to the second), the
    /// index of the obstacle, and metres gone from the beginning; or None.
    fn path(
        &self,
        py: Python<'_>,
        points: &Bound<'_, PyAny>,
        radius: f64,
    ) -> PyResult<Option<(usize, [i32; 3], f64)>> {
        let points = Points::new("points", points)?;
        let hit = self.ask(py, |collision| collision.path(&points.to_f64(), radius))?;
        Ok(hit.map(|(part, hit)| (part, index(hit.voxel), hit.along_m)))
    }
}

impl Collision {
    pub(crate) fn make(view: &MapView, name: &str) -> PyResult<Self> {
        Ok(Self { view: view.0.clone(), obstacles: obstacles(name)? })
    }

    fn ask<R: Send>(
        &self,
        py: Python<'_>,
        ask: impl FnOnce(&flockmap_plan::Collision<'_>) -> Result<R, flockmap_plan::QuestionError> + Send,
    ) -> PyResult<R> {
        let asked = py.detach(|| ask(&flockmap_plan::Collision::new(&self.view, self.obstacles)));
        asked.map_err(errors::refused)
    }
}

const fn index(voxel: flockmap::Voxel) -> [i32; 3] {
    [voxel.x, voxel.y, voxel.z]
}
