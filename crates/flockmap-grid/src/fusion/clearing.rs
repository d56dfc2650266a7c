//! What a newer submap clears of older ones.

use core::cmp::Reverse;

use super::part::{Part, Said};
use crate::{Plane, StateBlock};

/// Of what was said of one block, obstacles of a submap go that lie within so many voxels of those of a newer submap of
/// the same run: it is the same wall, seen anew. What the newer one says itself stays. O(parts · log parts).
pub(super) fn clear_older(said: &mut [Said], parts: &[Part<'_>], voxels: u8) {
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
    for _ in 0..voxels {
        let rows = all.map(|word| word | (word << 1 & !FIRST_X) | (word >> 1 & !(FIRST_X << 7)));
        let slices = rows.map(|word| word | word << 8 | word >> 8);
        all = core::array::from_fn(|z| slices[z] | slices[z.saturating_sub(1)] | slices[(z + 1).min(7)]);
    }
    all
}
