//! Messages of ROS 2, as MCAP records hold them and as DDS carries them, and the frames that they speak of.
//!
//! | part | what |
//! |---|---|
//! | messages | structs that serde reads and writes, with their fields in the order of the `.msg` files of ROS 2 Jazzy; [`RosMessage`] gives package and name |
//! | [`decode`], [`encode`] | a message as CDR bytes and back. Any other serde encoder of CDR, such as that of a DDS library, does the same |
//! | [`points_of`], [`cloud_of_points`], … | the points of a [`PointCloud2`] of any layout, and clouds made of points |
//! | [`FrameForest`] | what `/tf` and `/tf_static` said, from a log or as it comes, and poses looked up in it |
//!
//! Lengths are metres, stamps are [`flockmap_grid::Stamp`]s (microseconds), quaternions are x, y, z, w. Strings that
//! are read may lack their closing zero and may be no UTF-8; one of more than 4,096 bytes is an error. Frames
//! lose the slash in front that ROS 1 used to put there. A message that is read takes at most 24
//! times its own bytes, whatever lengths it claims; most take about as much as they have.
//!
//! ```
//! use flockmap_grid::Stamp;
//! use flockmap_io::ros::{Bytes, Header, PointCloud2, cloud_of_points, decode, encode, points_of};
//!
//! let header = Header::new(Stamp(1_500_000), "map");
//! let message = encode(&cloud_of_points(header, &[[1.0, 2.0, 3.0]]));
//! // The points stay where they are; `PointCloud2<Bytes>` would own them.
//! let cloud: PointCloud2<&[u8]> = decode(&message)?;
//! assert_eq!(points_of(&cloud, 1_000, None)?.points, [[1.0, 2.0, 3.0]]);
//! # Ok::<(), flockmap_io::Fault>(())
//! ```

mod cdr;
mod cloud;
mod diagnostic;
mod frames;
mod geometry;
mod grid;
mod marker;
mod message;
mod parts;
mod points;
mod record;
mod time;
mod topic;
mod track;

pub use cdr::{decode, encode};
pub use cloud::{PointCloud2, PointField};
pub use diagnostic::{DiagnosticArray, DiagnosticStatus, KeyValue};
pub use frames::{FRAMES_MAX, FrameForest, FrameTree, NoPose};
pub use geometry::{
    Odometry, Pose, PoseArray, PoseStamped, PoseWithCovariance, TFMessage, TransformStamped, Twist,
    TwistWithCovariance,
};
pub use grid::{MapMetaData, OccupancyGrid, OccupancyGridUpdate, Octomap};
pub use marker::{ColorRGBA, CompressedImage, Marker, MarkerArray, MeshFile, UVCoordinate};
pub use message::RosMessage;
pub use parts::{Bytes, STRING_BYTES_MAX};
pub use points::{CloudPoints, cloud_of_coloured_points, cloud_of_floats, cloud_of_points, points_of};
pub use time::{Clock, Duration, Header, Time};
pub use track::{NoPoseThen, Reach, Track};

pub(crate) use record::{
    NO_RETURNS, ODOMETRY, POINT_CLOUD, POSES, TRANSFORMS, decode_cloud_header, decode_odometry,
    decode_points, decode_submaps, decode_transforms, definition,
};
pub(crate) use topic::{is_within, namespace, shared_names};
