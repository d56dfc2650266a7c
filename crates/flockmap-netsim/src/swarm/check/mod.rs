//! What must hold in every flight. Each checker has a file, a name, and says there what it holds.

mod agreement;
mod budget;
mod frames;
mod fused;
mod identity;
mod layer;
mod limits;
mod path;
mod poses;
mod quiet;
mod sealed;
mod still;
mod twice;
mod voxel;
mod work;

pub(super) use agreement::{
    Forgotten, bound, disagreement, leaves_out, pause_of_relays, superseded, unequal_layer,
};
pub(super) use budget::Budget;
pub(super) use fused::wrong_fused;
pub(super) use identity::Identities;
pub(super) use path::Paths;
pub(super) use poses::wrong_poses;
pub(super) use quiet::{Quiet, period_micros};
pub(super) use sealed::Sealed;
pub(super) use still::Still;
pub(super) use twice::Twice;
pub(super) use work::Work;

use super::truth::Wrong;
use flockmap::{RobotId, Stream};

pub(super) mod names {
    pub(in crate::swarm) use super::agreement::NAME as AGREEMENT;
    /// What a robot's call into the library panicked with.
    pub(in crate::swarm) const CRASH: &str = "crash";
    /// The packages of a batch, decoded at their origin, say what the batch changed.
    pub(in crate::swarm) const PACKED: &str = "packed";
    /// What the simulator asks of its own settings.
    pub(in crate::swarm) const SETTINGS: &str = "settings";
}

pub(super) use layer::{layer_after, whole};
pub(super) use limits::limits;
pub(super) use voxel::voxels_of_merge;

/// Something that must hold and did not.
#[derive(Clone, PartialEq, Debug)]
#[non_exhaustive]
pub struct Failure {
    /// The checker.
    pub checker: &'static str,
    /// Where it was found.
    pub robot: Option<RobotId>,
    /// When, in seconds since the flight began.
    pub at_s: f64,
    /// What should have been.
    pub expected: String,
    /// What was.
    pub found: String,
}

/// A finding of a checker, before time and robot are put to it.
pub(super) struct Finding {
    pub(super) checker: &'static str,
    pub(super) expected: String,
    pub(super) found: String,
}

impl Finding {
    pub(super) fn new(checker: &'static str, expected: impl Into<String>, found: impl Into<String>) -> Self {
        Self { checker, expected: expected.into(), found: found.into() }
    }

    fn of_voxel(checker: &'static str, stream: Stream, wrong: Wrong) -> Self {
        Self::new(checker, format!("{:?} of {stream:?}: {}", wrong.voxel, wrong.expected), wrong.found)
    }
}
