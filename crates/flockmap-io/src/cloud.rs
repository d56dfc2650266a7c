//! Point clouds, and how large they may be.

use glam::{DVec3, Vec3};

/// Largest cloud file that is read.
pub const CLOUD_BYTES_MAX: u64 = 4 << 30;
/// Most points in a cloud.
pub const CLOUD_POINTS_MAX: u64 = 200_000_000;
/// Coordinates beyond this are too coarse as `f32` (1 mm at 10 km): an origin is taken off them.
const ORIGIN_BEYOND_M: f64 = 10_000.0;

/// Points in metres. The place of a point is `origin + point`.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct PointCloud {
    /// The points, seen from `origin`.
    pub points: Vec<[f32; 3]>,
    /// Whole metres taken off the coordinates of the file. Zero unless a coordinate is more than 10 km from
    /// zero, as in surveyed clouds; then the lowest corner of the cloud, rounded down.
    pub origin: [f64; 3],
    /// Points left out because a coordinate was not a finite number.
    pub dropped: u64,
}

impl PointCloud {
    /// Takes a common origin off points where they are far out.
    pub fn from_points(points: &[[f64; 3]]) -> Self {
        let finite = |p: &&[f64; 3]| p.iter().all(|v| v.is_finite() && v.abs() < 1e15);
        let far = points.iter().filter(finite).flatten().any(|v| v.abs() > ORIGIN_BEYOND_M);
        let lowest =
            |axis: usize| points.iter().filter(finite).map(|p| p[axis]).fold(f64::INFINITY, f64::min);
        let origin = if far { core::array::from_fn(|axis| lowest(axis).floor()) } else { [0.0; 3] };
        let mut taken = Vec::with_capacity(points.len());
        let seen_from_origin = |p: &[f64; 3]| core::array::from_fn(|axis| (p[axis] - origin[axis]) as f32);
        taken.extend(points.iter().filter(finite).map(seen_from_origin));
        let dropped = (points.len() - taken.len()) as u64;
        Self { points: taken, origin, dropped }
    }

    /// Lowest and highest corner of the cloud in the coordinates of the file. `None` if it is empty.
    pub fn bounds(&self) -> Option<[[f64; 3]; 2]> {
        let points = || self.points.iter().map(|p| Vec3::from_array(*p));
        let (low, high) = (points().reduce(Vec3::min)?, points().reduce(Vec3::max)?);
        let place = |p: Vec3| (DVec3::from_array(self.origin) + p.as_dvec3()).to_array();
        Some([place(low), place(high)])
    }
}
