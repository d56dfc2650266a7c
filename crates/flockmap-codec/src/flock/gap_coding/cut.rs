//! What gap coding costs, and cutting to a size.
//!
//! The cost follows from three numbers, wherever the changes lie: voxels, changes, changes to Occupied.

use flockmap_grid::{Changes, VoxelBox};

use super::limits::bytes_min;
use crate::flock::block_box::BlockBox;
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

/// The logarithm to base 2 in 2⁻³², rounded down; 0 for 0.
fn log2(value: u64) -> u64 {
    let Some(whole) = value.checked_ilog2() else { return 0 };
    // 1 ≤ mantissa < 2 in 2⁻⁶³; its square is 2 or more if the next bit of the logarithm is set.
    let mut mantissa = value << (63 - whole);
    let mut log = u64::from(whole);
    for _ in 0..32 {
        let square = (u128::from(mantissa) * u128::from(mantissa)) >> 63;
        let bit = (square >> 64) as u64;
        mantissa = (square >> bit) as u64;
        log = log << 1 | bit;
    }
    log
}

/// The changes in pieces of at most `payload_max` bytes each, with the tight box of each. No two share a
/// voxel. A voxel that does not fit is a piece all the same (it takes 3 bytes).
///
/// Cuts across the longest side of the box until each piece fits by [`estimate`] in a box of whole blocks;
/// nothing is coded on the way.
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
mod tests {
    use super::super::payload::encode;
    use super::super::tests::{Draw, any_changes, draw};
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn logarithms_are_right() {
        for value in (0..64)
            .flat_map(|bit| [1u64 << bit, (1 << bit) + (1 << bit >> 1), (1 << bit) / 3 + 1, u64::MAX >> bit])
        {
            let expected = (value as f64).log2() * 4_294_967_296.0;
            assert!((log2(value) as f64 - expected).abs() < 64.0, "{value}");
        }
    }

    proptest! {
        #[test]
        fn no_payload_is_longer_than_its_estimate(changes in any_changes()) {
            let region = changes.bounding_box().unwrap();
            let mut payload = Vec::new();
            encode(&changes, &region, &mut payload);
            prop_assert!(payload.len() <= estimate(&changes, &region));
        }

        #[test]
        fn pieces_fit_and_hold_every_change_once(changes in any_changes(), payload_max in 40..1_200usize) {
            let pieces = cut(&changes, payload_max);
            for (region, piece) in &pieces {
                prop_assert_eq!(piece.bounding_box(), Some(*region));
                let mut payload = Vec::new();
                encode(piece, region, &mut payload);
                prop_assert!(payload.len() <= payload_max);
            }
            prop_assert_eq!(pieces.iter().map(|(_, piece)| piece.len()).sum::<usize>(), changes.len());
            let blocks = pieces.into_iter().flat_map(|(_, piece)| piece.blocks().to_vec()).collect();
            prop_assert_eq!(Changes::from_blocks(blocks), changes);
        }
    }

    #[test]
    fn estimates_of_random_draws_are_nearly_exact() {
        for (n, ratio) in [1e-4, 1e-3, 1e-2, 0.1, 0.3, 0.5, 0.9, 1.0].into_iter().enumerate() {
            let changes = draw(&Draw::of_ratio([64; 3], ratio, n as u64));
            let region = changes.bounding_box().unwrap();
            let mut payload = Vec::new();
            encode(&changes, &region, &mut payload);
            let estimate = estimate(&changes, &region);
            assert!(
                (payload.len()..=payload.len() + 7).contains(&estimate),
                "{ratio}: {estimate} for {}",
                payload.len()
            );
        }
    }

    #[test]
    fn pieces_of_a_large_draw_are_nearly_full() {
        let changes = draw(&Draw::of_ratio([64, 128, 64], 0.05, 7));
        let whole = estimate(&changes, &changes.bounding_box().unwrap());
        let pieces = cut(&changes, 1_110);
        let cost: usize = pieces.iter().map(|(region, piece)| estimate(piece, region)).sum();
        assert!(cost <= whole * 103 / 100, "{cost} bytes in {} pieces, {whole} as one", pieces.len());
        assert!(pieces.len() <= whole * 14 / 10 / 1_110 + 1, "{} pieces for {whole} bytes", pieces.len());
    }

    #[test]
    fn what_is_far_apart_is_cut_without_a_box_around_it() {
        use flockmap_grid::{State, Voxel};
        let far = 1 << 20;
        let changes = Changes::from_voxels([
            (Voxel::new(0, 0, 0), State::Free),
            (Voxel::new(far, far, -far), State::Occupied),
        ]);
        assert_eq!(estimate(&changes, &changes.bounding_box().unwrap()), usize::MAX);
        let sizes: Vec<_> = cut(&changes, 100).iter().map(|(region, _)| region.size()).collect();
        assert_eq!(sizes, [[1; 3]; 2]);
        assert_eq!(cut(&Changes::default(), 100), []);
    }
}
