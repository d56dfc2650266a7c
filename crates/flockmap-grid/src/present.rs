//! The state of a region as it is now, in place of the history of its changes.

use crate::{Changes, Stamp, VoxelBox};

/// What a layer holds in a box: every known voxel with its state and the stamp that it got it at.
/// Sent when too many packages are missing ("the current OGM as it is", Sec. IV-B of the paper).
///
/// Voxels of the region that are in no part are Unknown.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct PresentState {
    /// The box that this speaks of.
    pub region: VoxelBox,
    /// The known voxels, grouped by stamp: stamps ascending, voxel sets disjoint and all inside `region`.
    pub parts: Vec<(Stamp, Changes)>,
    /// From where parts were seen, in sixteenths of a voxel: those of which it is known, stamps ascending. A codec may make use of it;
    /// it is no part of what the state says.
    pub sensors: Vec<(Stamp, [i32; 3])>,
}
