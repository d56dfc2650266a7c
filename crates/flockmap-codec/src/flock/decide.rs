//! The decisions that a block is made of. Writing, reading and training each have an implementation.

use super::cells::Bits;
use super::flag_contexts::{FLAG_PLACES, MixedFlag};
use super::voxel_contexts::{RowContexts, VoxelContexts};
use fearless_simd::Simd;

/// Makes or follows decisions. `truth` is what the writer knows; a reader does not look at it.
pub(crate) trait Decide {
    /// Whether it looks at `truth`.
    const KNOWS: bool = true;

    /// A bit with a probability of its own.
    fn flag(&mut self, context: usize, truth: bool) -> bool;
    /// A flag of a row, with what else its sums look at.
    #[inline]
    fn mixed_flag(
        &mut self,
        _: MixedFlag,
        context: usize,
        _: impl FnOnce() -> [usize; FLAG_PLACES],
        truth: bool,
    ) -> bool {
        self.flag(context, truth)
    }
    /// The unknown voxels of a row.
    fn row<S: Simd>(&mut self, row: UnknownRow<S>, truth: Bits) -> Bits;
}

/// The unknown voxels of a row and what is around them.
pub(crate) struct UnknownRow<S: Simd> {
    pub(crate) voxels: u8,
    pub(crate) kind: RowKind,
    pub(crate) contexts: RowContexts<S>,
}

/// What is known of a row before its voxels are coded.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum RowKind {
    Ordinary = 0,
    /// One of the voxels was seen, although nothing beyond them has changed.
    Surprise = 1,
    /// The same, and one that was seen was found.
    Found = 2,
}

/// The decisions of voxels, one by one.
pub(crate) trait DecideVoxel {
    /// Whether an unknown voxel was seen.
    fn voxel<S: Simd>(&mut self, kind: RowKind, contexts: &VoxelContexts<'_, S>, truth: bool) -> bool;
    /// Whether a newly seen voxel is Occupied.
    fn kind<S: Simd>(&mut self, contexts: &VoxelContexts<'_, S>, truth: bool) -> bool;
}

/// Goes through the voxels of a row.
#[inline(always)]
pub(crate) fn voxels<S: Simd, D: DecideVoxel>(decide: &mut D, row: UnknownRow<S>, truth: Bits) -> Bits {
    let UnknownRow { voxels, mut kind, mut contexts } = row;
    let mut left = u32::from(voxels);
    let is_seen = u32::from(truth.free | truth.occupied);
    let (mut seen, mut occupied) = (0, 0);
    while left != 0 {
        let x = left.trailing_zeros() & 7;
        left &= left - 1;
        let voxel = contexts.of_voxel(x);
        if decide.voxel(kind, &voxel, is_seen >> x & 1 != 0) {
            if kind == RowKind::Surprise {
                kind = RowKind::Found;
            }
            seen |= 1 << x;
            let is_occupied = decide.kind(&voxel, truth.occupied >> x & 1 != 0);
            occupied |= u32::from(is_occupied) << x;
            contexts.note(x, is_occupied);
        }
    }
    Bits { free: (seen & !occupied) as u8, occupied: occupied as u8 }
}
