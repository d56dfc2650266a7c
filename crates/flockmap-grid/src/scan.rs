//! What a LiDAR delivers.

use crate::Stamp;

/// One scan: points in metres in the frame of the sensor.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Scan {
    /// When the scan was taken, on the robot's clock.
    pub stamp: Stamp,
    /// Where rays ended on something.
    pub points: Vec<[f32; 3]>,
    /// Rays that came back with nothing: a point far out along each such ray, at or beyond the range up to
    /// which the sensor would have seen something. They carve free space and hit nothing. Most drivers
    /// deliver none; leave it empty then.
    pub no_returns: Vec<[f32; 3]>,
}
