//! Point clouds as messages.

use serde::{Deserialize, Serialize};

use super::parts;
use super::time::Header;

/// `sensor_msgs/msg/PointField`: a number of each point.
#[derive(Serialize, Deserialize, Clone, PartialEq, Eq, Debug, Default)]
pub struct PointField {
    /// Its name, for example `x`.
    #[serde(with = "parts::text")]
    pub name: String,
    /// Bytes from the start of a point.
    pub offset: u32,
    /// Type of the number, [`Self::FLOAT32`] for example.
    pub datatype: u8,
    /// How many of the numbers lie there.
    pub count: u32,
}

impl PointField {
    /// A number of type `f32`.
    pub const FLOAT32: u8 = 7;
    /// A number of type `f64`.
    pub const FLOAT64: u8 = 8;
}

/// `sensor_msgs/msg/PointCloud2`. Its bytes are those of the message (`PointCloud2<&[u8]>`) or its own
/// (`PointCloud2<Bytes>`). [`points_of`](super::points_of) reads them.
#[derive(Serialize, Deserialize, Clone, PartialEq, Eq, Debug, Default)]
#[serde(bound(serialize = "D: AsRef<[u8]>", deserialize = "D: Deserialize<'de>"))]
pub struct PointCloud2<D> {
    /// Stamp and frame of the points.
    pub header: Header,
    /// Rows; 1 if the points lie in no order.
    pub height: u32,
    /// Points of a row.
    pub width: u32,
    /// What a point consists of; at most 1,024 are read.
    #[serde(deserialize_with = "parts::few")]
    pub fields: Vec<PointField>,
    /// Byte order of the numbers in `data`.
    #[serde(with = "parts::flag")]
    pub is_bigendian: bool,
    /// Bytes of a point.
    pub point_step: u32,
    /// Bytes of a row.
    pub row_step: u32,
    /// The points, `row_step` × `height` bytes.
    #[serde(serialize_with = "parts::one_piece")]
    pub data: D,
    /// Whether all coordinates are finite numbers.
    #[serde(with = "parts::flag")]
    pub is_dense: bool,
}
