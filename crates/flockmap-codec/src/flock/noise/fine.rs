//! Bits with chances of 32 bits: one change among 100 million voxels is too unlikely for 16.

use crate::flock::coder::{BitReader, BitWriter};

/// Writes or reads bits, so that both are one piece of code.
pub(crate) trait FineBits {
    /// A bit that is set with this chance, in 2⁻³²: 1 … 2³² − 1. A reader does not look at `truth`. Returns the bit.
    fn bit(&mut self, chance: u32, truth: bool) -> bool;
}

impl FineBits for BitWriter<'_> {
    #[inline]
    fn bit(&mut self, chance: u32, truth: bool) -> bool {
        self.put_fine(chance, truth);
        truth
    }
}

impl FineBits for BitReader<'_> {
    #[inline]
    fn bit(&mut self, chance: u32, _: bool) -> bool {
        self.get_fine(chance)
    }
}
