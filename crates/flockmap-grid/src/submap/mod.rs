//! Submaps: parts of what a run has mapped that are moved against each other when a loop is closed.
//!
//! All submaps of a run are written into one grid, one after the other, so that where a submap begins nothing is said
//! anew. A block moves with the submap in which it changed last. A block that is seen again when its submap is over,
//! and does not look as it did, begins anew on the next [`Sheet`] of the grid; the old one stays as it was. So what is
//! received, packed, repaired, stored and passed on are voxels and stamps, as without submaps. Poses are voxels too:
//! see [`record`].

mod block_box;
mod pose_bits;
pub(crate) mod record;
mod sheet;
mod spans;

pub(crate) use block_box::BlockBox;
pub use record::SubmapRecord;
pub use sheet::Sheet;
pub(crate) use sheet::{RESERVED, is_reserved};
pub(crate) use spans::Spans;

/// The number of a submap in its run, from 0.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Default)]
pub struct SubmapId(pub(crate) u16);

impl SubmapId {
    /// The one that a run begins with.
    pub const FIRST: Self = Self(0);
    /// Most submaps of a run.
    pub const COUNT: usize = 4_096;

    /// The submap with this number, below [`COUNT`](Self::COUNT).
    pub const fn new(number: u16) -> Option<Self> {
        if (number as usize) < Self::COUNT { Some(Self(number)) } else { None }
    }

    /// Its number.
    pub const fn number(self) -> u16 {
        self.0
    }

    /// The one after it, if there may be one.
    pub const fn next(self) -> Option<Self> {
        Self::new(self.0 + 1)
    }

    /// The one before it.
    pub const fn before(self) -> Option<Self> {
        if self.0 == 0 { None } else { Some(Self(self.0 - 1)) }
    }
}
