//! Differences as pruned binary OctoMaps, the way of MARBLE's marble_mapping.
//!
//! The tree of the voxels that have changed, eight equal leaves joined to one, 2 bits for each child of each inner node (1 free, 2
//! occupied, 3 has children), depth first from the root 16 levels up: the data of a `.bt` file. A message: number (u32), side of a voxel
//! in metres (f64), the tree.

use anyhow::{Context, Result, ensure};
use flockmap::codec::Batch;
use flockmap::grid::{BLOCK_VOXELS, BlockIndex, Changes, Stamp, State, StateBlock, Voxel, bit_of, voxel_bit};
use rustc_hash::FxHashMap;

use crate::baselines::bytes::{MESSAGE_VOXELS_MAX, Reader};
use crate::baselines::state_map::StateMap;
use crate::baselines::traits::{Messages, Sender};

const METHOD: &str = "octomap-diff";

/// MARBLE's rule: a difference every 10 s, if it has more than 1,000 nodes.
const PERIOD_MICROS: i64 = 10_000_000;
const NODES_MIN: usize = 1_000;

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
    pub(crate) const fn every_batch() -> Self {
        Self { marble: None, number: 0 }
    }

    pub(crate) fn as_marble() -> Self {
        Self { marble: Some(Marble::default()), number: 0 }
    }

    fn message(&mut self, batch: &Batch, tree: &[u8], out: &mut Messages) {
        self.number = self.number.wrapping_add(1);
        let mut message = Vec::with_capacity(tree.len() + 12);
        message.extend_from_slice(&self.number.to_le_bytes());
        message.extend_from_slice(&batch.resolution.metres().to_le_bytes());
        message.extend_from_slice(tree);
        out.push(message);
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
        if nodes > NODES_MIN {
            marble.changed.clear();
            marble.sent.apply(&net)?;
            self.message(batch, &tree, out);
        }
        Ok(())
    }
}

const DEPTH: u32 = 16;
const HALF: i32 = 1 << (DEPTH - 1);

/// The tree of these voxels, and its number of nodes without the root.
fn encode(changes: &Changes) -> Result<(Vec<u8>, usize)> {
    let voxels = changes.len() as u64;
    let fits = voxels <= MESSAGE_VOXELS_MAX;
    ensure!(fits, "{METHOD} cannot send this: a difference has at most 2²³ voxels");
    let mut leaves = Vec::with_capacity(voxels as usize);
    for (voxel, state) in changes.voxels() {
        let path = path(voxel).with_context(|| {
            format!("{METHOD} cannot send this: an OctoMap reaches from voxel −32,768 to 32,767 on each axis")
        })?;
        leaves.push((path, state));
    }
    leaves.sort_unstable_by_key(|(path, _)| *path);
    let (mut tree, mut nodes) = (Vec::new(), 0);
    write_node(&leaves, 0, &mut tree, &mut nodes);
    Ok((tree, nodes))
}

/// The way from the root to a voxel: three bits a level (x, y, z from bit 0), highest level first.
fn path(voxel: Voxel) -> Option<u64> {
    let key = |index: i32| u16::try_from(i64::from(index) + i64::from(HALF)).ok();
    let (x, y, z) = (key(voxel.x)?, key(voxel.y)?, key(voxel.z)?);
    let spread = |v: u16| (0..16).fold(0u64, |path, bit| path | u64::from(v >> bit & 1) << (3 * bit));
    Some(spread(x) | spread(y) << 1 | spread(z) << 2)
}

/// The node at `depth` with just these leaves, and all below it.
fn write_node(leaves: &[(u64, State)], depth: u32, tree: &mut Vec<u8>, nodes: &mut usize) {
    let shift = 3 * (DEPTH - depth - 1);
    let mut rest = leaves;
    let parts: [&[(u64, State)]; 8] = core::array::from_fn(|child| {
        let end = rest.partition_point(|(path, _)| (path >> shift & 7) as usize <= child);
        let (part, after) = rest.split_at_checked(end).unwrap_or_default();
        rest = after;
        part
    });
    let mut children = 0u16;
    for (child, part) in parts.iter().enumerate() {
        let Some((_, state)) = part.first() else { continue };
        let is_leaf = part.len() as u64 == 1 << shift && part.iter().all(|(_, other)| other == state);
        let bits = match (is_leaf, state) {
            (false, _) => 3,
            (true, State::Occupied) => 2,
            (true, _) => 1,
        };
        children |= bits << (2 * child);
        *nodes += 1;
    }
    tree.extend_from_slice(&children.to_le_bytes());
    for (child, part) in parts.iter().enumerate() {
        if children >> (2 * child) & 3 == 3 {
            write_node(part, depth + 1, tree, nodes);
        }
    }
}

/// Takes in a message. Memory: 160 bytes for each block of the difference, at most 2²³ voxels.
pub(crate) fn apply(message: &[u8], map: &mut StateMap) -> Result<()> {
    let mut reader = Reader::new(METHOD, message);
    reader.u32("a number")?;
    if !reader.f64("the side of a voxel in metres")?.is_finite() {
        return Err(reader.wrong("the side of a voxel in metres"));
    }
    let mut said = FxHashMap::default();
    let mut room = MESSAGE_VOXELS_MAX;
    read_node(&mut reader, Voxel::new(-HALF, -HALF, -HALF), 0, &mut room, &mut said)?;
    if !reader.is_empty() {
        return Err(reader.wrong("nothing after the tree"));
    }
    said.iter().try_for_each(|(index, block)| map.overlay(*index, block))?;
    Ok(())
}

/// Reads the node at `depth` with this lowest voxel, and all below it: at most 16 calls deep.
fn read_node(
    reader: &mut Reader<'_>,
    corner: Voxel,
    depth: u32,
    room: &mut u64,
    said: &mut FxHashMap<BlockIndex, StateBlock>,
) -> Result<()> {
    let children = u16::from_le_bytes(reader.array("2 bytes for each node with children")?);
    let side = 1 << (DEPTH - depth - 1);
    let corner_of = |child: i32| {
        let at = |bit: i32| side * (child >> bit & 1);
        Voxel::new(corner.x + at(0), corner.y + at(1), corner.z + at(2))
    };
    for child in 0..8 {
        let state = match children >> (2 * child) & 3 {
            1 => State::Free,
            2 => State::Occupied,
            3 if side == 1 => return Err(reader.wrong("no children below depth 16")),
            _ => continue,
        };
        let rule = "leaves of 2²³ voxels at most together";
        *room = room.checked_sub(1 << (3 * (DEPTH - depth - 1))).ok_or_else(|| reader.wrong(rule))?;
        fill(corner_of(child), side, state, said);
    }
    for child in 0..8 {
        if children >> (2 * child) & 3 == 3 {
            read_node(reader, corner_of(child), depth + 1, room, said)?;
        }
    }
    Ok(())
}

/// Sets all voxels of a leaf.
fn fill(corner: Voxel, side: i32, state: State, said: &mut FxHashMap<BlockIndex, StateBlock>) {
    let BlockIndex { x, y, z } = corner.block();
    if side < 8 {
        let block = said.entry(corner.block()).or_default();
        let first = voxel_bit(corner);
        for bit in 0..BLOCK_VOXELS {
            let [x, y, z] = bit_of(bit);
            if x < side && y < side && z < side {
                block.set(first + bit, state);
            }
        }
        return;
    }
    let all = [!0; 8];
    let whole = match state {
        State::Occupied => StateBlock::new([0; 8], all),
        _ => StateBlock::new(all, [0; 8]),
    };
    let blocks = side / 8;
    for dx in 0..blocks {
        for dy in 0..blocks {
            for dz in 0..blocks {
                said.insert(BlockIndex::new(x + dx, y + dy, z + dz), whole);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
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
                let end = |low: i32, size: i32| (low + size).min(HALF);
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
            let mut file = format!("# Octomap OcTree binary file\nid OcTree\nsize {}\nres 0.1\ndata\n", nodes + 1).into_bytes();
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
            let mut map = StateMap::default();
            apply(&message, &mut map).unwrap();
            prop_assert_eq!(Changes::from_blocks(map.blocks().collect()), changes);
        }
    }

    #[test]
    fn equal_neighbours_are_joined() {
        let cube = |side: i32| {
            let voxel = move |n: i32| (Voxel::new(n % side, n / side % side, n / side / side), State::Free);
            Changes::from_voxels((0..side.pow(3)).map(voxel))
        };
        // 13 levels with one child above a cube of 8³, 16 above a voxel.
        assert_eq!(encode(&cube(8)).unwrap(), {
            let (tree, _) = encode(&cube(8)).unwrap();
            (tree, 13)
        });
        assert_eq!(encode(&cube(8)).unwrap().0.len(), 26);
        assert_eq!(encode(&cube(1)).unwrap().0.len(), 32);
    }
}
