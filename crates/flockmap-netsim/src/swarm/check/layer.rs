//! A robot's layer of an origin is at least as new as what that origin packed, at all indices held; the rest of what it may hold
//! is the business of the checker `voxel`.

use super::Finding;
use crate::swarm::truth::{Truth, Wrong};
use flockmap::{Changes, Robot, Stream};

const NAME: &str = "layer";

/// After a package was merged: the voxels that it names. O(voxels of the package).
pub(in crate::swarm) fn layer_after(
    truth: &Truth,
    robot: &Robot,
    stream: Stream,
    changes: &Changes,
) -> Option<Finding> {
    let published = truth.published(stream)?;
    let received = robot.session().received(stream)?;
    let wrong = published.find_older(changes, robot.fusion().layer(stream), received)?;
    Some(finding(stream, wrong))
}

/// The whole layer. O(voxels that the origin told).
pub(in crate::swarm) fn whole_layer(truth: &Truth, robot: &Robot, stream: Stream) -> Option<Finding> {
    let published = truth.published(stream)?;
    let received = robot.session().received(stream)?;
    Some(finding(stream, published.find_older_in(robot.fusion().layer(stream), received)?))
}

fn finding(stream: Stream, wrong: Wrong) -> Finding {
    let expected = format!("{:?} of {stream:?}: {}", wrong.voxel, wrong.expected);
    Finding { checker: NAME, expected, found: wrong.found }
}
