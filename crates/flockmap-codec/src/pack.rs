//! Four 2-bit codes to a byte, the first in the lowest two bits.

/// KnownFree in the paper.
pub(crate) const FREE: u8 = 0b00;
/// Occupied in the paper.
pub(crate) const OCCUPIED: u8 = 0b01;
/// Unknown in the paper: only in a present state.
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
