//! The fused map of every robot says of every voxel what its own map and its layers say.
//!
//! Where they say the same, it is that. Where they differ and the clocks are known exactly, it is the newest
//! (the own one is given the priority of the configuration; at equal stamps Occupied). Where clocks are
//! measured, it is one of them.

use super::{Finding, frames};
use flockmap::grid::{BlockIndex, Sheet, bit_of};
use flockmap::{Pose, Robot, RobotId, Stamp, State, Stream, SubmapId, Voxel};
use std::collections::BTreeSet;

const NAME: &str = "fused";

/// The first wrong voxel. `ahead`: microseconds that this robot's clock is ahead of another's, where it is known.
/// O(voxels · layers).
pub(in crate::swarm) fn wrong_fused(
    robot: &Robot,
    ahead: impl Fn(RobotId) -> Option<i64>,
) -> Option<Finding> {
    // Until it is made anew, it has what a run said that was forgotten.
    if robot.is_rebuilding() {
        return None;
    }
    if robot.fusion().layers().any(|(stream, _)| has_submaps(robot, stream)) {
        return wrong_by_frames(robot, ahead);
    }
    let (own, mapper) = (robot.own_stream(), robot.mapper());
    let layers: Vec<_> = robot.fusion().layers().filter(|(stream, _)| *stream != own).collect();
    let priority = robot.config().fusion.own_priority_micros;
    let mut blocks: BTreeSet<BlockIndex> = mapper.blocks().map(|(index, _)| index).collect();
    blocks.extend(layers.iter().flat_map(|(_, layer)| layer.blocks().map(|(index, _)| index)));
    // What is said of submaps is no part of a map.
    blocks.retain(|index| Sheet::of(*index) == Some(Sheet::FIRST));
    blocks.extend(robot.map().blocks().map(|(index, _)| index));
    for block in blocks {
        let corner = block.corner();
        let fused = robot.map().block(block).unwrap_or_default();
        let mapped = mapper.block(block).copied().unwrap_or_default();
        let published: Vec<_> = layers
            .iter()
            .filter_map(|(stream, layer)| Some((stream.origin, *layer, layer.block(block)?)))
            .collect();
        for bit in 0..512 {
            let states = published.iter().map(|(_, _, states)| states.get(bit)).chain([mapped.get(bit)]);
            let mut states = states.filter(|state| *state != State::Unknown);
            let first = states.next().unwrap_or_default();
            let (found, is_contested) = (fused.get(bit), states.any(|state| state != first));
            if found == first && !is_contested {
                continue;
            }
            let [x, y, z] = bit_of(bit);
            let voxel = Voxel::new(corner.x + x, corner.y + y, corner.z + z);
            let expected = if is_contested {
                let own = (mapped.get(bit) != State::Unknown).then(|| {
                    let seen = mapper.last_seen(voxel).unwrap_or(Stamp(i64::MIN));
                    Some((seen.plus_micros(priority), mapped.get(bit) == State::Occupied))
                });
                // One of which the clock is not known leaves all of them open.
                let all = published.iter().filter_map(|(origin, layer, _)| {
                    let (state, stamp) = layer.get(voxel)?;
                    Some(ahead(*origin).map(|micros| (stamp.plus_micros(micros), state == State::Occupied)))
                });
                let all: Option<Vec<_>> = all.chain(own).collect();
                match all.and_then(|all| all.into_iter().max()) {
                    Some((_, true)) => State::Occupied,
                    Some((_, false)) => State::Free,
                    None if found == State::Unknown => State::Free,
                    None => found,
                }
            } else {
                first
            };
            if found != expected {
                let expected = format!("{expected:?} at {voxel:?} in the fused map");
                return Some(Finding::new(NAME, expected, format!("{found:?}")));
            }
        }
    }
    None
}

fn has_submaps(robot: &Robot, stream: Stream) -> bool {
    let fusion = robot.fusion();
    fusion.submaps(stream).count() > 1 || fusion.submap_pose(stream, SubmapId::FIRST) != Pose::IDENTITY
}

/// The same where something lies otherwise than it was seen.
fn wrong_by_frames(robot: &Robot, ahead: impl Fn(RobotId) -> Option<i64>) -> Option<Finding> {
    let priority = robot.config().fusion.own_priority_micros;
    let mut words = frames::words(robot);
    for (voxel, _) in robot.map().voxels() {
        words.entry(voxel).or_default();
    }
    words.into_iter().find_map(|(voxel, words)| {
        let found = robot.map().state(voxel);
        let first = words.first().map_or(State::Unknown, |(_, state, _)| *state);
        let is_contested = words.iter().any(|(_, state, _)| *state != first);
        let made = words.iter().map(|(who, state, stamp)| {
            let later = who.map_or(Some(priority), &ahead)?;
            Some((stamp.plus_micros(later), *state == State::Occupied))
        });
        // One of which the clock is not known leaves all of them open.
        let expected = match made.collect::<Option<Vec<_>>>().and_then(|all| all.into_iter().max()) {
            _ if !is_contested => first,
            Some((_, true)) => State::Occupied,
            Some((_, false)) => State::Free,
            None if found == State::Unknown => State::Free,
            None => found,
        };
        let text = || format!("{expected:?} at {voxel:?} in the fused map, of {words:?}");
        (found != expected).then(|| Finding::new(NAME, text(), format!("{found:?}")))
    })
}
