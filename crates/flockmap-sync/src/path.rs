//! Addresses, and where a peer is reached.

use crate::wire::PathMessage;
use flockmap_grid::{RobotId, Stamp};
use std::collections::VecDeque;

/// An address, as the driver numbers them: whatever arrives from one address has the same number.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct Path(pub u64);

/// Where a peer is reached.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct PeerPath {
    /// The last path through which an answer came back.
    pub(crate) valid: Option<Path>,
    /// One that it was heard from and that is being tried, with the number that has to come back, and when
    /// that was sent last.
    pub(crate) tried: Option<(Path, u64, Stamp)>,
}

impl PeerPath {
    /// Whether something may be sent to the peer alone: its path is known to be right, or the driver knows of
    /// none.
    pub(crate) const fn is_open(self) -> bool {
        self.valid.is_some() || self.tried.is_none()
    }

    /// Whether it was heard on a path.
    pub(crate) const fn is_heard(self) -> bool {
        self.valid.is_some() || self.tried.is_some()
    }

    pub(crate) const fn valid(self) -> Option<Path> {
        self.valid
    }
}

/// Challenges and answers that wait to be sent.
pub(crate) type PathsWaiting = VecDeque<(RobotId, Path, PathMessage)>;
