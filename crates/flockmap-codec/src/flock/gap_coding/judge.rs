//! Whether changes have a pattern.

use flockmap_grid::{BLOCK_SIDE, Changes, Plane, StateBlock, VoxelBox};

use super::cut::estimate_of;
use super::limits::voxels_max;

/// Whether gap coding is worth trying: neither the places of the changes nor their states hang together.
/// `region` is the tight box of `changes`. Compares neighbours along x, y and z with what changes thrown
/// anywhere into the box would show.
///
/// Of a few dozen changes nothing certain can be said, and the answer is often yes, as it is for sparse
/// obstacles: compare [`estimate`](super::cut::estimate) with what another mode took, and code only the
/// smaller. For what it would say in less than two thirds of a bit a change (a full box of one state), the
/// answer is no. O(blocks), two passes over their words at most.
pub(crate) fn has_no_pattern(changes: &Changes, region: &VoxelBox) -> bool {
    let blocks = changes.blocks().iter();
    let count =
        |of: fn(&StateBlock) -> u64| i128::from(blocks.clone().map(|(_, block)| of(block)).sum::<u64>());
    let occupied = count(|block| ones(block.occupied().iter().copied()));
    let (voxels, changed) = (region.volume() as i128, changes.len() as i128);
    // Of all pairs of neighbours in the box: how many would be changed both if they fell at random, and how
    // many more are?
    let pairs = count(|block| pairs_in(&block.known()));
    let expected = pairs_of(region) * changed / voxels * changed / voxels;
    // All pairs of a pure pattern.
    let most = pairs_of(region) * changed / voxels;
    if pairs - expected > (most - expected) / 20 + luck(expected) {
        return false;
    }
    // The same for the states of the pairs.
    let equal = count(|block| pairs_in(block.free()) + pairs_in(block.occupied()));
    let free = changed - occupied;
    let expected = pairs * (free * free + occupied * occupied) / (changed * changed).max(1);
    if equal - expected > (pairs - expected) / 10 + luck(pairs - expected) {
        return false;
    }
    // Without zeros for the work of its blocks: what needs them has a pattern.
    let payload = estimate_of(region, 0, changes.len(), occupied as usize);
    changes.len() <= voxels_max(payload.saturating_sub(8))
}

/// How far a count of independent things that is so large on average hardly ever strays.
fn luck(average: i128) -> i128 {
    4 * average.max(0).isqrt() + 4
}

/// Pairs of neighbours in a box that are in one block.
fn pairs_of(region: &VoxelBox) -> i128 {
    let (min, max) = (region.min().block(), region.max().block());
    let blocks = [max.x - min.x, max.y - min.y, max.z - min.z].map(|steps| i128::from(steps) + 1);
    let volume = region.volume() as i128;
    let along = |(side, blocks): (u32, i128)| volume / i128::from(side) * (i128::from(side) - blocks);
    region.size().into_iter().zip(blocks).map(along).sum()
}

/// Bits of a slice whose neighbour at x + 1 is in the block, and at y + 1.
const HAS_NEXT_X: u64 = 0x7f7f_7f7f_7f7f_7f7f;
const HAS_NEXT_Y: u64 = u64::MAX >> BLOCK_SIDE;

/// Neighbours in a block that are set both.
fn pairs_in(plane: &Plane) -> u64 {
    let along_x = ones(plane.iter().map(|word| word & word >> 1 & HAS_NEXT_X));
    let along_y = ones(plane.iter().map(|word| word & word >> 8 & HAS_NEXT_Y));
    along_x + along_y + ones(plane.iter().zip(plane.iter().skip(1)).map(|(word, next)| word & next))
}

fn ones(words: impl Iterator<Item = u64>) -> u64 {
    words.map(|word| u64::from(word.count_ones())).sum()
}

#[cfg(test)]
mod tests {
    use super::super::tests::{Draw, Random, ball, draw, rays};
    use super::*;
    use flockmap_grid::{State, Voxel};

    fn judged(changes: &Changes) -> bool {
        has_no_pattern(changes, &changes.bounding_box().unwrap())
    }

    #[test]
    fn random_draws_have_none() {
        for seed in 0..200u64 {
            let mut random = Random(seed);
            let size = core::array::from_fn(|_| 1 + random.below(70) as u32);
            let mut d = Draw::of_ratio(size, 10f64.powf(-4.0 * random.below(1_001) as f64 / 1_000.0), seed);
            d.occupied_of_four = 1 + random.below(3);
            assert!(judged(&draw(&d)), "{d:?}");
        }
        for size in [[32; 3], [64; 3], [1, 300, 200], [500, 1, 2]] {
            for ratio in [0.001, 0.01, 0.1, 0.5, 0.9, 1.0] {
                assert!(judged(&draw(&Draw::of_ratio(size, ratio, 11))), "{size:?} {ratio}");
            }
        }
    }

    #[test]
    fn what_a_sensor_sees_has_one() {
        for seed in 0..10 {
            for radius in [6, 12, 25] {
                assert!(!judged(&ball(radius, seed)), "ball of {radius}");
            }
            for (count, length) in [(3, 60), (20, 40), (100, 70), (1_000, 40)] {
                assert!(!judged(&rays(count, length, seed)), "{count} rays of {length}");
            }
        }
        // Every voxel of the box changed; only the states show that it is a wall of obstacles.
        let wall = |v: Voxel| if v.x == 20 { State::Occupied } else { State::Free };
        let full = VoxelBox::new(Voxel::new(0, 0, 0), [40, 33, 20]).unwrap();
        assert!(!judged(&Changes::from_voxels(full.voxels().map(|v| (v, wall(v))))));
        // One state in the whole box.
        assert!(!judged(&Changes::from_voxels(full.voxels().map(|v| (v, State::Free)))));
    }

    #[test]
    fn one_voxel_and_a_box_too_large_do_not_matter() {
        let far = 1 << 28;
        for voxels in [&[Voxel::new(1, 2, 3)][..], &[Voxel::new(-far, -far, -far), Voxel::new(far, far, far)]]
        {
            judged(&Changes::from_voxels(voxels.iter().map(|v| (*v, State::Free))));
        }
        let nothing = VoxelBox::new(Voxel::new(0, 0, 0), [1; 3]).unwrap();
        has_no_pattern(&Changes::default(), &nothing);
    }
}
