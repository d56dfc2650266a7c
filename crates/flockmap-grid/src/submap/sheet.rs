//! Sheets of a grid: where a block goes on that begins anew.

use crate::{BLOCK_SIDE, BlockIndex};

/// A copy of the grid, far out in the grid itself.
///
/// The first sheet is the grid where robots are. The others have places of 2²⁰ voxels along each side, side by side
/// between 2²⁶ and 2²⁷ voxels up, where no robot may be ([`Resolution::check_position`](crate::Resolution::check_position)). An index from
/// the middle of such a place is called *local*; it is that of the block on the first sheet that was there before.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Default)]
pub struct Sheet(u16);

/// Blocks along a side of a place.
const SIDE: i32 = 1 << 17;
/// Places lie from here up along z, to twice as far: so sixteenths of a voxel fit into 32 bits.
const BEGIN: i32 = 1 << 23;
/// Places in a row along x, an odd number, so that there is one in the middle.
const ROW: i32 = 127;
/// Rows, one above the other. The one above them is not of sheets: [`record`](super::record).
const ROWS: i32 = 63;

/// In voxels, where no robot may be along z: the places and what is within the longest ray of them.
pub(crate) const RESERVED: core::ops::RangeInclusive<i32> =
    BEGIN * BLOCK_SIDE - 1_024..=2 * BEGIN * BLOCK_SIDE + 1_024;

/// The middle of the place in which the records of submaps lie, in blocks.
pub(super) const RECORDS: [i32; 3] = [0, 0, BEGIN + ROWS * SIDE + SIDE / 2];

/// Whether a block lies where no robot may be: on another sheet than the first, or on none.
pub(crate) const fn is_reserved(block: BlockIndex) -> bool {
    block.z >= BEGIN && block.z < 2 * BEGIN
}

impl Sheet {
    /// The grid where robots are.
    pub const FIRST: Self = Self(0);
    /// Number of sheets.
    pub const COUNT: usize = (ROW * ROWS) as usize + 1;

    /// The sheet with this number, below [`COUNT`](Self::COUNT).
    pub const fn new(number: u16) -> Option<Self> {
        if (number as usize) < Self::COUNT { Some(Self(number)) } else { None }
    }

    /// Its number.
    pub const fn number(self) -> u16 {
        self.0
    }

    /// The sheet on which a block lies; `None` where there is none.
    pub const fn of(block: BlockIndex) -> Option<Self> {
        if !is_reserved(block) {
            return Some(Self::FIRST);
        }
        let (row, up) = ((block.x + SIDE / 2).div_euclid(SIDE), (block.z - BEGIN).div_euclid(SIDE));
        let half = ROW / 2;
        if up >= ROWS || row < -half || row > half || block.y < -SIDE / 2 || block.y >= SIDE / 2 {
            return None;
        }
        // From the middle out: 0, −1, 1, −2, …
        let along = if row >= 0 { 2 * row } else { -2 * row - 1 };
        Some(Self((up * ROW + along + 1) as u16))
    }

    /// Where its middle lies, in blocks.
    pub const fn middle(self) -> [i32; 3] {
        if self.0 == 0 {
            return [0; 3];
        }
        let (along, up) = ((self.0 as i32 - 1) % ROW, (self.0 as i32 - 1) / ROW);
        let row = if along % 2 == 0 { along / 2 } else { -(along + 1) / 2 };
        [row * SIDE, 0, BEGIN + SIDE / 2 + up * SIDE]
    }

    /// The block at a local index; `None` if the sheet has no room for it.
    pub fn block(self, local: BlockIndex) -> Option<BlockIndex> {
        let ([x, y, z], half) = (self.middle(), SIDE / 2);
        let is_there = self.0 == 0 || [local.x, local.y, local.z].iter().all(|at| (-half..half).contains(at));
        is_there.then(|| BlockIndex { x: local.x + x, y: local.y + y, z: local.z + z })
    }

    /// The local index of a block that lies on this sheet.
    pub const fn local(self, block: BlockIndex) -> BlockIndex {
        let [x, y, z] = self.middle();
        BlockIndex { x: block.x - x, y: block.y - y, z: block.z - z }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::HashSet;

    #[test]
    fn every_sheet_has_a_place_of_its_own_in_the_grid() {
        let mut middles = HashSet::from([RECORDS]);
        for number in 0..Sheet::COUNT as u16 {
            let sheet = Sheet::new(number).unwrap();
            assert!(middles.insert(sheet.middle()), "{sheet:?}");
            let ends = if number == 0 { [-9, 9] } else { [-SIDE / 2, SIDE / 2 - 1] };
            for [x, y, z] in (0..8).map(|n| [n & 1, n >> 1 & 1, n >> 2 & 1].map(|end| ends[end])) {
                let local = BlockIndex::new(x, y, z);
                let block = sheet.block(local).unwrap();
                assert_eq!((Sheet::of(block), sheet.local(block)), (Some(sheet), local));
                // Sixteenths of a voxel fit into 32 bits.
                assert!([block.x, block.y, block.z].iter().all(|at| (-(1 << 24)..1 << 24).contains(at)));
            }
        }
        assert_eq!(Sheet::new(Sheet::COUNT as u16), None);
        let [x, y, z] = RECORDS;
        assert_eq!(Sheet::of(BlockIndex::new(x, y, z)), None);
        assert_eq!(Sheet::new(1).unwrap().block(BlockIndex::new(SIDE / 2, 0, 0)), None);
    }

    proptest! {
        #[test]
        fn what_lies_on_no_sheet_is_where_no_robot_may_be(at in [-(1 << 25)..=1 << 25, -(1 << 25)..=1 << 25, -(1 << 25)..=1i32 << 25]) {
            let block = BlockIndex::new(at[0], at[1], at[2]);
            match Sheet::of(block) {
                None => prop_assert!(is_reserved(block)),
                Some(sheet) => {
                    prop_assert_eq!(is_reserved(block), sheet != Sheet::FIRST);
                    prop_assert_eq!(sheet.block(sheet.local(block)), Some(block));
                }
            }
            if is_reserved(block) {
                prop_assert!(RESERVED.contains(&(block.z * 8)) && RESERVED.contains(&(block.z * 8 + 7)));
            }
        }
    }
}
