//! What gap coding costs, and cutting to a size.
//!
//! The cost follows from three numbers, wherever the changes lie: voxels, changes, changes to Occupied.

use flockmap_grid::{Changes, VoxelBox};

use super::limits::bytes_min;
use crate::flock::block_box::BlockBox;
use crate::flock::log2::log2;
use crate::limits::BOX_VOXELS_MAX;
use crate::piece::{Measure, Piece};

/// The most bytes that [`encode`](super::encode) takes for `changes` in `region`, and seldom five more than
/// it takes; `usize::MAX` if the box has more than [`BOX_VOXELS_MAX`] voxels. O(blocks).
pub(crate) fn estimate(changes: &Changes, region: &VoxelBox) -> usize {
    let occupied = changes
        .blocks()
        .iter()
        .flat_map(|(_, block)| block.occupied())
        .map(|word| word.count_ones() as usize);
    estimate_of(region, changes.blocks().len(), changes.len(), occupied.sum())
}

/// [`estimate`] from the numbers of blocks, of changes and of changes to Occupied.
pub(super) fn estimate_of(region: &VoxelBox, blocks: usize, changes: usize, occupied: usize) -> usize {
    let voxels = region.volume();
    if voxels > u128::from(BOX_VOXELS_MAX) {
        return usize::MAX;
    }
    // What the varying probability of a state costs beyond the entropy, and what the law of the gaps, which
    // is the true one for many changes only, and the unused part of the last byte can cost.
    let slack = u128::from(log2(changes as u64 + 1)) + (8 << 32);
    // Three bits for each two of the number of changes, and two for their end.
    let number = (u128::from(3 * changes.checked_ilog2().unwrap_or(0)) << 31) + (2 << 32);
    let bits =
        number + choice(voxels as u64, changes as u64) + choice(changes as u64, occupied as u64) + slack;
    ((bits >> 32).div_ceil(8) as usize).max(bytes_min(changes, blocks))
}

/// The entropy of a choice of `some` out of `all`, all · h(some / all), in 2⁻³² bits; at most 2²⁷ of each.
fn choice(all: u64, some: u64) -> u128 {
    let term = |n: u64| u128::from(n) * u128::from(log2(n));
    term(all).saturating_sub(term(some) + term(all.saturating_sub(some)))
}

/// The changes in pieces of at most `payload_max` bytes each, with the tight box of each. No two share a
/// voxel. A voxel that does not fit is a piece all the same (it takes 3 bytes).
///
/// Cuts across the longest side of the box until each piece fits by [`estimate`] in a box of whole blocks;
/// nothing is coded meanwhile.
pub(crate) fn cut(changes: &Changes, payload_max: usize) -> Vec<(VoxelBox, Changes)> {
    let mut done = Vec::new();
    let mut waiting: Vec<Piece> = Piece::new(changes.clone(), Vec::new()).into_iter().collect();
    while let Some(piece) = waiting.pop() {
        let needed = BlockBox::around(&piece.region)
            .voxels()
            .map_or(usize::MAX, |region| estimate(&piece.states, &region));
        let halves = if needed <= payload_max {
            None
        } else {
            let pieces = if needed == usize::MAX { 2 } else { needed.div_ceil(payload_max.max(1)).max(2) };
            piece.cut(pieces / 2, pieces, Measure::Voxels)
        };
        match halves {
            Some([head, tail]) => waiting.extend([tail, head]),
            None => done.push((piece.region, piece.states)),
        }
    }
    done
}

#[cfg(test)]
mod tests;
