//! What calls are given beside arrays: stamps, poses, boxes, names.

use flockmap::{MapView, Pose, Resolution, Stamp, SubmapId, VoxelBox};
use flockmap_plan::{Obstacles, box_between};
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyFloat};

use crate::arrays::{matrix, triple};
use crate::errors::{self, Error, PoseError};

/// Seconds beyond which a stamp in microseconds is none.
const SECONDS_MAX: f64 = 9e12;

/// A point in time: seconds as a float, or nanoseconds as an int.
pub(crate) struct Time(pub(crate) Stamp);

impl FromPyObject<'_, '_> for Time {
    type Error = PyErr;

    fn extract(given: Borrowed<'_, '_, PyAny>) -> PyResult<Self> {
        let wrong = || {
            let expected = "expected seconds as a float or nanoseconds as an int";
            Error::new_err(format!("a stamp of {}, {expected}", given.as_any()))
        };
        if given.is_instance_of::<PyBool>() {
            return Err(wrong());
        }
        if let Ok(seconds) = given.cast::<PyFloat>() {
            let seconds = seconds.extract::<f64>()?;
            let is_time = seconds.abs() <= SECONDS_MAX;
            return is_time.then(|| Self(Stamp::from_seconds(seconds))).ok_or_else(wrong);
        }
        let nanoseconds = given.extract::<i64>().map_err(|_| wrong())?;
        Ok(Self(Stamp(nanoseconds.div_euclid(1_000))))
    }
}

/// The number of a submap.
pub(crate) fn submap(number: u16) -> PyResult<SubmapId> {
    let most = SubmapId::COUNT - 1;
    SubmapId::new(number).ok_or_else(|| errors::pose(format!("submap is {number}, expected 0 to {most}")))
}

/// A pose: (4, 4) numbers, the upper left (3, 3) a rotation, the last row 0 0 0 1.
pub(crate) fn pose(what: &str, given: &Bound<'_, PyAny>) -> PyResult<Pose> {
    let [x, y, z, last] = matrix::<4>(what, given)?;
    let numbers = [x, y, z, last];
    if !numbers.iter().flatten().all(|number| number.is_finite()) {
        return Err(PoseError::new_err(format!(
            "{what} has a number that is not finite: give no pose while the localisation has none, and look at where it \
             was computed"
        )));
    }
    if last.iter().zip([0.0, 0.0, 0.0, 1.0]).any(|(a, b)| (a - b).abs() > 1e-6) {
        return Err(PoseError::new_err(format!(
            "{what} has the last row {last:?}, expected 0 0 0 1: translations stand in the last column"
        )));
    }
    let rows = [x, y, z].concat();
    let rows: [f64; 12] = core::array::from_fn(|at| rows[at]);
    Pose::from_rows(rows).ok_or_else(|| {
        PoseError::new_err(format!(
            "{what} is no rotation in its upper left (3, 3) part, expected columns of length 1 at right angles within 1 % \
             and no mirroring"
        ))
    })
}

/// A pose as (4, 4) rows.
pub(crate) fn pose_rows(pose: &Pose) -> [[f64; 4]; 4] {
    let ([x, y, z], [tx, ty, tz]) = (pose.rotation_rows(), pose.translation());
    let row = |[a, b, c]: [f64; 3], t: f64| [a, b, c, t];
    [row(x, tx), row(y, ty), row(z, tz), [0.0, 0.0, 0.0, 1.0]]
}

/// Side of a voxel in metres.
pub(crate) fn resolution(metres: f64) -> PyResult<Resolution> {
    Resolution::try_from(metres).map_err(|error| errors::config(format!("resolution is {metres}, {error}")))
}

/// A box between two corners in metres.
pub(crate) fn region(side: Resolution, given: &Bound<'_, PyAny>) -> PyResult<VoxelBox> {
    let expected =
        "expected two corners in metres, ((x, y, z), (x, y, z)), the first below the second on each axis";
    // An array of shape (2, 3) is one too.
    let corner = |at: usize| given.get_item(at);
    let corners =
        given.len().is_ok_and(|len| len == 2).then(|| Ok((corner(0)?, corner(1)?))).and_then(PyResult::ok);
    let (low, high) = corners.ok_or_else(|| Error::new_err(format!("box: not a pair, {expected}")))?;
    let (low, high) = (triple("box", &low)?, triple("box", &high)?);
    box_between(side, low, high)
        .ok_or_else(|| Error::new_err(format!("box: from {low:?} to {high:?}, {expected}, within the grid")))
}

/// Two corners in metres.
pub(crate) type Corners = ([f64; 3], [f64; 3]);

/// The lower and the upper corner of a box in metres.
pub(crate) fn corners(side: Resolution, region: &VoxelBox) -> Corners {
    let metres = |index: i32| (i64::from(index) * i64::from(side.micrometres())) as f64 / 1e6;
    let (low, high) = (region.min(), region.max());
    ([low.x, low.y, low.z].map(metres), [high.x, high.y, high.z].map(|index| metres(index + 1)))
}

/// The columns of an area between two heights. What is not given is as far as the map is known.
pub(crate) fn columns(
    view: &MapView,
    z0: Option<f64>,
    z1: Option<f64>,
    area: Option<([f64; 2], [f64; 2])>,
) -> PyResult<VoxelBox> {
    let side = view.resolution();
    let bounds = match (z0, z1, area) {
        (Some(_), Some(_), Some(_)) => ([0.0; 3], [0.0; 3]),
        _ => {
            let bounds = view.bounding_box().ok_or_else(|| {
                Error::new_err("nothing of the map is known: give z0, z1 and area, or wait for a scan")
            })?;
            corners(side, &bounds)
        }
    };
    let (low, high) = area.unwrap_or(([bounds.0[0], bounds.0[1]], [bounds.1[0], bounds.1[1]]));
    let (z0, z1) = (z0.unwrap_or(bounds.0[2]), z1.unwrap_or(bounds.1[2]));
    let (low, high) = ([low[0], low[1], z0], [high[0], high[1], z1]);
    box_between(side, low, high).ok_or_else(|| {
        Error::new_err(format!(
            "box: from {low:?} to {high:?}, expected finite metres, z0 below z1 and the first corner of the area below the \
             second, within the grid"
        ))
    })
}

/// Which voxels are obstacles.
pub(crate) fn obstacles(name: &str) -> PyResult<Obstacles> {
    match name {
        "occupied" => Ok(Obstacles::Occupied),
        "not-free" => Ok(Obstacles::NotFree),
        other => Err(Error::new_err(format!(
            "obstacles is \"{other}\", expected \"occupied\" or \"not-free\" (Unknown too)"
        ))),
    }
}

/// How a name of the configuration file is read.
pub(crate) fn named<T: serde::de::DeserializeOwned>(what: &str, name: &str) -> PyResult<T> {
    serde_json::from_value(serde_json::Value::from(name))
        .map_err(|error| errors::config(format!("{what} is \"{name}\": {error}")))
}
