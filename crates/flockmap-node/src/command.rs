//! What the handle of a node, and its metrics, ask of its driver.

use flockmap::{Robot, Stamp};

use crate::NodeStatus;

/// Something to do with the robot at a time.
pub(crate) type RobotCall = Box<dyn FnOnce(&mut Robot, Stamp) + Send>;

/// What can be asked.
pub(crate) enum Command {
    Robot(RobotCall),
    Status(Box<dyn FnOnce(NodeStatus) + Send>),
    Stop,
}
