//! What became of a scan, and what is left out of one.

use super::submaps::MovedBlock;
use crate::{BlockIndex, Plane, Stamp, StateBlock};

/// A sphere in the frame of the map, in metres.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Sphere {
    /// Its centre.
    pub centre: [f64; 3],
    /// Its radius.
    pub radius: f64,
}

/// What became of a scan, or of an update with states, which has no rays.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct ScanReport {
    /// When it counts as made.
    pub stamp: Stamp,
    /// Where the sensor was, in metres in the frame of the map; of states without that, what stands for it, if anything
    /// was touched.
    pub sensor: Option<[f64; 3]>,
    /// Blocks with touched voxels, and which.
    pub touched: Vec<(BlockIndex, Plane)>,
    /// Voxels that are Free or Occupied now and were not before this scan.
    pub changed: Vec<(BlockIndex, StateBlock)>,
    /// Blocks that were forgotten under the byte cap, or not even taken in, ascending.
    pub forgotten: Vec<BlockIndex>,
    /// Blocks in which what was known is not any more, or not in the same submap.
    pub moved: Vec<MovedBlock>,
    /// Rays that ended with a hit.
    pub hits: usize,
    /// Rays that were cut, or came back with nothing: they carve free space only.
    pub cut: usize,
    /// Points that were ignored: not finite, too near, or too far out for voxel indices.
    pub ignored: usize,
    /// Points that were ignored since they lie on a team-mate.
    pub masked: usize,
}
