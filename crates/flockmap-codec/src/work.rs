//! How much work a payload may ask of its reader: counted in steps before each is taken, so that a short
//! payload is read in a short time whatever it says.

use flockmap_mutation::{self as mutation, Mutation};

use crate::codec::Codec;
use crate::error::PackageError;

/// Steps for each byte of payload. A step of `flock` is some 10 ns on the machine of `BENCHMARK.md`. Real
/// flights ask for 60 to 240 steps, and what asks for more is filled up or cut.
const STEPS_PER_BYTE: u64 = 224;
/// Steps that a payload may ask for beside, however short it is: its header has about as many bytes.
pub(crate) const STEPS_FREE: u64 = 6_144;

/// A block of 8³ voxels with changes in a payload, once for each stamp.
pub(crate) const BLOCK_STEPS: u64 = 128;
/// A payload, or a section of one, in the model of `flock`.
pub(crate) const SECTION_STEPS: u64 = 1_024;
/// More for a section of a snapshot: its adaptive state is carried to the next.
pub(crate) const CARRY_STEPS: u64 = 1_024;
/// A block of which `flock` says whether it changed.
const FLAG_STEPS: u64 = 8;
/// More for one of which something was known before: it is fetched from a large table, several at once.
const KNOWN_STEPS: u64 = 8;
/// A block that `flock` says has changed: its surroundings are put together, its rows gone through and put
/// back.
pub(crate) const CHANGED_STEPS: u64 = 128;
/// A block whose cells are taken in, of which something was known or changes: once, whatever looks at it.
pub(crate) const TAKEN_IN_STEPS: u64 = 24;
/// A decision by itself; a row whose unknown voxels are decided one by one, beside one step for each decision
/// of these.
pub(crate) const DECISION_STEPS: u64 = 2;
pub(crate) const ROW_STEPS: u64 = 6;
/// A change that is gap coded, and a block with changes: there are many that were not known, which takes
/// longer to merge than to read.
pub(crate) const CHANGE_STEPS: u64 = 16;
pub(crate) const GAP_CODED_BLOCK_STEPS: u64 = 320;
/// Places of blocks, those round a box with it, for one step: `flock` has a table of them.
const PLACES_PER_STEP: u64 = 4;
/// For a block of a part of a snapshot, to take it from where it is kept, and sort, check and note it: what a snapshot
/// costs to make beside what it costs to read.
pub(crate) const PART_BLOCK_STEPS: u64 = 256;
/// For a chunk to get its header.
pub(crate) const SEAL_STEPS: u64 = 1_024;
/// Voxels of a zlib stream for one step.
const VOXELS_PER_STEP: u64 = 32;
/// A group of codes that sets a voxel, and each byte of it that does.
const GROUP_STEPS: u64 = 128;
const CODE_BYTE_STEPS: u64 = 12;
/// Where a chunk has stamps: voxels of its box for one step, and steps for each known voxel.
const STAMPED_PER_STEP: u64 = 2;
const STAMP_STEPS: u64 = 8;

/// The most steps that a payload of so many bytes may ask for.
pub(crate) const fn limit(payload_bytes: usize) -> u64 {
    for_bytes(payload_bytes).saturating_add(STEPS_FREE)
}

/// The fewest bytes of payload that may ask for so many steps; inverse of [`limit`].
pub(crate) const fn bytes_min(steps: u64) -> usize {
    bytes_for(steps, STEPS_FREE)
}

/// The steps that so many bytes more give.
pub(crate) const fn for_bytes(bytes: usize) -> u64 {
    (bytes as u64).saturating_mul(STEPS_PER_BYTE)
}

/// The fewest bytes for so many steps, of which some are spare.
pub(crate) const fn bytes_for(steps: u64, spare: u64) -> usize {
    steps.saturating_sub(spare).div_ceil(STEPS_PER_BYTE) as usize
}

/// Steps for a zlib stream of so many voxels.
pub(crate) const fn of_stream(voxels: u64) -> u64 {
    voxels.div_ceil(VOXELS_PER_STEP)
}

/// Steps for so many groups of codes that set a voxel, with so many bytes that do.
pub(crate) const fn of_codes(groups: u64, bytes: u64) -> u64 {
    groups * GROUP_STEPS + bytes * CODE_BYTE_STEPS
}

/// Steps for the stamps of a chunk, if there are any.
pub(crate) const fn of_stamps(voxels: u64, known: u64) -> u64 {
    voxels.div_ceil(STAMPED_PER_STEP) + known * STAMP_STEPS
}

/// Steps for a block of which `flock` says whether it changed.
pub(crate) const fn of_flag(was_known: bool) -> u64 {
    if was_known { FLAG_STEPS + KNOWN_STEPS } else { FLAG_STEPS }
}

/// Steps for a box of so many blocks along each side, before anything is said of them.
pub(crate) fn of_box(size: [u64; 3]) -> u64 {
    let places = size.iter().fold(1u64, |places, side| places.saturating_mul(side.saturating_add(2)));
    SECTION_STEPS + places.div_ceil(PLACES_PER_STEP)
}

/// The steps that a payload has left.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Work {
    codec: Codec,
    payload: usize,
    limit: u64,
    taken: u64,
}

impl Work {
    pub(crate) const fn new(codec: Codec, payload_bytes: usize) -> Self {
        Self { codec, payload: payload_bytes, limit: limit(payload_bytes), taken: 0 }
    }

    /// Counts steps that are to be taken now.
    #[inline]
    pub(crate) fn take(&mut self, steps: u64) -> Result<(), PackageError> {
        let Self { codec, payload, limit, taken } = *self;
        let taken = taken.saturating_add(steps);
        if taken > limit && !mutation::is(Mutation::WorkUnlimited) {
            return Err(PackageError::Work { codec, payload, limit });
        }
        self.taken = taken;
        Ok(())
    }

    /// Steps so far.
    pub(crate) const fn taken(&self) -> u64 {
        self.taken
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fewest_bytes_are_the_fewest() {
        for steps in (0..2_000).chain([6_143, 6_144, 6_145, 6_368, 6_369, 1 << 40]) {
            let bytes = bytes_min(steps);
            assert!(limit(bytes) >= steps);
            assert!(bytes == 0 || limit(bytes - 1) < steps, "{steps}");
        }
    }

    #[test]
    fn what_goes_beyond_is_refused_and_says_so() {
        let mut work = Work::new(Codec::Paper, 10);
        assert_eq!(work.take(limit(10)), Ok(()));
        let error = work.take(1).unwrap_err();
        assert_eq!(
            error.to_string(),
            "package payload (paper) of 10 bytes asks for more than 8384 steps of work, the most for that length"
        );
        assert!(work.take(u64::MAX).is_err());
    }
}
