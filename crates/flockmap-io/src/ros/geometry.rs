//! Poses, and the messages that say where something is.

use serde::{Deserialize, Serialize};

use super::parts;
use super::time::Header;

/// `geometry_msgs/msg/Pose`, and `geometry_msgs/msg/Transform`, which has the same numbers in the same order.
#[derive(Serialize, Deserialize, Clone, Copy, PartialEq, Debug)]
pub struct Pose {
    /// x, y, z in metres.
    pub position: [f64; 3],
    /// Rotation as a quaternion x, y, z, w.
    pub orientation: [f64; 4],
}

impl Default for Pose {
    fn default() -> Self {
        Self { position: [0.0; 3], orientation: [0.0, 0.0, 0.0, 1.0] }
    }
}

impl Pose {
    /// The pose as the map takes it, its quaternion normalised. `None` if a number is not finite or the quaternion
    /// is (nearly) zero.
    pub fn checked(&self) -> Option<flockmap_grid::Pose> {
        flockmap_grid::Pose::new(self.position, self.orientation)
    }
}

impl From<flockmap_grid::Pose> for Pose {
    fn from(pose: flockmap_grid::Pose) -> Self {
        Self { position: pose.translation(), orientation: pose.quaternion_xyzw() }
    }
}

/// `geometry_msgs/msg/PoseStamped`: a pose in the frame of the header.
#[derive(Serialize, Deserialize, Clone, PartialEq, Debug, Default)]
pub struct PoseStamped {
    /// Stamp and frame.
    pub header: Header,
    /// The pose.
    pub pose: Pose,
}

/// `geometry_msgs/msg/PoseArray`: poses in the frame of the header.
#[derive(Serialize, Deserialize, Clone, PartialEq, Debug, Default)]
pub struct PoseArray {
    /// Stamp and frame.
    pub header: Header,
    /// The poses.
    pub poses: Vec<Pose>,
}

/// `geometry_msgs/msg/TransformStamped`: the pose of one frame in another.
#[derive(Serialize, Deserialize, Clone, PartialEq, Debug, Default)]
pub struct TransformStamped {
    /// Stamp and parent frame.
    pub header: Header,
    /// The child frame.
    #[serde(with = "parts::frame")]
    pub child_frame_id: String,
    /// `T_parent_child`.
    pub transform: Pose,
}

/// `tf2_msgs/msg/TFMessage`.
#[derive(Serialize, Deserialize, Clone, PartialEq, Debug, Default)]
pub struct TFMessage {
    /// Poses of frames in others.
    pub transforms: Vec<TransformStamped>,
}

/// `geometry_msgs/msg/PoseWithCovariance`.
#[derive(Serialize, Deserialize, Clone, Copy, PartialEq, Debug, Default)]
pub struct PoseWithCovariance {
    /// The pose.
    pub pose: Pose,
    /// Row by row over x, y, z (m) and the rotations about x, y, z (rad).
    pub covariance: [[f64; 6]; 6],
}

/// `geometry_msgs/msg/Twist`.
#[derive(Serialize, Deserialize, Clone, Copy, PartialEq, Debug, Default)]
pub struct Twist {
    /// m/s along x, y, z.
    pub linear: [f64; 3],
    /// rad/s about x, y, z.
    pub angular: [f64; 3],
}

/// `geometry_msgs/msg/TwistWithCovariance`.
#[derive(Serialize, Deserialize, Clone, Copy, PartialEq, Debug, Default)]
pub struct TwistWithCovariance {
    /// The velocity.
    pub twist: Twist,
    /// Row by row over the velocities along and about x, y, z.
    pub covariance: [[f64; 6]; 6],
}

/// `nav_msgs/msg/Odometry`: where a body is and how it moves.
#[derive(Serialize, Deserialize, Clone, PartialEq, Debug, Default)]
pub struct Odometry {
    /// Stamp, and the frame in which the pose is.
    pub header: Header,
    /// The frame of the body, in which the velocity is.
    #[serde(with = "parts::frame")]
    pub child_frame_id: String,
    /// `T_frame_child`.
    pub pose: PoseWithCovariance,
    /// The velocity.
    pub twist: TwistWithCovariance,
}
