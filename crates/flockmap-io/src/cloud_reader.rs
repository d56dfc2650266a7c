//! Point clouds from files: `.pcd`, `.ply`, `.las`, `.laz`.

use std::path::Path;

use crate::cloud::{CLOUD_BYTES_MAX, CLOUD_POINTS_MAX, PointCloud};
use crate::error::{Fault, ReadError};
use crate::file::{ending, read_whole, unknown_ending};
use crate::{las, pcd, ply};

/// Reads a point cloud: `.pcd` (ascii, binary, binary_compressed), `.ply` (ascii and binary vertices),
/// `.las`, `.laz`.
///
/// A PCD's VIEWPOINT is the pose of the sensor that its points are seen from, as PCL's tools take it: the
/// points are taken through it. Memory: the file (at most [`CLOUD_BYTES_MAX`]) and 36 bytes for each point
/// (at most [`CLOUD_POINTS_MAX`]).
pub fn read_cloud(path: impl AsRef<Path>) -> Result<PointCloud, ReadError> {
    let path = path.as_ref();
    let parse: fn(&[u8]) -> Result<PointCloud, Fault> = match ending(path).as_str() {
        "pcd" => |bytes| {
            let mut parsed = pcd::parse(bytes, CLOUD_POINTS_MAX)?;
            parsed.points.iter_mut().for_each(|p| *p = parsed.viewpoint.transform(*p));
            Ok(PointCloud::from_points(&parsed.points))
        },
        "ply" => |bytes| ply::parse(bytes).map(|points| PointCloud::from_points(&points)),
        "las" | "laz" => |bytes| las::parse(bytes).map(|points| PointCloud::from_points(&points)),
        _ => return Err(unknown_ending(path, "a point cloud: .pcd, .ply, .las or .laz")),
    };
    parse(&read_whole(path, CLOUD_BYTES_MAX)?).map_err(|fault| fault.in_file(path))
}
