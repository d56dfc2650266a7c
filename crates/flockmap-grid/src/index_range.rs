//! The block indices of a box, and what a table has of them.

use rustc_hash::FxHashMap;

use crate::BlockIndex;

/// All indices from one corner to the other, both included.
#[derive(Clone, Copy, Debug)]
pub(crate) struct IndexRange {
    low: BlockIndex,
    high: BlockIndex,
}

impl IndexRange {
    pub(crate) const fn new(low: BlockIndex, high: BlockIndex) -> Self {
        Self { low, high }
    }

    /// All of them, z fastest.
    pub(crate) fn indices(self) -> impl Iterator<Item = BlockIndex> {
        let Self { low, high } = self;
        (low.x..=high.x).flat_map(move |x| {
            (low.y..=high.y).flat_map(move |y| (low.z..=high.z).map(move |z| BlockIndex { x, y, z }))
        })
    }

    /// Those that a table has, in no order. O(indices), or O(table) where that is smaller: a box may be larger than
    /// the map.
    pub(crate) fn among<T>(self, table: &FxHashMap<BlockIndex, T>) -> Vec<(BlockIndex, &T)> {
        if self.count() < table.len() as u128 {
            self.indices().filter_map(|at| Some((at, table.get(&at)?))).collect()
        } else {
            table.iter().map(|(at, entry)| (*at, entry)).filter(|(at, _)| self.contains(*at)).collect()
        }
    }

    fn axes(self) -> [(i32, i32); 3] {
        let Self { low, high } = self;
        [(low.x, high.x), (low.y, high.y), (low.z, high.z)]
    }

    fn count(self) -> u128 {
        self.axes().into_iter().map(|(low, high)| u128::from(high.abs_diff(low)) + 1).product()
    }

    fn contains(self, at: BlockIndex) -> bool {
        self.axes().into_iter().zip([at.x, at.y, at.z]).all(|((low, high), at)| (low..=high).contains(&at))
    }
}
