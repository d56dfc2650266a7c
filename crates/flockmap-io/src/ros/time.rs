//! When and in which frame: the header that most messages begin with.

use flockmap_grid::Stamp;
use serde::{Deserialize, Serialize};

use super::parts;

/// `builtin_interfaces/msg/Time`: seconds, and nanoseconds on top of them.
#[derive(Serialize, Deserialize, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug, Default)]
pub struct Time {
    /// Whole seconds. ROS 2 itself refuses those below 0.
    pub sec: i32,
    /// 0 to 999,999,999.
    pub nanosec: u32,
}

impl From<Time> for Stamp {
    /// Parts of a microsecond do not count.
    fn from(time: Time) -> Self {
        Self(i64::from(time.sec) * 1_000_000 + i64::from(time.nanosec) / 1_000)
    }
}

impl From<Stamp> for Time {
    /// Saturates at the ends of the range, 2³¹ s before and after 0.
    fn from(stamp: Stamp) -> Self {
        let (first, last) = (i64::from(i32::MIN) * 1_000_000, i64::from(i32::MAX) * 1_000_000 + 999_999);
        let micros = stamp.0.clamp(first, last);
        Self {
            sec: micros.div_euclid(1_000_000) as i32,
            nanosec: micros.rem_euclid(1_000_000) as u32 * 1_000,
        }
    }
}

/// `builtin_interfaces/msg/Duration`: seconds, and nanoseconds on top of them.
#[derive(Serialize, Deserialize, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug, Default)]
pub struct Duration {
    /// Whole seconds, rounded down.
    pub sec: i32,
    /// 0 to 999,999,999.
    pub nanosec: u32,
}

impl From<core::time::Duration> for Duration {
    /// Saturates at the end of the range, 2³¹ s.
    fn from(span: core::time::Duration) -> Self {
        match i32::try_from(span.as_secs()) {
            Ok(sec) => Self { sec, nanosec: span.subsec_nanos() },
            Err(_) => Self { sec: i32::MAX, nanosec: 999_999_999 },
        }
    }
}

/// `std_msgs/msg/Header`.
#[derive(Serialize, Deserialize, Clone, PartialEq, Eq, Debug, Default)]
pub struct Header {
    /// When.
    pub stamp: Time,
    /// The frame in which coordinates are, without a slash in front.
    #[serde(with = "parts::frame")]
    pub frame_id: String,
}

impl Header {
    /// A header of a stamp and a frame.
    pub fn new(stamp: Stamp, frame_id: impl Into<String>) -> Self {
        Self { stamp: stamp.into(), frame_id: frame_id.into() }
    }
}

/// `rosgraph_msgs/msg/Clock`: what time it is in a simulation.
#[derive(Serialize, Deserialize, Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Clock {
    /// Now.
    pub clock: Time,
}
