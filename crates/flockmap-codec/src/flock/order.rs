//! The order of blocks: octant by octant round the sensor, in each from far to near.
//!
//! What lies behind a voxel is coded before it. If a far voxel was freed, then the ray that freed it went
//! through the near ones, which says more of these than they say of the far one.

use flockmap_grid::{BlockIndex, Changes, StateBlock};

use super::block_box::{BLOCK_UNITS, BlockBox};

/// A block with its changes.
pub(crate) type Changed<'a> = &'a (BlockIndex, StateBlock);

/// The blocks of a batch in the order.
pub(crate) fn in_order(changes: &Changes, sensor: [i32; 3]) -> Vec<Changed<'_>> {
    let sensor = sensor_block(sensor);
    let mut blocks: Vec<_> = changes.blocks().iter().collect();
    blocks.sort_by_cached_key(|(index, _)| key(*index, sensor));
    blocks
}

/// Some of these blocks as changes again.
pub(crate) fn changes_of(blocks: &[Changed<'_>]) -> Changes {
    Changes::from_blocks(blocks.iter().map(|block| **block).collect())
}

/// The block in which the sensor is.
pub(crate) fn sensor_block(sensor: [i32; 3]) -> [i32; 3] {
    sensor.map(|at| i64::from(at).div_euclid(BLOCK_UNITS) as i32)
}

/// Sorts blocks into the order.
fn key(block: BlockIndex, sensor_block: [i32; 3]) -> (u8, [i32; 3]) {
    let at = [block.x, block.y, block.z];
    let is_above: [bool; 3] = core::array::from_fn(|a| at[a] > sensor_block[a]);
    let octant = u8::from(is_above[0]) | u8::from(is_above[1]) << 1 | u8::from(is_above[2]) << 2;
    // Blocks of the grid are far from the ends of 32 bits.
    let along = |a: usize| if is_above[a] { at[a].wrapping_neg() } else { at[a] };
    (octant, [along(2), along(1), along(0)])
}

/// The blocks of a box in order, without so many from the front. O(1) for each, and for those that are left
/// out.
pub(crate) fn blocks(
    region: BlockBox,
    sensor_block: [i32; 3],
    before: u64,
) -> impl Iterator<Item = BlockIndex> {
    let mut before = before;
    (0..8usize).flat_map(move |octant| {
        let mut octant = Octant::new(core::array::from_fn(|a| {
            side(region.min[a], region.max[a], sensor_block[a], octant >> a & 1 == 1)
        }));
        before = octant.pass(before);
        octant
    })
}

/// The blocks of a box on one side of the sensor along each axis.
struct Octant {
    sides: [Side; 3],
    /// How many have been passed along each axis.
    at: [u32; 3],
}

/// Places along an axis, far to near.
#[derive(Clone, Copy)]
struct Side {
    from: i32,
    step: i32,
    count: u32,
}

impl Octant {
    fn new(sides: [Side; 3]) -> Self {
        // Without blocks along one axis there are none at all.
        let is_empty = sides.iter().any(|side| side.count == 0);
        Self { sides, at: [0, 0, if is_empty { sides[2].count } else { 0 }] }
    }

    /// Leaves out so many blocks from the front, or all; returns how many more there were to leave out.
    fn pass(&mut self, blocks: u64) -> u64 {
        let [x, y, z] = self.sides.map(|side| u64::from(side.count));
        let all = u128::from(x) * u128::from(y) * u128::from(z);
        if u128::from(blocks) >= all {
            self.at = [0, 0, self.sides[2].count];
            return blocks - all as u64;
        }
        self.at = [blocks % x, blocks / x % y, blocks / x / y].map(|at| at as u32);
        0
    }
}

impl Iterator for Octant {
    type Item = BlockIndex;

    #[inline]
    fn next(&mut self) -> Option<BlockIndex> {
        let [x, y, z] = self.at;
        if z >= self.sides[2].count {
            return None;
        }
        let along = |axis: usize, n: u32| {
            let Side { from, step, .. } = self.sides[axis];
            from.wrapping_add(step.wrapping_mul(n as i32))
        };
        let block = BlockIndex::new(along(0, x), along(1, y), along(2, z));
        self.at = if x + 1 < self.sides[0].count {
            [x + 1, y, z]
        } else if y + 1 < self.sides[1].count {
            [0, y + 1, z]
        } else {
            [0, 0, z + 1]
        };
        Some(block)
    }
}

/// The places along an axis on one side of the sensor.
fn side(min: i32, max: i32, sensor: i32, is_above: bool) -> Side {
    let (from, to) = if is_above {
        (i64::from(max), i64::from(min).max(i64::from(sensor) + 1))
    } else {
        (i64::from(min), i64::from(max).min(i64::from(sensor)))
    };
    let count = if is_above { from - to + 1 } else { to - from + 1 };
    // A box lies in the grid, so that sides have fewer than 2³² blocks.
    Side {
        from: from as i32,
        step: if is_above { -1 } else { 1 },
        count: count.clamp(0, u32::MAX.into()) as u32,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn blocks_come_in_the_order_of_their_keys_and_each_once(
            min in prop::array::uniform3(-5i32..5),
            size in prop::array::uniform3(0i32..6),
            sensor in prop::array::uniform3(-1500i32..1500),
        ) {
            let region = BlockBox { min, max: core::array::from_fn(|a| min[a] + size[a]) };
            let sensor = sensor_block(sensor);
            let all: Vec<_> = blocks(region, sensor, 0).collect();
            prop_assert_eq!(all.len() as u128, region.volume());
            prop_assert!(all.is_sorted_by(|a, b| key(*a, sensor) < key(*b, sensor)));
            prop_assert!(all.iter().all(|block| region.union(BlockBox::of(*block)) == region));
            for before in 0..=all.len() + 1 {
                let rest: Vec<_> = blocks(region, sensor, before as u64).collect();
                prop_assert_eq!(&rest, all.get(before..).unwrap_or_default(), "{} left out", before);
            }
        }
    }

    #[test]
    fn in_an_octant_the_far_corner_comes_first() {
        let region = BlockBox { min: [-2; 3], max: [2; 3] };
        let order: Vec<_> = blocks(region, [0; 3], 0).collect();
        assert_eq!(order[0], BlockIndex::new(-2, -2, -2));
        assert_eq!(order.iter().find(|b| b.x > 0 && b.y > 0 && b.z > 0), Some(&BlockIndex::new(2, 2, 2)));
    }
}
