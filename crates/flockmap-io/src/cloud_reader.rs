//! Point clouds from files: `.pcd`, `.ply`, `.las`, `.laz`.

use std::path::Path;

use flockmap_grid::Pose;

use crate::cloud::{CLOUD_BYTES_MAX, CLOUD_POINTS_MAX, PointCloud, StoredPoints};
use crate::error::{Fault, ReadError};
use crate::file::{ending, read_whole, unknown_ending};
use crate::{las, pcd, ply};

/// Reads a point cloud: `.pcd` (ascii, binary, binary_compressed), `.ply` (ascii and binary vertices),
/// `.las`, `.laz`.
///
/// A PCD's VIEWPOINT is the pose of the sensor that its points are seen from, as PCL's tools take it: the
/// points are taken through it. A number `state` of each point (`.ply`, `.pcd`) tells free space (0) from
/// what is solid (1), as [`export_map`](crate::export_map) writes it. Memory: the file (at most
/// [`CLOUD_BYTES_MAX`]) and 36 bytes for each point (at most [`CLOUD_POINTS_MAX`]).
pub fn read_cloud(path: impl AsRef<Path>) -> Result<PointCloud, ReadError> {
    read_points(path.as_ref()).map(PointCloud::from)
}

/// The points of a cloud as its file has them, taken through the viewpoint.
pub(crate) fn read_points(path: &Path) -> Result<StoredPoints, ReadError> {
    let parse: fn(&[u8]) -> Result<StoredPoints, Fault> = match ending(path).as_str() {
        "pcd" => |bytes| {
            let pcd::Parsed { mut points, viewpoint, .. } = pcd::parse(bytes, CLOUD_POINTS_MAX)?;
            if viewpoint != Pose::IDENTITY {
                points.solid.iter_mut().chain(&mut points.free).for_each(|p| *p = viewpoint.transform(*p));
            }
            Ok(points)
        },
        "ply" => ply::parse,
        "las" | "laz" => |bytes| Ok(StoredPoints { solid: las::parse(bytes)?, ..StoredPoints::default() }),
        _ => return Err(unknown_ending(path, "a point cloud: .pcd, .ply, .las or .laz")),
    };
    parse(&read_whole(path, CLOUD_BYTES_MAX)?).map_err(|fault| fault.in_file(path))
}
