//! A layer of an origin never has a state and stamp of a voxel that this origin never published.

use super::Finding;
use crate::swarm::truth::Truth;
use flockmap::{Changes, Robot, Stamp, Stream};

const NAME: &str = "voxel";

/// After a package was merged: everything that it says was published with the stamp of its batch. O(voxels of
/// the package).
pub(in crate::swarm) fn voxels_of_merge(
    truth: &Truth,
    stream: Stream,
    index: u32,
    changes: &Changes,
    stamp: Stamp,
) -> Option<Finding> {
    let Some(published) = truth.published(stream) else {
        let found = format!("package {index} of {stream:?}");
        return Some(Finding::new(NAME, "a stream that somebody made", found));
    };
    let wrong = published.find_unpublished(changes.voxels().map(|(voxel, state)| (voxel, state, stamp)))?;
    Some(Finding::of_voxel(NAME, stream, wrong))
}

/// The whole layer. O(voxels).
pub(super) fn whole_voxels(truth: &Truth, robot: &Robot, stream: Stream) -> Option<Finding> {
    let (published, layer) = (truth.published(stream)?, robot.fusion().layer(stream)?);
    let voxels = layer.voxels().filter_map(|(voxel, _)| {
        let (state, stamp) = layer.get(voxel)?;
        Some((voxel, state, stamp))
    });
    Some(Finding::of_voxel(NAME, stream, published.find_unpublished(voxels)?))
}
