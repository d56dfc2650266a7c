//! Occupancy maps from files: OctoMaps, exported maps, and what a point cloud makes of itself.

use std::path::Path;

use flockmap_grid::{Changes, Resolution, State, Voxel};

use crate::cloud::{PointCloud, StoredPoints, is_finite};
use crate::cloud_reader::read_points;
use crate::error::{Fault, Place, ReadError};
use crate::file::ending;
use crate::octomap::OctoMap;

/// How far a point may lie from the centre of its voxel, in parts of the voxel's side: an `f32` is off by at
/// most 1/16.
const OFF_CENTRE_MAX: f64 = 0.125;

/// An occupancy map as read from a file.
pub struct MapFile {
    /// Side of a voxel: the file's own if it has one, else the one that was asked for.
    pub resolution: Resolution,
    /// Taken off the coordinates of the file, in metres: of a cloud that lies far out
    /// ([`PointCloud::origin`]). Zero for a map.
    pub origin: [f64; 3],
    /// Whether the file tells Free from Unknown. Without, there are only Occupied voxels.
    pub tells_free: bool,
    /// The known voxels, each once.
    pub voxels: Box<dyn Iterator<Item = (Voxel, State)>>,
}

/// Reads a map by the ending of the path: an OctoMap `.bt`, a map that
/// [`export_map`](crate::export_map) wrote to `.ply` or `.pcd`, or a point cloud (`.ply`, `.pcd`, `.las`,
/// `.laz`), of which every voxel of `resolution` with a point is Occupied.
///
/// A map has its own resolution. A point with a `state` is the centre of a voxel, so one that is none in the
/// grid that is read is an error: the file had voxels of another size. Memory: that of [`read_cloud`] or
/// [`OctoMap::read`], and a block of 8³ voxels wherever there is a point.
///
/// [`read_cloud`]: crate::read_cloud
pub fn read_map(path: impl AsRef<Path>, resolution: Resolution) -> Result<MapFile, ReadError> {
    let path = path.as_ref();
    if ending(path) == "bt" {
        let map = OctoMap::read(path)?;
        return Ok(MapFile {
            resolution: map.resolution(),
            origin: [0.0; 3],
            tells_free: true,
            voxels: Box::new(map.into_voxels()),
        });
    }
    let stored = read_points(path)?;
    let tells_free = stored.has_states;
    let resolution = stored.voxels.unwrap_or(resolution);
    let (origin, voxels) = if stored.voxels.is_some() || tells_free {
        ([0.0; 3], centres(&stored, resolution))
    } else {
        let cloud = PointCloud::from(stored);
        (cloud.origin, occupied(&cloud, resolution))
    };
    let changes = Changes::from_voxels(voxels.map_err(|fault| fault.in_file(path))?);
    Ok(MapFile { resolution, origin, tells_free, voxels: Box::new(changes.into_voxels()) })
}

/// The voxels whose centres are in a file. Where two entries speak of one voxel, Occupied counts.
fn centres(stored: &StoredPoints, resolution: Resolution) -> Result<Vec<(Voxel, State)>, Fault> {
    let free = stored.free.iter().map(|point| (point, State::Free));
    let solid = stored.solid.iter().map(|point| (point, State::Occupied));
    let voxel = |(point, state): (&[f64; 3], State)| {
        let voxel = resolution.voxel_at(*point).filter(|_| is_finite(point));
        let is_centre = |voxel: &Voxel| {
            let off = resolution.centre(*voxel).into_iter().zip(point).map(|(a, b)| (a - b).abs());
            off.fold(0.0, f64::max) <= OFF_CENTRE_MAX * resolution.metres()
        };
        let voxel = voxel.filter(is_centre).ok_or_else(|| {
            let expected = format!("the centre of a voxel of {} m, which a map has", resolution.metres());
            Fault::foreign(Place::Whole, expected, format!("a point at {point:?} m"))
        })?;
        Ok((voxel, state))
    };
    free.chain(solid).map(voxel).collect()
}

/// The voxels with a point in them.
fn occupied(cloud: &PointCloud, resolution: Resolution) -> Result<Vec<(Voxel, State)>, Fault> {
    let voxel = |point: &[f32; 3]| {
        let voxel = resolution.voxel_at(point.map(f64::from)).ok_or_else(|| {
            let expected = format!("points within the grid of voxels of {} m", resolution.metres());
            Fault::foreign(Place::Whole, expected, format!("a point at {point:?} m"))
        })?;
        Ok((voxel, State::Occupied))
    };
    cloud.points.iter().map(voxel).collect()
}
