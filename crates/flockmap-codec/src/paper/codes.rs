//! Codes of two bits, four to a byte, the first in the lowest two bits; and where among many of them those
//! are that set a voxel, so that what says nothing costs next to nothing.

use crate::work;

/// KnownFree in the paper.
pub(crate) const FREE: u8 = 0b00;
/// Occupied in the paper.
pub(crate) const OCCUPIED: u8 = 0b01;
/// Unknown in the paper: only in a snapshot.
pub(crate) const UNKNOWN: u8 = 0b10;
/// Unchanged in the paper: only among changes.
pub(crate) const UNCHANGED: u8 = 0b11;

/// Bytes that this many codes take.
pub(crate) fn packed_len(codes: usize) -> usize {
    codes.div_ceil(4)
}

/// Packs codes, one a byte, into `packed`. Bits after the last code are zero.
pub(crate) fn pack(codes: &[u8], packed: &mut Vec<u8>) {
    packed.clear();
    packed.reserve(packed_len(codes.len()));
    let (fours, rest) = codes.as_chunks::<4>();
    packed.extend(fours.iter().map(|c| c[0] | c[1] << 2 | c[2] << 4 | c[3] << 6));
    if !rest.is_empty() {
        packed.push(rest.iter().rev().fold(0, |byte, code| byte << 2 | code));
    }
}

/// Bytes of codes that are looked at as one.
pub(crate) const GROUP_BYTES: usize = 128;
/// Codes in a byte.
pub(crate) const PER_BYTE: usize = 4;

/// Packed codes, in the order of their codec.
#[derive(Clone, Copy)]
pub(crate) struct Codes<'a> {
    pub(crate) packed: &'a [u8],
    /// A byte of codes that set no voxel.
    pub(crate) nothing: u8,
}

impl<'a> Codes<'a> {
    /// `background` is the code of a voxel that is not set; the bits after the last code are the same as
    /// if there were more of these.
    pub(crate) const fn new(packed: &'a [u8], background: u8) -> Self {
        Self { packed, nothing: background * 0b0101_0101 }
    }

    /// The bytes of each group that sets a voxel, with the number of the first.
    pub(crate) fn groups(self) -> impl Iterator<Item = (usize, &'a [u8])> {
        let nothing = u64::from_le_bytes([self.nothing; 8]);
        let firsts = (0..self.packed.len()).step_by(GROUP_BYTES);
        firsts.zip(self.packed.chunks(GROUP_BYTES)).filter(move |(_, group)| {
            let (words, rest) = group.as_chunks::<8>();
            let words = words.iter().fold(0, |all, word| all | (u64::from_le_bytes(*word) ^ nothing));
            words != 0 || rest.iter().any(|byte| *byte != self.nothing)
        })
    }

    /// The steps that it takes to find the voxels.
    pub(crate) fn steps(self) -> u64 {
        let codes_in = |group: &[u8]| group.iter().filter(|byte| **byte != self.nothing).count() as u64;
        let count = |(groups, bytes), (_, group)| (groups + 1, bytes + codes_in(group));
        let (groups, bytes) = self.groups().fold((0, 0), count);
        work::of_codes(groups, bytes)
    }
}
