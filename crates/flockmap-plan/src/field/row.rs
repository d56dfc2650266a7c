//! The first pass: squared distances along x, from bits.

use super::cell::{Cell, Group, LANES};

/// Bytes of a row in a group.
pub(super) const GROUP_BYTES: usize = LANES / 8;

/// No obstacle. Far from the largest `u16`, so that a few voxels may be added.
const NONE: u16 = u16::MAX;

/// For each byte and each of its bits: voxels to the nearest bit that is set in it.
static NEAREST: [[u16; 8]; 256] = {
    let mut table = [[NONE; 8]; 256];
    let mut at: usize = 0;
    while at < 256 * 64 {
        let (byte, bit, x) = (at >> 6, at >> 3 & 7, at & 7);
        let distance = bit.abs_diff(x) as u16;
        if byte >> bit & 1 == 1 && distance < table[byte][x] {
            table[byte][x] = distance;
        }
        at += 1;
    }
    table
};

/// Squared distances to the nearest bit that is set in a row; bit 0 of byte 0 is the lowest x. There are
/// [`GROUP_BYTES`] bytes for each group. `to_right` is room for one number for each byte.
pub(super) fn row<T: Cell>(bytes: &[u8], to_right: &mut [u16], mut out: impl FnMut(usize, Group<T>)) {
    // From the last voxel of each byte to what is set right of it.
    let mut distance = NONE;
    for (byte, to_right) in bytes.iter().zip(&mut *to_right).rev() {
        *to_right = distance;
        distance = if *byte == 0 { distance.saturating_add(8) } else { byte.trailing_zeros() as u16 + 1 };
    }
    // From the first voxel of the byte to what is set left of it.
    let mut to_left = NONE;
    for (group, (bytes, to_right)) in
        bytes.chunks_exact(GROUP_BYTES).zip(to_right.chunks_exact(GROUP_BYTES)).enumerate()
    {
        let mut squares = [T::NONE; LANES];
        for (at, (byte, to_right)) in bytes.iter().zip(to_right).enumerate() {
            let near = &NEAREST[usize::from(*byte)];
            for x in 0..8u16 {
                let beyond = to_left.saturating_add(x).min(to_right.saturating_add(7 - x));
                squares[at * 8 + usize::from(x)] = T::square(near[usize::from(x)].min(beyond));
            }
            to_left = if *byte == 0 { to_left.saturating_add(8) } else { byte.leading_zeros() as u16 + 1 };
        }
        out(group, squares);
    }
}
