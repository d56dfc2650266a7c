//! Trains the sums: what contexts add to the log-odds of a decision. Stochastic gradient descent in integers:
//! after each decision every value that had a say moves a little towards what happened.

use super::cells::Bits;
use super::decide::{Decide, DecideVoxel, RowKind, UnknownRow, voxels};
use super::flag_contexts::{FLAG_PLACES, FLAG_SUMS, MIXED_FLAGS, MixedFlag};
use super::mixing::{ODDS_OF_SUM, TRUST, is_sure};
use super::odds::{odds_of, probability_of};
use super::tables::{QUESTIONS, Question, Tables, voxel_probability};
use super::voxel_contexts::{NEAR_CONTEXTS, RAY_CONTEXTS, VoxelContexts, WIDE_SUMS};
use fearless_simd::Simd;
use flockmap_coder::Probability;

/// Fine steps in one step of a shipped value.
const FINE: i32 = 1 << 16;

/// How far values move by round, in 32nds of a fine step for each 65,536th of error: far at first, so that
/// rare contexts get somewhere, and less and less.
pub(crate) const RATES: [i32; 4] = [46, 22, 10, 5];

/// Values of all contexts of a voxel in one list: the nearest cells, the ray, the others.
const VOXEL_SUMS: usize = WIDE_AT + WIDE_SUMS;
const RAY_AT: usize = NEAR_CONTEXTS;
const WIDE_AT: usize = RAY_AT + RAY_CONTEXTS;

/// Sums while they are learned, in fine steps.
pub(crate) struct Adding {
    tables: Tables,
    /// By [`Question`].
    voxel: [Vec<i32>; QUESTIONS],
    flags: [Vec<i32>; MIXED_FLAGS],
    rate: i32,
    sure: Probability,
    /// Sums of all values after each batch of the round, and how many these are.
    total: Vec<i64>,
    batches: i64,
}

impl Adding {
    /// Decisions that are as sure as this, or surer, teach nothing.
    pub(crate) fn new(tables: Tables, sure: Probability) -> Self {
        let voxel = core::array::from_fn(|_| vec![0; VOXEL_SUMS]);
        let flags = core::array::from_fn(|_| vec![0; FLAG_SUMS]);
        Self { tables, voxel, flags, rate: 0, sure, total: Vec::new(), batches: 0 }
    }

    /// Begins a round.
    pub(crate) fn begin(&mut self, rate: i32) {
        self.rate = rate;
        self.total = vec![0; self.values().count()];
        self.batches = 0;
    }

    fn values(&self) -> impl Iterator<Item = &i32> {
        self.voxel.iter().chain(&self.flags).flatten()
    }

    /// Ends a batch.
    pub(crate) fn end_batch(&mut self) {
        let values = self.voxel.iter().chain(&self.flags).flatten();
        self.total.iter_mut().zip(values).for_each(|(total, value)| *total += i64::from(*value));
        self.batches += 1;
    }

    /// The tables with the sums as they are.
    pub(crate) fn tables(&self) -> Tables {
        let mut tables = self.tables.clone();
        // Means over the last round: what was learned last counts no more than what was before.
        let mut means = self.total.iter().map(|total| (total / self.batches.max(1)) as i32);
        let mut mean = |like: &Vec<i32>| means.by_ref().take(like.len()).collect::<Vec<_>>();
        let voxel: Vec<_> = self.voxel.iter().map(&mut mean).collect();
        let flags: Vec<_> = self.flags.iter().map(&mut mean).collect();
        // Towards zero: less than a step is chance as often as not, and zeros take no room in the file.
        let shipped = |value: &i32| (value / FINE).clamp(-127, 127) as i8;
        for (question, values) in voxel.iter().enumerate() {
            let (near, rest) = values.split_at(NEAR_CONTEXTS);
            let (ray, wide) = rest.split_at(RAY_CONTEXTS);
            for (to, from) in tables.near.iter_mut().zip(near).chain(tables.ray.iter_mut().zip(ray)) {
                to.value[question] = shipped(from);
            }
            tables.wide[question].iter_mut().zip(wide).for_each(|(to, from)| *to = shipped(from));
        }
        for (to, from) in tables.flags.iter_mut().zip(&flags) {
            to.iter_mut().zip(from).for_each(|(to, from)| *to = shipped(from));
        }
        tables
    }

    fn learn_voxel<S: Simd>(
        &mut self,
        question: Question,
        probability: Probability,
        contexts: &VoxelContexts<'_, S>,
        truth: bool,
    ) {
        if question == Question::Kind && self.tables.is_all_occupied || is_sure(probability, self.sure) {
            return;
        }
        let [a, b, c, d, e, f] = contexts.wide_places().map(|place| WIDE_AT + place);
        let places = [contexts.near(), RAY_AT + contexts.ray(), a, b, c, d, e, f];
        learn(&mut self.voxel[question as usize], places, probability, truth, self.rate);
    }
}

/// Moves the values at these places towards a bit that happened.
fn learn<const N: usize>(
    values: &mut [i32],
    places: [usize; N],
    probability: Probability,
    truth: bool,
    rate: i32,
) {
    let own = (odds_of(probability) * TRUST) >> 14;
    let sum: i32 = places.iter().map(|place| values[*place]).sum();
    let expected = i32::from(probability_of(own + ((sum * ODDS_OF_SUM) >> 16)));
    let error = if truth { 65_536 - expected } else { -expected };
    let step = (error * rate) >> 5;
    const MOST: i32 = 127 * FINE;
    for place in places {
        values[place] = (values[place] + step).clamp(-MOST, MOST);
    }
}

impl Decide for Adding {
    fn flag(&mut self, _: usize, truth: bool) -> bool {
        truth
    }

    fn mixed_flag(
        &mut self,
        flag: MixedFlag,
        context: usize,
        places: impl FnOnce() -> [usize; FLAG_PLACES],
        truth: bool,
    ) -> bool {
        let probability = self.tables.start.flag[context];
        if !is_sure(probability, self.sure) {
            learn(&mut self.flags[flag as usize], places(), probability, truth, self.rate);
        }
        truth
    }

    fn row<S: Simd>(&mut self, row: UnknownRow<S>, truth: Bits) -> Bits {
        voxels(self, row, truth)
    }
}

impl DecideVoxel for Adding {
    fn voxel<S: Simd>(&mut self, kind: RowKind, contexts: &VoxelContexts<'_, S>, truth: bool) -> bool {
        let at = voxel_probability(kind, self.tables.level(Question::Seen, contexts));
        self.learn_voxel(Question::Seen, self.tables.start.voxel[at], contexts, truth);
        truth
    }

    fn kind<S: Simd>(&mut self, contexts: &VoxelContexts<'_, S>, truth: bool) -> bool {
        let at = usize::from(self.tables.level(Question::Kind, contexts));
        self.learn_voxel(Question::Kind, self.tables.start.kind[at], contexts, truth);
        truth
    }
}
