//! A layer that nobody needs any more, let go of a part at a time.

use super::{Layer, Place};
use crate::BlockIndex;

/// What is left of a layer to be let go of: to free millions of voxels at once takes a while.
#[derive(Debug)]
pub struct DiscardedLayer {
    cubes: std::collections::hash_map::IntoIter<BlockIndex, Place>,
    bytes: usize,
}

impl Layer {
    /// Lets go of the layer, but not at once.
    pub fn discard(self) -> DiscardedLayer {
        let bytes = self.memory_bytes();
        DiscardedLayer { cubes: self.cubes.into_iter(), bytes }
    }
}

impl DiscardedLayer {
    /// Lets go of whole cubes, of at most 64 blocks, until there were `blocks_max` blocks or all. Returns the number
    /// of blocks, 0 if nothing is left. Some 0.1 to 0.5 µs for each.
    pub fn free(&mut self, blocks_max: usize) -> usize {
        let mut freed = 0;
        while freed < blocks_max
            && let Some((_, place)) = self.cubes.next()
        {
            freed += match &place {
                Place::Open(open) => open.cube.len(),
                Place::Packed(packed) => packed.len(),
            };
        }
        freed
    }

    /// Bytes that the layer held. They count until nothing is left.
    pub const fn memory_bytes(&self) -> usize {
        self.bytes
    }
}
