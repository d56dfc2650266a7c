//! Worlds from files.

use super::{World, WorldError};
use flockmap_grid::{Resolution, VoxelBox};
use flockmap_io::{OctoMap, ReadError, read_map};
use std::path::{Path, PathBuf};
use thiserror::Error;

/// Why a file gives no world.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum OpenError {
    /// The name has no known ending.
    #[error("{}: a world is an OctoMap (.bt) or a point cloud (.pcd, .ply, .las, .laz)", path.display())]
    Unknown {
        /// The file.
        path: PathBuf,
    },
    /// The file cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// What the file holds makes no world.
    #[error("{}: {reason}", path.display())]
    World {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: WorldError,
    },
}

impl World {
    /// A world from an OctoMap (`.bt`: Occupied leaves are solid, Free leaves are where one may fly) or a
    /// point cloud (`.pcd`, `.ply`, `.las`, `.laz`: every cell with a point is solid).
    ///
    /// `resolution` is the side of the cells made from a cloud; by default 0.1 m, and 0.2 m for LAS and LAZ,
    /// which come from surveys. An OctoMap keeps its own cells, and so does a map in a `.pcd` or `.ply` that
    /// [`flockmap_io::export_map`] wrote; its free voxels are where one may fly. A cloud in coordinates of a
    /// map projection is moved to its lowest corner ([`flockmap_io::PointCloud::origin`]).
    pub fn open(path: impl AsRef<Path>, resolution: Option<Resolution>) -> Result<Self, OpenError> {
        let path = path.as_ref();
        let failed = |reason| OpenError::World { path: path.to_owned(), reason };
        let ending = path.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
        let default = match ending.as_str() {
            "bt" => {
                let map = OctoMap::read(path)?;
                let boxes = map.cubes().iter().filter_map(|cube| {
                    let region = VoxelBox::new(cube.corner, [cube.side; 3])?;
                    Some((region, cube.state))
                });
                return Self::from_states(boxes, map.resolution()).map_err(failed);
            }
            "pcd" | "ply" => Resolution::from_micrometres(100_000),
            "las" | "laz" => Resolution::from_micrometres(200_000),
            _ => return Err(OpenError::Unknown { path: path.to_owned() }),
        };
        let resolution = resolution.or(default).expect("10 and 20 cm are resolutions");
        let map = read_map(path, resolution)?;
        let side = map.resolution;
        if map.tells_free {
            let cells = map.voxels.filter_map(|(voxel, state)| Some((VoxelBox::new(voxel, [1; 3])?, state)));
            return Self::from_states(cells, side).map_err(failed);
        }
        Self::from_points(map.voxels.map(|(voxel, _)| side.centre(voxel)), side).map_err(failed)
    }
}
