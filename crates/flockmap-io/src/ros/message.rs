//! What each message is called.

use super::cloud::PointCloud2;
use super::diagnostic::DiagnosticArray;
use super::geometry::{Odometry, PoseArray, PoseStamped, TFMessage, TransformStamped};
use super::grid::{OccupancyGrid, OccupancyGridUpdate, Octomap};
use super::marker::{Marker, MarkerArray};
use super::time::{Clock, Header};

/// A message that can be sent on a topic.
pub trait RosMessage {
    /// The package that defines it, for example `nav_msgs`.
    const PACKAGE: &'static str;
    /// Its name in there, for example `Odometry`.
    const NAME: &'static str;
    /// Both as MCAP and `ros2 topic` write them, for example `nav_msgs/msg/Odometry`.
    const SCHEMA: &'static str;
}

macro_rules! messages {
    ($($package:literal $name:literal $type:ident $(<$data:ident>)?,)*) => {$(
        impl$(<$data>)? RosMessage for $type$(<$data>)? {
            const PACKAGE: &'static str = $package;
            const NAME: &'static str = $name;
            const SCHEMA: &'static str = concat!($package, "/msg/", $name);
        }
    )*};
}

messages! {
    "std_msgs" "Header" Header,
    "rosgraph_msgs" "Clock" Clock,
    "geometry_msgs" "PoseStamped" PoseStamped,
    "geometry_msgs" "PoseArray" PoseArray,
    "geometry_msgs" "TransformStamped" TransformStamped,
    "tf2_msgs" "TFMessage" TFMessage,
    "nav_msgs" "Odometry" Odometry,
    "nav_msgs" "OccupancyGrid" OccupancyGrid,
    "map_msgs" "OccupancyGridUpdate" OccupancyGridUpdate,
    "octomap_msgs" "Octomap" Octomap,
    "sensor_msgs" "PointCloud2" PointCloud2<D>,
    "visualization_msgs" "Marker" Marker,
    "visualization_msgs" "MarkerArray" MarkerArray,
    "diagnostic_msgs" "DiagnosticArray" DiagnosticArray,
}
