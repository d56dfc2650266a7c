//! The decisions that a block is made of. Writing, reading and training each have an implementation.

use super::cells::Bits;
use super::row_contexts::{ROW_PLACES, RowFlag};
use super::wide::Wide;

/// Makes or follows decisions. `truth` is what the writer knows; a reader does not look at it.
pub(crate) trait Decide {
    /// Whether it looks at `truth`.
    const KNOWS: bool = true;

    /// A bit with a probability of its own.
    fn flag(&mut self, context: usize, truth: bool) -> bool;
    /// A flag of a row, with what else its sums look at.
    #[inline]
    fn row_flag(
        &mut self,
        _: RowFlag,
        context: usize,
        _: impl FnOnce() -> [usize; ROW_PLACES],
        truth: bool,
    ) -> bool {
        self.flag(context, truth)
    }
    /// The unknown voxels of a row; `wide` is what is round it.
    fn row(&mut self, row: &UnknownRow, wide: impl Fn() -> Wide, truth: Bits) -> Bits;
}

/// The unknown voxels of a row and what is around each.
pub(crate) struct UnknownRow {
    pub(crate) voxels: u8,
    pub(crate) kind: RowKind,
    /// By voxel: the cells around it, without those that are coded with this row; the lower and the higher
    /// byte.
    pub(crate) near: [[u8; 8]; 2],
    /// By voxel: the cells along the ray from the sensor through it; the lower and the higher byte.
    pub(crate) ray: [[u8; 8]; 2],
    /// What there is to add to the higher byte of `near` if the voxel before became Free, and if Occupied.
    pub(crate) beside: [u8; 2],
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
    fn voxel(&mut self, kind: RowKind, contexts: [u16; 2], x: usize, truth: bool) -> bool;
    /// Whether a newly seen voxel is Occupied.
    fn kind(&mut self, contexts: [u16; 2], x: usize, truth: bool) -> bool;
    /// What became of a voxel that was seen.
    #[inline(always)]
    fn found(&mut self, _x: usize, _is_occupied: bool) {}
}

/// Goes through the voxels of a row.
#[inline(always)]
pub(crate) fn voxels<D: DecideVoxel>(decide: &mut D, row: &UnknownRow, truth: Bits) -> Bits {
    let mut coded = Bits { free: 0, occupied: 0 };
    let mut kind = row.kind;
    let mut left = u32::from(row.voxels);
    let seen = u32::from(truth.free | truth.occupied);
    let ([near_low, near_high], [ray_low, ray_high]) = (row.near, row.ray);
    let ray = |x: usize| u16::from_le_bytes([ray_low[x & 7], ray_high[x & 7]]);
    // A coded voxel goes to the contexts of the next.
    let mut near_high = near_high;
    while left != 0 {
        let x = left.trailing_zeros() as usize & 7;
        left &= left - 1;
        let contexts = [u16::from_le_bytes([near_low[x], near_high[x]]), ray(x)];
        if decide.voxel(kind, contexts, x, seen >> x & 1 != 0) {
            if kind == RowKind::Surprise {
                kind = RowKind::Found;
            }
            let is_occupied = decide.kind(contexts, x, truth.occupied >> x & 1 != 0);
            decide.found(x, is_occupied);
            if is_occupied {
                coded.occupied |= 1 << x;
            } else {
                coded.free |= 1 << x;
            }
            if let Some(next) = near_high.get_mut(x + 1) {
                *next |= row.beside[usize::from(is_occupied)];
            }
        }
    }
    coded
}
