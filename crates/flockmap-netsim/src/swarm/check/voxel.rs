//! A layer of an origin never holds a state and stamp for a voxel that this origin never told.

use super::Finding;
use crate::swarm::truth::{Truth, Wrong};
use flockmap::{Changes, Robot, Stamp, Stream};

const NAME: &str = "voxel";

/// After a package was merged: everything that it said was told by the batch that it is of. O(blocks).
pub(in crate::swarm) fn voxels_of_merge(
    truth: &Truth,
    stream: Stream,
    index: u32,
    changes: &Changes,
    stamp: Stamp,
) -> Option<Finding> {
    let Some(published) = truth.published(stream) else {
        return Some(Finding {
            checker: NAME,
            expected: "a stream that somebody made".to_owned(),
            found: format!("package {index} of {stream:?}"),
        });
    };
    let wrong = published.find_unpublished(changes, stamp)?;
    Some(finding(stream, &wrong))
}

/// The whole layer. O(voxels).
pub(in crate::swarm) fn whole_voxels(truth: &Truth, robot: &Robot, stream: Stream) -> Option<Finding> {
    let (published, layer) = (truth.published(stream)?, robot.fusion().layer(stream)?);
    Some(finding(stream, &published.find_untold_in(layer)?))
}

fn finding(stream: Stream, wrong: &Wrong) -> Finding {
    let expected = format!("{:?} of {stream:?}: {}", wrong.voxel, wrong.expected);
    Finding { checker: NAME, expected, found: wrong.found.clone() }
}
