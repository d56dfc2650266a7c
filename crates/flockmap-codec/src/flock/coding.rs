//! Decisions to bytes, and bytes to decisions: one piece of code, so that both learn alike.

use super::cells::Bits;
use super::decide::{Decide, DecideVoxel, RowKind, UnknownRow, voxels};
use super::tables::{
    KIND_PROBABILITIES, Levels, Probabilities, Tables, VOXEL_PROBABILITIES, voxel_probability,
};
use crate::work;
use flockmap_coder::{CodeBit, Probability};

/// How fast a probability follows what happens: a step of one in 2ⁿ.
const VOXEL_RATE: u32 = 5;
const KIND_RATE: u32 = 4;
const FLAG_RATE: u32 = 6;

/// The decisions of one package. With a [`BitWriter`](flockmap_coder::BitWriter) they are written; with a
/// [`BitReader`](flockmap_coder::BitReader) they are read, and any bytes give some.
pub(crate) struct Coding<'a, B> {
    probabilities: &'a mut Probabilities,
    tables: &'static Tables,
    pub(crate) bits: B,
    /// Steps of work for those that have been made.
    pub(crate) steps: u64,
}

impl<'a, B> Coding<'a, B> {
    pub(crate) fn new(tables: &'static Tables, probabilities: &'a mut Probabilities, bits: B) -> Self {
        probabilities.clone_from(&tables.start);
        Self { probabilities, tables, bits, steps: 0 }
    }
}

impl<B: CodeBit> Decide for Coding<'_, B> {
    const KNOWS: bool = B::KNOWS;

    #[inline]
    fn flag(&mut self, context: usize, truth: bool) -> bool {
        self.steps += work::DECISION_STEPS;
        self.bits.code(&mut self.probabilities.flag[context], truth, FLAG_RATE)
    }

    #[inline]
    fn row(&mut self, row: &UnknownRow, truth: Bits) -> Bits {
        let Probabilities { voxel, kind, .. } = &mut *self.probabilities;
        let levels = [&*self.tables.voxel, &self.tables.kind];
        let coded =
            self.bits.in_registers(|bits| voxels(&mut RowCoding { voxel, kind, levels, bits }, row, truth));
        let made = row.voxels.count_ones() + (coded.free | coded.occupied).count_ones();
        self.steps += work::ROW_STEPS + u64::from(made);
        coded
    }
}

struct RowCoding<'a, B> {
    voxel: &'a mut [Probability; VOXEL_PROBABILITIES],
    kind: &'a mut [Probability; KIND_PROBABILITIES],
    /// Of a voxel that may have been seen, and of one that was.
    levels: [&'static Levels; 2],
    bits: &'a mut B,
}

impl<B: CodeBit> DecideVoxel for RowCoding<'_, B> {
    #[inline(always)]
    fn voxel(&mut self, kind: RowKind, contexts: [u16; 2], truth: bool) -> bool {
        let probability = &mut self.voxel[voxel_probability(kind, self.levels[0].of(contexts))];
        self.bits.code(probability, truth, VOXEL_RATE)
    }

    #[inline(always)]
    fn kind(&mut self, contexts: [u16; 2], truth: bool) -> bool {
        self.bits.code(&mut self.kind[usize::from(self.levels[1].of(contexts))], truth, KIND_RATE)
    }
}
