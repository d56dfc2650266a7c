//! How many changes so many bytes may hold.

use crate::work;

/// The most changes in a payload of this many bytes: 12 for each byte, and 64.
///
/// Changes drawn at random cost two thirds of a bit or more, unless nearly all of a box changed to one state.
/// Payloads that would be shorter (a full box that became Free costs next to nothing) are filled up with
/// zeros, so that a short payload never makes a receiver hold a large map. A change takes a block of 144
/// bytes at most, hence 1.7 KB for each byte of payload, and three times that while the list of blocks grows.
pub(crate) const fn voxels_max(payload_bytes: usize) -> usize {
    payload_bytes.saturating_mul(CHANGES_PER_BYTE).saturating_add(CHANGES_FREE)
}

const CHANGES_PER_BYTE: usize = 12;
const CHANGES_FREE: usize = 64;

/// The fewest bytes of payload that may hold so many changes in so many blocks.
pub(crate) const fn bytes_min(changes: usize, blocks: usize) -> usize {
    let for_changes = changes.saturating_sub(CHANGES_FREE).div_ceil(CHANGES_PER_BYTE);
    let for_work = work::bytes_min(steps(changes, blocks));
    if for_changes > for_work { for_changes } else { for_work }
}

/// Steps of work for so many changes in so many blocks.
pub(crate) const fn steps(changes: usize, blocks: usize) -> u64 {
    changes as u64 * work::CHANGE_STEPS + blocks as u64 * work::GAP_CODED_BLOCK_STEPS
}
