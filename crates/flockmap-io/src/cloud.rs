//! Point clouds from files: `.pcd`, `.ply`, `.las`, `.laz`.

use std::path::Path;

use crate::error::{Fault, Place, ReadError, read_whole};
use crate::{las, pcd, ply};

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
    /// Whole metres taken off the coordinates of the file. Zero unless a coordinate is more than 10 km from zero, as in
    /// surveyed clouds; then the lowest corner of the cloud, rounded down.
    pub origin: [f64; 3],
    /// Points left out because a coordinate was not a finite number.
    pub dropped: u64,
}

impl PointCloud {
    /// Takes a common origin off points where they are far out.
    pub fn from_points(points: &[[f64; 3]]) -> Self {
        let finite = |p: &&[f64; 3]| p.iter().all(|v| v.is_finite() && v.abs() < 1e15);
        let far = points.iter().filter(finite).flatten().any(|v| v.abs() > ORIGIN_BEYOND_M);
        let mut origin = [0.0; 3];
        if far {
            let lowest = |axis: usize| {
                points.iter().filter(finite).filter_map(|p| p.get(axis)).fold(f64::INFINITY, |a, &b| a.min(b))
            };
            origin = core::array::from_fn(|axis| lowest(axis).floor());
        }
        let mut taken = Vec::with_capacity(points.len());
        for p in points.iter().filter(finite) {
            taken.push(core::array::from_fn(|axis| (p[axis] - origin[axis]) as f32));
        }
        let dropped = (points.len() - taken.len()) as u64;
        Self { points: taken, origin, dropped }
    }

    /// Lowest and highest corner of the cloud in the coordinates of the file. `None` if it is empty.
    pub fn bounds(&self) -> Option<[[f64; 3]; 2]> {
        let mut bounds = [[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]];
        for p in &self.points {
            for axis in 0..3 {
                bounds[0][axis] = bounds[0][axis].min(p[axis]);
                bounds[1][axis] = bounds[1][axis].max(p[axis]);
            }
        }
        let [low, high] = bounds;
        let place = |p: [f32; 3]| core::array::from_fn(|axis| self.origin[axis] + f64::from(p[axis]));
        (!self.points.is_empty()).then(|| [place(low), place(high)])
    }
}

/// Reads a point cloud: `.pcd` (ascii, binary, binary_compressed), `.ply` (ascii and binary vertices), `.las`, `.laz`.
///
/// A PCD's VIEWPOINT is the pose of the sensor that its points are seen from, as PCL's tools take it: the points are
/// taken through it. Memory: the file (at most [`CLOUD_BYTES_MAX`]) and 36 bytes for each point (at most
/// [`CLOUD_POINTS_MAX`]).
pub fn read_cloud(path: impl AsRef<Path>) -> Result<PointCloud, ReadError> {
    let path = path.as_ref();
    let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
    let parse: fn(&[u8]) -> Result<PointCloud, Fault> = match extension.as_deref() {
        Some("pcd") => |bytes| {
            let parsed = pcd::parse(bytes, CLOUD_POINTS_MAX)?;
            let points: Vec<[f64; 3]> =
                parsed.points.iter().map(|p| parsed.viewpoint.transform(*p)).collect();
            let cloud = PointCloud::from_points(&points);
            Ok(PointCloud { dropped: cloud.dropped + parsed.dropped, ..cloud })
        },
        Some("ply") => |bytes| ply::parse(bytes).map(|points| PointCloud::from_points(&points)),
        Some("las" | "laz") => |bytes| las::parse(bytes).map(|points| PointCloud::from_points(&points)),
        _ => {
            let expected = "a point cloud: .pcd, .ply, .las or .laz";
            return Err(Fault::foreign(Place::Whole, expected, "a file with another ending").in_file(path));
        }
    };
    parse(&read_whole(path, CLOUD_BYTES_MAX)?).map_err(|fault| fault.in_file(path))
}
