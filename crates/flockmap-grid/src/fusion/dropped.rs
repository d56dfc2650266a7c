//! What was dropped of layers, and what is next.

use crate::{BlockIndex, Stamp, Stream};

/// What was dropped of a layer for want of room.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Dropped {
    /// The stream.
    pub stream: Stream,
    /// Blocks of 8³ voxels that were in the layer, or that came and found no room.
    pub blocks: usize,
    /// None of it is newer than this, on the clock of the origin.
    pub newest: Stamp,
}

/// What is dropped next, and what was dropped.
#[derive(Default)]
pub(super) struct Dropping {
    /// Of the own layer, and of those of others: what is worst last.
    pub(super) next: [Vec<Candidate>; 2],
    /// Where the sensor of the own robot was last, in blocks.
    pub(super) near: Option<[f64; 3]>,
    pub(super) dropped: Vec<Dropped>,
}

/// A cube of a layer, as it was when it was looked at.
pub(super) struct Candidate {
    pub(super) rank: u64,
    pub(super) stream: Stream,
    pub(super) at: BlockIndex,
    pub(super) newest: Stamp,
}
