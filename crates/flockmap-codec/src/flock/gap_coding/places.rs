//! The order of the voxels of a box: block by block, by x, then y, then z of the block, as
//! [`Changes`](flockmap_grid::Changes) has them; in a block slice by slice of z, then y, then x. Only voxels
//! inside the box have a place: 0 … volume − 1.
//!
//! Places follow from the sides of the box in O(1), so that nothing has to walk through blocks in which
//! nothing changed.

use flockmap_grid::{BLOCK_SIDE, BlockIndex, VoxelBox};

/// The order of a box of at most 2²⁷ voxels.
pub(crate) struct Order {
    min: [i32; 3],
    max: [i32; 3],
    /// Voxels along y and along z.
    side_y: u32,
    side_z: u32,
}

/// The part of a block that lies in the box.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Part {
    pub(crate) index: BlockIndex,
    /// Place of the first voxel.
    start: u32,
    /// Its lowest corner in the block, and its sides, 1 … 8.
    low: [u32; 3],
    sides: [u32; 3],
}

impl Part {
    /// Whether the whole block is in the box, and its places are the numbers of its bits.
    #[inline]
    fn is_whole(&self) -> bool {
        self.sides == [BLOCK_SIDE as u32; 3]
    }

    /// The place of the voxel with this bit number (0 … 511), which is in the box.
    #[inline]
    pub(crate) fn place(&self, bit: u32) -> u32 {
        if self.is_whole() {
            return self.start + bit;
        }
        let ([lx, ly, lz], [sx, sy, _]) = (self.low, self.sides);
        self.start + (((bit >> 6) - lz) * sy + (bit >> 3 & 7) - ly) * sx + (bit & 7) - lx
    }

    /// The bit number of the voxel at a place, which is in this block.
    #[inline]
    pub(crate) fn bit(&self, place: u32) -> u32 {
        let rank = place - self.start;
        if self.is_whole() {
            return rank;
        }
        let ([lx, ly, lz], [sx, sy, _]) = (self.low, self.sides);
        let (yz, x) = (rank / sx, rank % sx + lx);
        let (z, y) = (yz / sy + lz, yz % sy + ly);
        z << 6 | y << 3 | x
    }
}

impl Order {
    pub(crate) fn new(region: &VoxelBox) -> Self {
        let ([_, side_y, side_z], min, max) = (region.size(), region.min(), region.max());
        Self { min: [min.x, min.y, min.z], max: [max.x, max.y, max.z], side_y, side_z }
    }

    /// The part of a block that shares voxels with the box.
    #[inline]
    pub(crate) fn part(&self, index: BlockIndex) -> Part {
        let [x, y, z] = [(0, index.x), (1, index.y), (2, index.z)].map(|(axis, at)| self.span(axis, at));
        let start =
            x.before * self.side_y * self.side_z + x.side * (y.before * self.side_z + y.side * z.before);
        Part { index, start, low: [x.low, y.low, z.low], sides: [x.side, y.side, z.side] }
    }

    /// The part in which a place is.
    pub(crate) fn part_at(&self, place: u32) -> Part {
        // Before the block along x lie whole slabs of y and z, then columns along z as thick as the block is
        // along x, and so on.
        let slab = self.side_y * self.side_z;
        let x = self.span_at(0, place / slab);
        let place = place - x.before * slab;
        let column = x.side * self.side_z;
        let y = self.span_at(1, place / column);
        let place = place - y.before * column;
        let z = self.span_at(2, place / (x.side * y.side));
        self.part(BlockIndex::new(x.block, y.block, z.block))
    }

    /// Whether a place that is not before `part` is in it.
    #[inline]
    pub(crate) fn reaches(&self, part: &Part, place: u32) -> bool {
        place - part.start < part.sides.iter().product()
    }

    /// What a block takes of an axis.
    #[inline]
    fn span(&self, axis: usize, block: i32) -> Span {
        let corner = block * BLOCK_SIDE;
        let (first, last) = (corner.max(self.min[axis]), (corner + BLOCK_SIDE - 1).min(self.max[axis]));
        debug_assert!(first <= last, "the block lies outside of the box");
        Span {
            block,
            before: first.wrapping_sub(self.min[axis]) as u32,
            low: first.wrapping_sub(corner) as u32,
            side: (last.wrapping_sub(first) + 1) as u32,
        }
    }

    /// The span of the block that holds the voxel so many after the lowest of the box.
    fn span_at(&self, axis: usize, offset: u32) -> Span {
        self.span(axis, (self.min[axis] + offset as i32).div_euclid(BLOCK_SIDE))
    }
}

/// The voxels of a box along an axis that are in one block.
struct Span {
    block: i32,
    /// Voxels of the box before the block.
    before: u32,
    /// The first, counted from the corner of the block.
    low: u32,
    side: u32,
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_grid::{BLOCK_VOXELS, Voxel, bit_of};
    use proptest::prelude::*;

    /// The order, by going through all blocks.
    fn walk(region: &VoxelBox) -> Vec<(BlockIndex, u32)> {
        let inside = |block: BlockIndex, bit: usize| {
            let ([x, y, z], c) = (bit_of(bit), block.corner());
            region.contains(Voxel::new(c.x + x, c.y + y, c.z + z))
        };
        let bits = |block| {
            (0..BLOCK_VOXELS).filter(move |bit| inside(block, *bit)).map(move |bit| (block, bit as u32))
        };
        region.blocks().flat_map(bits).collect()
    }

    proptest! {
        #[test]
        fn places_count_the_voxels_block_by_block(
            min in prop::array::uniform3(-20i32..20), size in prop::array::uniform3(1u32..20),
        ) {
            let region = VoxelBox::new(Voxel::new(min[0], min[1], min[2]), size).unwrap();
            let order = Order::new(&region);
            for (place, (block, bit)) in (0u32..).zip(walk(&region)) {
                let part = order.part(block);
                prop_assert_eq!(part.place(bit), place);
                prop_assert_eq!(part.bit(place), bit);
                prop_assert_eq!(order.part_at(place), part);
                prop_assert!(order.reaches(&part, place));
            }
        }
    }

    #[test]
    fn the_largest_boxes_have_a_place_for_every_voxel() {
        let limit = flockmap_grid::VOXEL_LIMIT;
        for size in [[512, 512, 512], [1 << 27, 1, 1], [1, 1 << 27, 1], [1, 1, 1 << 27], [3, 1 << 25, 1]] {
            for corner in [-limit, limit + 1 - (1 << 27), -5] {
                let region = VoxelBox::new(Voxel::new(corner, corner, corner), size).unwrap();
                let order = Order::new(&region);
                let volume = region.volume() as u32;
                for place in [0, 1, 7, 8, volume / 2, volume - 2, volume - 1] {
                    let part = order.part_at(place);
                    assert_eq!(part.place(part.bit(place)), place, "{region:?}");
                }
                assert_eq!(
                    order.part(region.max().block()).place(flockmap_grid::voxel_bit(region.max()) as u32),
                    volume - 1
                );
            }
        }
    }
}
