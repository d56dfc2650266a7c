//! A box round blocks.

use crate::BlockIndex;
use crate::layer::first_of;

/// From its lowest to its highest block.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct BlockBox {
    low: BlockIndex,
    high: BlockIndex,
}

impl BlockBox {
    /// Of one block.
    pub(crate) const fn new(block: BlockIndex) -> Self {
        Self { low: block, high: block }
    }

    /// Grows to hold a block.
    pub(crate) fn add(&mut self, block: BlockIndex) {
        let (low, high) = (self.low, self.high);
        self.low = BlockIndex::new(low.x.min(block.x), low.y.min(block.y), low.z.min(block.z));
        self.high = BlockIndex::new(high.x.max(block.x), high.y.max(block.y), high.z.max(block.z));
    }

    /// Of a cube of 4³ blocks, by its own index.
    pub(crate) const fn of_cube(at: BlockIndex) -> Self {
        let low = first_of(at);
        Self { low, high: BlockIndex::new(low.x + 3, low.y + 3, low.z + 3) }
    }

    /// Round both.
    pub(crate) fn union(mut self, other: Self) -> Self {
        self.add(other.low);
        self.add(other.high);
        self
    }

    /// Round some blocks; `None` if there are none.
    pub(crate) fn around(mut blocks: impl Iterator<Item = BlockIndex>) -> Option<Self> {
        let mut all = Self::new(blocks.next()?);
        blocks.for_each(|block| all.add(block));
        Some(all)
    }

    /// Its lowest and its highest block.
    pub(crate) const fn ends(&self) -> [BlockIndex; 2] {
        [self.low, self.high]
    }

    /// Whether they have a block in common.
    pub(crate) const fn meets(&self, other: &Self) -> bool {
        self.low.x <= other.high.x
            && other.low.x <= self.high.x
            && self.low.y <= other.high.y
            && other.low.y <= self.high.y
            && self.low.z <= other.high.z
            && other.low.z <= self.high.z
    }
}
