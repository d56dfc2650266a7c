//! What each part contributes to blocks of the fused map, and what of that a newer submap clears.

use core::cmp::Reverse;

use super::part::Part;
use crate::{BlockIndex, Plane, StateBlock};

/// What a part knows of one block of the fused map.
pub(super) struct Contribution {
    /// The number of the block among those asked for.
    pub target: usize,
    /// The number of the part.
    pub part: usize,
    pub states: StateBlock,
}

/// What parts know of voxels of the fused map, block by block; of many parts few know something of a block. `clears`: within
/// so many voxels newer submaps clear older ones; then targets are whole blocks.
pub(super) fn contributions(
    parts: &[Part<'_>],
    targets: &[(BlockIndex, Plane)],
    clears: u8,
) -> Vec<Contribution> {
    let mut all = Vec::new();
    for (number, part) in parts.iter().enumerate() {
        part.blocks(targets, |target, states| all.push(Contribution { target, part: number, states }));
    }
    all.sort_by_key(|one| one.target);
    if clears > 0 {
        for of_target in all.chunk_by_mut(|a, b| a.target == b.target) {
            clear_older(of_target, parts, clears);
        }
    }
    all
}

/// Takes obstacles of a submap out of one block that lie within so many voxels of those of a newer submap of the same run:
/// it is the same wall, seen anew. What the newer one has itself stays. O(parts · log parts).
fn clear_older(block: &mut [Contribution], parts: &[Part<'_>], voxels: u8) {
    let mut newest_first: Vec<usize> = (0..block.len()).collect();
    let submap_of = |one: &Contribution| (parts[one.part].stream, Reverse(parts[one.part].submap));
    newest_first.sort_by_key(|at| submap_of(&block[*at]));
    let (mut submap, mut stream) = (None, None);
    // Voxels near obstacles of newer submaps; obstacles of those and of this one.
    let (mut near, mut seen) = ([0; 8], [0; 8]);
    for at in newest_first {
        let now = submap_of(&block[at]);
        if stream.replace(now.0) != Some(now.0) {
            (near, seen) = ([0; 8], [0; 8]);
        } else if submap != Some(now) {
            near = dilated(&seen, voxels);
        }
        submap = Some(now);
        let states = block[at].states;
        let occupied = states.occupied();
        seen = core::array::from_fn(|z| seen[z] | occupied[z]);
        let left = core::array::from_fn(|z| occupied[z] & !near[z]);
        block[at].states = StateBlock::new(*states.free(), left);
    }
}

/// These voxels of a block, with all of it that lie within so many voxels of one, diagonally too.
fn dilated(plane: &Plane, voxels: u8) -> Plane {
    const FIRST_X: u64 = 0x0101_0101_0101_0101;
    let mut all = *plane;
    for _ in 0..voxels {
        let rows = all.map(|word| word | (word << 1 & !FIRST_X) | (word >> 1 & !(FIRST_X << 7)));
        let slices = rows.map(|word| word | word << 8 | word >> 8);
        all = core::array::from_fn(|z| slices[z] | slices[z.saturating_sub(1)] | slices[(z + 1).min(7)]);
    }
    all
}
