//! The fused map of every robot says of every voxel what the words at hand say: the robot's own and those of the layers.
//!
//! Where they are one, it is that one. Where they differ and the clocks are known exactly, it is the newest (the own one is given the
//! priority of the configuration; at equal stamps Occupied). Where clocks are measured, it is one of them.

use super::Finding;
use flockmap::grid::{BlockIndex, bit_of};
use flockmap::{Robot, RobotId, Stamp, State, Voxel};
use std::collections::BTreeSet;

const NAME: &str = "fused";

/// The first wrong voxel. `ahead`: microseconds that this robot's clock is ahead of another's, where it is known.
/// O(voxels · layers).
pub(in crate::swarm) fn wrong_fused(
    robot: &Robot,
    ahead: impl Fn(RobotId) -> Option<i64>,
) -> Option<Finding> {
    let (own, mapper) = (robot.own_stream(), robot.mapper());
    let layers: Vec<_> = robot.fusion().layers().filter(|(stream, _)| *stream != own).collect();
    let priority = robot.config().fusion.own_priority_micros;
    let mut blocks: BTreeSet<BlockIndex> = mapper.blocks().map(|(index, _)| index).collect();
    blocks.extend(layers.iter().flat_map(|(_, layer)| layer.blocks().map(|(index, _)| index)));
    blocks.extend(robot.map().blocks().map(|(index, _)| index));
    for block in blocks {
        let corner = block.corner();
        let fused = robot.map().block(block).copied().unwrap_or_default();
        let mapped = mapper.block(block).copied().unwrap_or_default();
        let published: Vec<_> = layers
            .iter()
            .filter_map(|(stream, layer)| Some((stream.origin, *layer, layer.block(block)?)))
            .collect();
        for bit in 0..512 {
            let mut words = published.iter().map(|(_, _, states)| states.get(bit)).chain([mapped.get(bit)]);
            let (mut free, mut occupied) = (false, false);
            words.by_ref().for_each(|state| match state {
                State::Free => free = true,
                State::Occupied => occupied = true,
                State::Unknown => {}
            });
            let found = fused.get(bit);
            let expected = match (free, occupied) {
                (false, false) => State::Unknown,
                (true, false) => State::Free,
                (false, true) => State::Occupied,
                (true, true) => {
                    let [x, y, z] = bit_of(bit);
                    let voxel = Voxel::new(corner.x + x, corner.y + y, corner.z + z);
                    let mut newest: Option<(Stamp, bool)> = None;
                    let mut is_known = true;
                    if mapped.get(bit) != State::Unknown {
                        let seen = mapper.last_seen(voxel).unwrap_or(Stamp(i64::MIN));
                        newest = Some((seen.plus_micros(priority), mapped.get(bit) == State::Occupied));
                    }
                    for (origin, layer, _) in &published {
                        let Some((state, stamp)) = layer.get(voxel) else { continue };
                        match ahead(*origin) {
                            Some(micros) => {
                                let word = (stamp.plus_micros(micros), state == State::Occupied);
                                newest = newest.max(Some(word));
                            }
                            None => is_known = false,
                        }
                    }
                    match newest {
                        Some((_, is_occupied)) if is_known => {
                            if is_occupied {
                                State::Occupied
                            } else {
                                State::Free
                            }
                        }
                        _ if found == State::Unknown => State::Free,
                        _ => found,
                    }
                }
            };
            if found != expected {
                let [x, y, z] = bit_of(bit);
                let voxel = Voxel::new(corner.x + x, corner.y + y, corner.z + z);
                return Some(Finding {
                    checker: NAME,
                    expected: format!("{expected:?} at {voxel:?} in the fused map"),
                    found: format!("{found:?}"),
                });
            }
        }
    }
    None
}
