//! Maps as messages: grids of two dimensions, and OctoMaps.

use serde::{Deserialize, Serialize};

use super::geometry::Pose;
use super::parts;
use super::time::{Header, Time};

/// `nav_msgs/msg/MapMetaData`.
#[derive(Serialize, Deserialize, Clone, Copy, PartialEq, Debug, Default)]
pub struct MapMetaData {
    /// When the map was loaded.
    pub map_load_time: Time,
    /// Side of a cell in metres.
    pub resolution: f32,
    /// Cells along x.
    pub width: u32,
    /// Cells along y.
    pub height: u32,
    /// Pose of the outer corner of the first cell in the frame of the map.
    pub origin: Pose,
}

/// `nav_msgs/msg/OccupancyGrid`.
#[derive(Serialize, Deserialize, Clone, PartialEq, Debug, Default)]
pub struct OccupancyGrid {
    /// Stamp and frame of the map.
    pub header: Header,
    /// Size and place.
    pub info: MapMetaData,
    /// The cells row by row, x first: 0 (free) to 100 (occupied), −1 where unknown.
    #[serde(with = "parts::signed")]
    pub data: Vec<i8>,
}

/// `map_msgs/msg/OccupancyGridUpdate`: a rectangle of an [`OccupancyGrid`] anew.
#[derive(Serialize, Deserialize, Clone, PartialEq, Debug, Default)]
pub struct OccupancyGridUpdate {
    /// Stamp and frame of the map.
    pub header: Header,
    /// First column, in cells.
    pub x: i32,
    /// First row, in cells.
    pub y: i32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Its cells row by row, as in the grid.
    #[serde(with = "parts::signed")]
    pub data: Vec<i8>,
}

/// `octomap_msgs/msg/Octomap`.
#[derive(Serialize, Deserialize, Clone, PartialEq, Debug, Default)]
pub struct Octomap {
    /// Stamp and frame of the map.
    pub header: Header,
    /// Whether nodes are only free or occupied (the format of `.bt` without its header).
    #[serde(with = "parts::flag")]
    pub binary: bool,
    /// Class of the tree, for example `OcTree`.
    #[serde(with = "parts::text")]
    pub id: String,
    /// Side of the smallest nodes in metres.
    pub resolution: f64,
    /// The nodes.
    #[serde(with = "parts::signed")]
    pub data: Vec<i8>,
}
