//! Once all agree, every robot has the submaps of every run that flies where that run has put them last.

use std::collections::BTreeMap;

use super::Finding;
use flockmap::{Pose, Robot, Stream, SubmapId};

const NAME: &str = "poses";

/// The first submap that a robot has elsewhere, or does not know. `poses`: those that a run has begun, and where each
/// was put last.
pub(in crate::swarm) fn wrong_poses(
    robot: &Robot,
    stream: Stream,
    poses: &BTreeMap<SubmapId, Pose>,
) -> Option<Finding> {
    let fusion = robot.fusion();
    fusion.layer(stream)?;
    // Where there was no room for what is said of submaps, it is known that something is lacking.
    if fusion.is_in_part(stream) {
        return None;
    }
    let known: Vec<SubmapId> = fusion.submaps(stream).collect();
    if known.iter().ne(poses.keys()) {
        let expected = format!("{} submaps of {stream:?}", poses.len());
        return Some(Finding::new(NAME, expected, format!("{}", known.len())));
    }
    poses.iter().find_map(|(submap, pose)| {
        let found = fusion.submap_pose(stream, *submap);
        let expected = || format!("{submap:?} of {stream:?} at {pose:?}");
        (found != *pose).then(|| Finding::new(NAME, expected(), format!("at {found:?}")))
    })
}
