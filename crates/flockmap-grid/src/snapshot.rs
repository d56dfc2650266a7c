//! The state of a region as it is now, in place of the history of its changes.

mod voxels;

use crate::{Changes, Stamp, VoxelBox};
pub use voxels::{BlockRuns, SnapshotVoxels};

/// What a layer holds in a box: every known voxel with its state and the stamp that it got it at.
/// Sent when too many packages are missing ("the current OGM as it is", Sec. IV-B of the paper).
///
/// Voxels of the region that are in no part are Unknown. A part takes 144 bytes for each of its blocks,
/// however few voxels it has there; [`SnapshotVoxels`] says the same of a whole layer in less.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Snapshot {
    /// The box that this speaks of.
    pub region: VoxelBox,
    /// The known voxels, grouped by stamp: stamps ascending, voxel sets disjoint and all inside `region`.
    pub parts: Vec<(Stamp, Changes)>,
    /// From where parts were seen, in sixteenths of a voxel: those of which it is known, stamps ascending. A
    /// codec may make use of it; it is no part of what the state says.
    pub sensors: Vec<(Stamp, [i32; 3])>,
}
