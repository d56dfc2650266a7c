//! Trains the sums: what contexts add to the log-odds of a decision. Stochastic gradient descent in integers:
//! after each decision every value that had a say moves a little towards what happened.

use super::cells::Bits;
use super::decide::{Decide, DecideVoxel, RowKind, UnknownRow, voxels};
use super::mixing::{self, ODDS_OF_SUM, TRUST};
use super::odds::{odds_of, probability_of};
use super::flag_contexts::{MIXED_FLAGS, FLAG_PLACES, FLAG_SUMS, MixedFlag};
use super::tables::{Sums, Tables, voxel_probability};
use super::voxel_contexts::{VOXEL_SUMS, VoxelContexts};
use fearless_simd::Simd;
use flockmap_coder::Probability;

/// Fine steps in one step of a shipped value.
const FINE: i32 = 1 << 16;

/// How far values move by round, in sixteenths of a fine step for each 65,536th of error: far at first, so that
/// rare contexts get somewhere, and less and less.
pub(crate) const RATES: [i32; 4] = [46, 22, 10, 5];

/// Sums while they are learned, in fine steps.
pub(crate) struct Adding {
    tables: Tables,
    sums: Fine,
    rate: i32,
}

/// The same as [`Sums`], too large for a stack.
struct Fine {
    voxel: Vec<i32>,
    kind: Vec<i32>,
    row: [Vec<i32>; MIXED_FLAGS],
}

impl Adding {
    pub(crate) fn new(tables: Tables) -> Self {
        let none = |count| vec![0; count];
        let row = core::array::from_fn(|_| none(FLAG_SUMS));
        let sums = Fine { voxel: none(VOXEL_SUMS), kind: none(VOXEL_SUMS), row };
        Self { tables, sums, rate: 0 }
    }

    /// Begins a round.
    pub(crate) fn begin(&mut self, rate: i32) {
        self.rate = rate;
    }

    /// The tables with the sums as they are.
    pub(crate) fn tables(&self) -> Tables {
        let mut tables = self.tables.clone();
        let Sums { voxel, kind, row } = &mut *tables.sums;
        let shipped = |to: &mut [i8], from: &[i32]| {
            for (to, from) in to.iter_mut().zip(from) {
                *to = ((from + FINE / 2) >> 16).clamp(-127, 127) as i8;
            }
        };
        shipped(voxel, &self.sums.voxel);
        shipped(kind, &self.sums.kind);
        row.iter_mut().zip(&self.sums.row).for_each(|(to, from)| shipped(to, from));
        tables
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
    let step = (error * rate) >> 4;
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
        if !mixing::is_sure(probability) {
            learn(&mut self.sums.row[flag as usize], places(), probability, truth, self.rate);
        }
        truth
    }

    fn row<S: Simd>(&mut self, row: UnknownRow<S>, truth: Bits) -> Bits {
        voxels(self, row, truth)
    }
}

impl DecideVoxel for Adding {
    fn voxel<S: Simd>(&mut self, kind: RowKind, contexts: &VoxelContexts<'_, S>, truth: bool) -> bool {
        let Self { tables, sums, rate } = self;
        let probability = tables.start.voxel[voxel_probability(kind, tables.voxel.of(contexts))];
        if !mixing::is_sure(probability) {
            learn(&mut sums.voxel, contexts.places(), probability, truth, *rate);
        }
        truth
    }

    fn kind<S: Simd>(&mut self, contexts: &VoxelContexts<'_, S>, truth: bool) -> bool {
        let Self { tables, sums, rate } = self;
        let probability = tables.start.kind[usize::from(tables.kind.of(contexts))];
        if !mixing::is_sure(probability) {
            learn(&mut sums.kind, contexts.places(), probability, truth, *rate);
        }
        truth
    }
}
