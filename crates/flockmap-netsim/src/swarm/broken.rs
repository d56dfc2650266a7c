//! A sender with a fault in its memory: it damages packages before the check of the datagram is made, so that
//! only the check of the decoded content finds it.

use super::purpose;
use flockmap::sync::wire::HEADER_BYTES;
use flockmap::{RobotId, Stream};
use flockmap_worlds::random::Random;
use std::collections::BTreeMap;

/// Where the check of a datagram stands: a CRC-32 of all else.
const CHECK: core::ops::Range<usize> = 24..28;
/// Bytes at the end of a datagram: the payload of its last package, and of a small one the end of its header too.
const TAIL: usize = 12;

/// All senders with such a fault, and what they did.
pub(super) struct Broken {
    random: Random,
    /// Damaged packages of each stream that were sent to each robot.
    packages: BTreeMap<(RobotId, Stream), u32>,
}

impl Broken {
    pub(super) fn new(seed: u64) -> Self {
        Self { random: Random::new(seed, purpose::BROKEN), packages: BTreeMap::new() }
    }

    /// With this probability: the datagram damaged, whose last package is of this stream.
    pub(super) fn damage(
        &mut self,
        probability: f64,
        bytes: &[u8],
        to: impl Iterator<Item = RobotId>,
        of: Stream,
    ) -> Option<Vec<u8>> {
        if probability <= 0.0 || !self.random.happens(probability) {
            return None;
        }
        let damaged = damaged_inside(bytes, &mut self.random)?;
        for robot in to {
            *self.packages.entry((robot, of)).or_default() += 1;
        }
        Some(damaged)
    }

    /// The most damaged packages of one stream that one robot was sent.
    pub(super) fn packages_max(&self) -> u32 {
        self.packages.values().copied().max().unwrap_or(0)
    }
}

/// A datagram of packages with one bit of the last package flipped, and a check that is right.
fn damaged_inside(bytes: &[u8], random: &mut Random) -> Option<Vec<u8>> {
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
