//! What parts say of voxels of the fused map, and what of that a newer submap clears.

use core::cmp::Reverse;

use super::part::Part;
use crate::{BlockIndex, Plane, StateBlock};

/// What a part says of voxels of a target.
pub(super) struct Said {
    pub target: usize,
    /// The number of the part.
    pub part: usize,
    pub states: StateBlock,
}

/// What parts say of voxels of the fused map, target by target. Of a crowd few know something. Where newer submaps clear
/// older ones, targets are whole blocks.
pub(super) fn said_of(parts: &[Part<'_>], targets: &[(BlockIndex, Plane)], clears: u8) -> Vec<Said> {
    let mut all = Vec::new();
    for (number, part) in parts.iter().enumerate() {
        part.blocks(targets, |target, states| all.push(Said { target, part: number, states }));
    }
    all.sort_by_key(|said| said.target);
    if clears > 0 {
        for of_target in all.chunk_by_mut(|a, b| a.target == b.target) {
            clear_older(of_target, parts, clears);
        }
    }
    all
}

/// Of what was said of one block, obstacles of a submap go that lie within so many voxels of those of a newer submap of
/// the same run: it is the same wall, seen anew. What the newer one says itself stays. O(parts · log parts).
fn clear_older(said: &mut [Said], parts: &[Part<'_>], voxels: u8) {
    let mut newest_first: Vec<usize> = (0..said.len()).collect();
    let place_of = |said: &Said| (parts[said.part].stream, Reverse(parts[said.part].submap));
    newest_first.sort_by_key(|at| place_of(&said[*at]));
    let (mut place, mut stream) = (None, None);
    // Of newer submaps, and with those of this one.
    let (mut newer, mut seen) = ([0; 8], [0; 8]);
    for at in newest_first {
        let now = place_of(&said[at]);
        if stream.replace(now.0) != Some(now.0) {
            (newer, seen) = ([0; 8], [0; 8]);
        } else if place != Some(now) {
            newer = grown(&seen, voxels);
        }
        place = Some(now);
        let states = said[at].states;
        let occupied = states.occupied();
        seen = core::array::from_fn(|z| seen[z] | occupied[z]);
        let left = core::array::from_fn(|z| occupied[z] & !newer[z]);
        said[at].states = StateBlock::new(*states.free(), left);
    }
}

/// Voxels of a block and those of it that lie within so many of one, diagonally too.
fn grown(plane: &Plane, voxels: u8) -> Plane {
    const FIRST_X: u64 = 0x0101_0101_0101_0101;
    let mut all = *plane;
    for _ in 0..voxels.min(7) {
        let rows = all.map(|word| word | (word << 1 & !FIRST_X) | (word >> 1 & !(FIRST_X << 7)));
        let slices = rows.map(|word| word | word << 8 | word >> 8);
        all = core::array::from_fn(|z| slices[z] | slices[z.saturating_sub(1)] | slices[(z + 1).min(7)]);
    }
    all
}
