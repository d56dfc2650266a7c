//! A robot's layer of an origin is at least as new as what that origin published, in all packages received;
//! what else it may have is what the checker `voxel` looks at.

use super::Finding;
use super::voxel::whole_voxels;
use crate::swarm::truth::{Published, Truth};
use flockmap::{Changes, Robot, Stream, Voxel};

const NAME: &str = "layer";

/// After a package was merged: the voxels that it names. O(voxels of the package).
pub(in crate::swarm) fn layer_after(
    truth: &Truth,
    robot: &Robot,
    stream: Stream,
    changes: &Changes,
) -> Option<Finding> {
    older(truth.published(stream)?, robot, stream, changes.voxels().map(|(voxel, _)| voxel))
}

fn older(
    published: &Published,
    robot: &Robot,
    stream: Stream,
    voxels: impl Iterator<Item = Voxel>,
) -> Option<Finding> {
    let received = robot.session().received(stream)?;
    let changed_upto = robot.session().cuts(stream, u32::MAX).changed_upto.unwrap_or(0);
    let wrong = published.find_older(voxels, robot.fusion().layer(stream), received, changed_upto)?;
    Some(Finding::of_voxel(NAME, stream, wrong))
}

/// The layer of a stream as a whole, by `voxel` and `layer`. O(voxels, also those that the origin published).
pub(in crate::swarm) fn whole(truth: &Truth, robot: &Robot, stream: Stream) -> Option<Finding> {
    let published = truth.published(stream)?;
    whole_voxels(truth, robot, stream).or_else(|| older(published, robot, stream, published.voxels()))
}
