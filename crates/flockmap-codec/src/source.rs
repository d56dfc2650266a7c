//! What is encoded: the changes of a batch, or the state of a span of packages.

use flockmap_grid::{Resolution, Stamp, Stream};

/// One batch of mapping: all changes from `start` to `end`.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Batch {
    /// Whose observations these are.
    pub stream: Stream,
    /// When the batch began, on the origin's clock.
    pub start: Stamp,
    /// When it was closed: the stamp of every change in it. Batches of a stream have strictly increasing ends.
    pub end: Stamp,
    /// Side of a voxel.
    pub resolution: Resolution,
    /// Where the sensor was in the middle of the batch, in sixteenths of a voxel from the corner of voxel (0,
    /// 0, 0). Only [`Codec::Flock`](crate::Codec::Flock) makes use of it: whatever it is, the changes come
    /// out right, in fewer bytes the nearer it is.
    pub sensor: [i32; 3],
}

/// Which packages a snapshot contains.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Span {
    /// The stream.
    pub stream: Stream,
    /// 0: the whole state. Else it has at least the voxels whose newest change is in a package after this
    /// one. Below `upto`.
    pub since: u32,
    /// The newest package whose changes, with those of all before it, are in the state; from 1.
    pub upto: u32,
    /// Some of that was dropped for want of room and is lacking, none of it newer than this. `None`: nothing is.
    pub lost_upto: Option<Stamp>,
    /// What packages that are not contained changed is lacking, up to this one at most. `None`: nothing is.
    pub changed_upto: Option<u32>,
    /// What is said of packages that are not contained, up to this one at most, may be there too. `None`: nothing is.
    pub says_upto: Option<u32>,
    /// What is lacking is lacking since nothing is there that is newer than these packages.
    pub is_cut: bool,
    /// And it is of the state of who held all packages up to `changed_upto`.
    pub is_of_all: bool,
}

impl Span {
    /// Of a state in which nothing is lacking.
    pub const fn new(stream: Stream, since: u32, upto: u32) -> Self {
        let (lost_upto, changed_upto, says_upto) = (None, None, None);
        Self { stream, since, upto, lost_upto, changed_upto, says_upto, is_cut: false, is_of_all: false }
    }
}
