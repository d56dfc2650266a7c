//! Decisions to bytes, and bytes to decisions: one piece of code, so that both learn alike.

use super::adaptive_state::AdaptiveState;
use super::cells::Bits;
use super::decide::{Decide, DecideVoxel, RowKind, UnknownRow, voxels};
use super::flag_contexts::{FLAG_PLACES, MixedFlag};
use super::mixing::{self, Lesson, Weights};
use super::tables::{
    KIND_PROBABILITIES, Probabilities, Question, Tables, VOXEL_PROBABILITIES, voxel_probability,
};
use super::voxel_contexts::VoxelContexts;
use crate::work;
use fearless_simd::Simd;
use flockmap_coder::{CodeBit, Probability};

/// How fast a probability follows what happens: a step of one in 2ⁿ.
const VOXEL_RATE: u32 = 5;
const KIND_RATE: u32 = 4;
const FLAG_RATE: u32 = 6;

/// The decisions of one package. With a [`BitWriter`](flockmap_coder::BitWriter) they are written; with a
/// [`BitReader`](flockmap_coder::BitReader) they are read, and any bytes give some.
pub(crate) struct Coding<'a, B> {
    pub(crate) state: &'a mut AdaptiveState,
    tables: &'static Tables,
    pub(crate) bits: B,
    /// Steps of work for those that have been made.
    pub(crate) steps: u64,
}

impl<'a, B> Coding<'a, B> {
    /// `state` of these tables, as it is to begin.
    pub(crate) fn new(tables: &'static Tables, state: &'a mut AdaptiveState, bits: B) -> Self {
        Self { state, tables, bits, steps: 0 }
    }
}

impl<B: CodeBit> Decide for Coding<'_, B> {
    const KNOWS: bool = B::KNOWS;

    #[inline(always)]
    fn flag(&mut self, context: usize, truth: bool) -> bool {
        self.steps += work::DECISION_STEPS;
        self.bits.code(&mut self.state.probabilities.flag[context], truth, FLAG_RATE)
    }

    #[inline(always)]
    fn mixed_flag(
        &mut self,
        flag: MixedFlag,
        context: usize,
        places: impl FnOnce() -> [usize; FLAG_PLACES],
        truth: bool,
    ) -> bool {
        self.steps += work::DECISION_STEPS;
        let probability = &mut self.state.probabilities.flag[context];
        if self.tables.is_sure(*probability) {
            return self.bits.code(probability, truth, FLAG_RATE);
        }
        let sum = self.tables.flag_sum(flag, places());
        let weights = &mut self.state.weights.flags[flag as usize];
        let mut lesson = Lesson::default();
        let bit = mixing::code(&mut self.bits, probability, sum, weights, &mut lesson, truth, FLAG_RATE);
        weights.learn(lesson);
        bit
    }

    #[inline(always)]
    fn row<S: Simd>(&mut self, row: UnknownRow<S>, truth: Bits) -> Bits {
        let count = row.voxels.count_ones();
        let AdaptiveState { probabilities: Probabilities { voxel, kind, .. }, weights: all } =
            &mut *self.state;
        let (tables, weights) = (self.tables, [all.voxel, all.kind]);
        let (coded, [of_voxel, of_kind]) = self.bits.in_registers(|bits| {
            let lessons = [Lesson::default(); 2];
            let mut coding = RowCoding { voxel, kind, tables, bits, weights, lessons };
            let coded = voxels(&mut coding, row, truth);
            (coded, coding.lessons)
        });
        all.voxel.learn(of_voxel);
        all.kind.learn(of_kind);
        let made = count + (coded.free | coded.occupied).count_ones();
        self.steps += work::ROW_STEPS + u64::from(made);
        coded
    }
}

struct RowCoding<'a, B> {
    voxel: &'a mut [Probability; VOXEL_PROBABILITIES],
    kind: &'a mut [Probability; KIND_PROBABILITIES],
    tables: &'static Tables,
    bits: &'a mut B,
    /// Of a voxel that may have been seen, and of one that was.
    weights: [Weights; 2],
    lessons: [Lesson; 2],
}

impl<B: CodeBit> DecideVoxel for RowCoding<'_, B> {
    #[inline(always)]
    fn voxel<S: Simd>(&mut self, kind: RowKind, contexts: &VoxelContexts<'_, S>, truth: bool) -> bool {
        let at = voxel_probability(kind, self.tables.level(Question::Seen, contexts));
        if self.tables.is_sure(self.voxel[at]) {
            return self.bits.code(&mut self.voxel[at], truth, VOXEL_RATE);
        }
        let sum = self.tables.sum(Question::Seen, contexts);
        let (weights, lesson) = (&self.weights[0], &mut self.lessons[0]);
        mixing::code(self.bits, &mut self.voxel[at], sum, weights, lesson, truth, VOXEL_RATE)
    }

    #[inline(always)]
    fn kind<S: Simd>(&mut self, contexts: &VoxelContexts<'_, S>, truth: bool) -> bool {
        if self.tables.is_all_occupied {
            return true;
        }
        let at = usize::from(self.tables.level(Question::Kind, contexts));
        if self.tables.is_sure(self.kind[at]) {
            return self.bits.code(&mut self.kind[at], truth, KIND_RATE);
        }
        let sum = self.tables.sum(Question::Kind, contexts);
        let (weights, lesson) = (&self.weights[1], &mut self.lessons[1]);
        mixing::code(self.bits, &mut self.kind[at], sum, weights, lesson, truth, KIND_RATE)
    }
}
