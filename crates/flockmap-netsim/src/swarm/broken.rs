//! A sender with a fault in its memory: it damages packages before the check of the datagram is made, so that only the check of the
//! decoded content finds it.

use flockmap::sync::wire::HEADER_BYTES;
use flockmap_worlds::random::Random;

/// Where the check of a datagram stands: a CRC-32 of all else.
const CHECK: core::ops::Range<usize> = 24..28;
/// Bytes at the end of a datagram, which are the payload of its last package.
const TAIL: usize = 12;

/// A datagram of packages with one bit of the last package flipped, and a check that is right.
pub(super) fn damaged_inside(bytes: &[u8], random: &mut Random) -> Option<Vec<u8>> {
    let tail = TAIL.min(bytes.len().checked_sub(HEADER_BYTES + 40)?);
    if tail == 0 {
        return None;
    }
    let mut bytes = bytes.to_vec();
    let at = bytes.len() - 1 - random.below(tail as u64) as usize;
    bytes[at] ^= 1 << random.below(8);
    write_check(&mut bytes);
    Some(bytes)
}

/// Makes the check of a datagram right.
pub(super) fn write_check(bytes: &mut [u8]) {
    let mut check = crc32fast::Hasher::new();
    check.update(&bytes[..CHECK.start]);
    check.update(&bytes[CHECK.end..]);
    bytes[CHECK].copy_from_slice(&check.finalize().to_le_bytes());
}
