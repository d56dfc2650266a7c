//! What a package of changes is coded against.

use flockmap_grid::{BLOCK_SIDE, Layer, Stamp, VOXEL_LIMIT, Voxel, VoxelBox};

/// What every receiver of a batch will hold of its stream: all packages before it.
/// [`Codec::Flock`](crate::Codec::Flock) codes a batch against that in fewer bytes; the other codecs do not
/// look at it.
#[derive(Clone, Copy, Debug)]
pub struct Base<'a> {
    /// What the packages before the batch said, all of them. `None`: the batch is coded independent, so that
    /// nobody has to wait for what is still to be repaired. It takes more bytes.
    pub layer: Option<&'a Layer>,
    /// End of each batch before and the index of its last package, ascending. May begin with the first batch
    /// that is still remembered; may be empty, then packages name the one before their batch.
    pub batches: &'a [(Stamp, u32)],
    /// Index and box of the newest packages before that were coded against a layer, ascending. A package of
    /// the batch that changes what one of them looked at names it too: a receiver that merged it first could
    /// not decode the other any more.
    pub readers: &'a [(u32, VoxelBox)],
}

impl Base<'_> {
    /// The newest package before that may have looked at a block of `region`; 0 for none.
    pub(crate) fn newest_dependent(&self, region: &VoxelBox) -> u32 {
        // A package looks at its box and the blocks round it.
        let (min, max) = (region.min(), region.max());
        let moved = |at: Voxel, by: i32| {
            let [x, y, z] = [at.x, at.y, at.z].map(|at| (at + by).clamp(-VOXEL_LIMIT, VOXEL_LIMIT));
            Voxel::new(x, y, z)
        };
        let wide = VoxelBox::spanning(moved(min, -BLOCK_SIDE), moved(max, BLOCK_SIDE)).unwrap_or(*region);
        self.readers
            .iter()
            .rev()
            .find(|(_, looked_at)| looked_at.intersection(&wide).is_some())
            .map_or(0, |(index, _)| *index)
    }

    /// The newest package of the batches up to `stamp`, or of a later one if those are forgotten.
    pub(crate) fn newest_package(&self, stamp: Stamp, first_index: u32) -> u32 {
        let later = self.batches.partition_point(|(end, _)| *end <= stamp);
        let (_, last) = self.batches.get(later.saturating_sub(1)).copied().unwrap_or((stamp, u32::MAX));
        last.min(first_index - 1)
    }
}

#[cfg(test)]
mod tests;
