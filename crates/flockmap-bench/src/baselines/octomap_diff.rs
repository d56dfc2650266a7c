//! Differences as pruned binary OctoMaps, as MARBLE's marble_mapping sends them.
//!
//! The tree of the voxels that have changed, as a `.bt` file holds it after its header. A message: number
//! (u32), side of a voxel in metres (f64), the tree.

use anyhow::{Result, anyhow, ensure};
use flockmap::codec::Batch;
use flockmap::grid::{BlockIndex, Changes, Stamp, StateBlock};
use flockmap_io::{Cube, octomap_tree, read_octomap_tree};
use rustc_hash::FxHashMap;

use crate::baselines::bytes::{MESSAGE_VOXELS_MAX, Reader, read_f64s};
use crate::baselines::state_map::StateMap;
use crate::baselines::traits::{Messages, Sender};

const METHOD: &str = "octomap-diff";

/// MARBLE's rule: a difference every 10 s, if it has more than 1,000 nodes.
const PERIOD_MICROS: i64 = 10_000_000;
const NODES_MIN: u64 = 1_000;

/// Sends a difference at the end of each batch, or by MARBLE's rule.
pub(crate) struct OctomapDiffSender {
    marble: Option<Marble>,
    number: u32,
}

#[derive(Default)]
struct Marble {
    next: Option<Stamp>,
    sent: StateMap,
    changed: FxHashMap<BlockIndex, StateBlock>,
}

impl OctomapDiffSender {
    pub(crate) fn new(as_marble: bool) -> Self {
        Self { marble: as_marble.then(Marble::default), number: 0 }
    }

    fn message(&mut self, batch: &Batch, tree: &[u8], out: &mut Messages) {
        self.number = self.number.wrapping_add(1);
        let side = batch.resolution.metres();
        out.push([&self.number.to_le_bytes(), side.to_le_bytes().as_slice(), tree].concat());
    }
}

impl Sender for OctomapDiffSender {
    fn batch(&mut self, now: Stamp, batch: &Batch, changes: &Changes, out: &mut Messages) -> Result<()> {
        let Some(marble) = &mut self.marble else {
            let (tree, _) = encode(changes)?;
            self.message(batch, &tree, out);
            return Ok(());
        };
        for (index, block) in changes.blocks() {
            marble.changed.entry(*index).or_default().overlay(block);
        }
        let next = *marble.next.get_or_insert_with(|| batch.start.plus_micros(PERIOD_MICROS));
        if now < next {
            return Ok(());
        }
        marble.next = Some(now.plus_micros(PERIOD_MICROS));
        // A voxel that flipped and flipped back is no change.
        let net =
            marble.changed.iter().map(|(index, block)| (*index, block.minus(&marble.sent.block(*index))));
        let net = Changes::from_blocks(net.collect());
        let (tree, nodes) = encode(&net)?;
        // The root is no node of the difference.
        if nodes > NODES_MIN + 1 {
            marble.changed.clear();
            marble.sent.apply(&net)?;
            self.message(batch, &tree, out);
        }
        Ok(())
    }
}

/// The tree of these voxels, and its number of nodes.
fn encode(changes: &Changes) -> Result<(Vec<u8>, u64)> {
    let fits = changes.len() as u64 <= MESSAGE_VOXELS_MAX;
    ensure!(fits, "{METHOD} cannot send this: a difference has at most 2²³ voxels");
    octomap_tree(changes.voxels()).map_err(|_| {
        anyhow!("{METHOD} cannot send this: an OctoMap reaches from voxel −32,768 to 32,767 on each axis")
    })
}

/// What a message changes. Memory: 40 bytes for each of its bytes, and 160 for each block of at most 2²³ voxels.
pub(crate) fn parse(message: &[u8]) -> Option<Changes> {
    let mut reader = Reader::new(message);
    reader.u32()?;
    let [side_m] = read_f64s(&mut reader)?;
    let cubes = read_octomap_tree(reader.rest())?;
    let voxels: u64 = cubes.iter().map(Cube::volume).sum();
    let is_sound = side_m.is_finite() && voxels <= MESSAGE_VOXELS_MAX;
    is_sound
        .then(|| Changes::from_voxels(cubes.iter().flat_map(|cube| cube.voxels().map(|v| (v, cube.state)))))
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap::grid::{State, Voxel};
    use flockmap_io::OctoMap;
    use proptest::prelude::*;
    use std::collections::BTreeMap;

    fn some_changes() -> impl Strategy<Value = Changes> {
        let coordinate = || prop_oneof![-4..4i32, -32_768..32_768i32];
        let state = prop_oneof![Just(State::Free), Just(State::Occupied)];
        let corner = (coordinate(), coordinate(), coordinate());
        // Boxes, so that leaves of all sizes are joined.
        prop::collection::vec((corner, [1..20i32, 1..20i32, 1..20i32], state), 1..6).prop_map(|boxes| {
            Changes::from_voxels(boxes.into_iter().flat_map(|((x, y, z), [a, b, c], state)| {
                let end = |low: i32, size: i32| (low + size).min(32_768);
                (x..end(x, a)).flat_map(move |x| {
                    (y..end(y, b))
                        .flat_map(move |y| (z..end(z, c)).map(move |z| (Voxel::new(x, y, z), state)))
                })
            }))
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn a_tree_is_what_octomap_reads(changes in some_changes()) {
            let (tree, nodes) = encode(&changes).unwrap();
            let mut file = format!("# Octomap OcTree binary file\nid OcTree\nsize {}\nres 0.1\ndata\n", nodes).into_bytes();
            file.extend_from_slice(&tree);
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("tree.bt");
            std::fs::write(&path, file).unwrap();
            let map = OctoMap::read(&path).unwrap();
            let expected: BTreeMap<_, _> = changes.voxels().collect();
            prop_assert_eq!(map.voxels().collect::<BTreeMap<_, _>>(), expected);
        }

        #[test]
        fn a_tree_comes_back(changes in some_changes()) {
            let (tree, _) = encode(&changes).unwrap();
            let mut message = vec![0; 12];
            message.extend_from_slice(&tree);
            prop_assert_eq!(parse(&message).unwrap(), changes);
        }
    }

    #[test]
    fn equal_neighbours_are_joined() {
        let cube = |side: i32| {
            let voxel = move |n: i32| (Voxel::new(n % side, n / side % side, n / side / side), State::Free);
            Changes::from_voxels((0..side.pow(3)).map(voxel))
        };
        // The root and 13 levels with one child above a cube of 8³, 16 above a voxel.
        let (tree, nodes) = encode(&cube(8)).unwrap();
        assert_eq!((tree.len(), nodes), (26, 14));
        assert_eq!(encode(&cube(1)).unwrap().0.len(), 32);
    }
}
