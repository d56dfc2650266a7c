//! What can be wrong with the bytes of a feed.

use flockmap_grid::{BlockIndex, Resolution, RobotId};

/// Why bytes are no feed, or not one that this mirror can take. The connection is of no more use; the mirror is
/// as it was before the frame, and may begin another one.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FeedError {
    /// A frame of this length cannot be.
    #[error("a frame of {got} bytes, expected {min} to {max}: this is no feed, or damaged")]
    Length {
        /// What its length says.
        got: usize,
        /// Least.
        min: usize,
        /// Most.
        max: usize,
    },
    /// A frame ends before what it says is in it.
    #[error("a {kind} frame ends in its {field}")]
    Truncated {
        /// Which kind of frame.
        kind: &'static str,
        /// What is not there as a whole.
        field: &'static str,
    },
    /// A field has a value that it cannot have.
    #[error("the {field} of a {kind} frame is {got}, expected {expected}")]
    Field {
        /// Which kind of frame.
        kind: &'static str,
        /// Which field.
        field: &'static str,
        /// Its value.
        got: u64,
        /// What would have done.
        expected: &'static str,
    },
    /// The states or the origins of a block contradict each other.
    #[error("{0:?} has voxels that are free and occupied, or origins that do not fit its known voxels")]
    Block(BlockIndex),
    /// A text is not UTF-8.
    #[error("the {field} of a {kind} frame is no UTF-8 text")]
    Text {
        /// Which kind of frame.
        kind: &'static str,
        /// Which field.
        field: &'static str,
    },
    /// The other side speaks another version.
    #[error("the other side speaks version {0} of the feed, and this one speaks version 1")]
    Version(u8),
    /// A frame that cannot come at this point.
    #[error("a {0} frame where none can come: the node says hello first, and once")]
    OutOfOrder(&'static str),
    /// Versions that go back.
    #[error("a blocks frame up to version {upto} of {newest}, after one up to {before}")]
    Versions {
        /// Up to which version the frame brings the map.
        upto: u64,
        /// The newest version that it knows.
        newest: u64,
        /// What the frame before had brought it to.
        before: u64,
    },
    /// The map has more blocks than the mirror may hold.
    #[error("the map has more than {0} blocks, and this mirror may hold no more: raise blocks_max")]
    BlocksFull(usize),
    /// Another robot's map, or one with other voxels, comes from where this mirror's came from.
    #[error(
        "the map of {robot:?} with voxels of {resolution:?} comes, and the mirror is of {own_robot:?} and {own_resolution:?}: make a new mirror"
    )]
    AnotherMap {
        /// Whose map comes.
        robot: RobotId,
        /// Its voxels.
        resolution: Resolution,
        /// Whose map is mirrored.
        own_robot: RobotId,
        /// The voxels of the mirror.
        own_resolution: Resolution,
    },
}
