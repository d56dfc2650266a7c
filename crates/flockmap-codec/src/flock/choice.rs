//! Which tables suit the changes of a batch: a few blocks are coded with each of them, only to add up what
//! they cost.

use flockmap_grid::BaseSuperseded;

use super::block_box::BlockBox;
use super::cells::Bits;
use super::decide::{Decide, DecideVoxel, RowKind, UnknownRow, voxels};
use super::flag_contexts::{FLAG_PLACES, MixedFlag};
use super::known::Known;
use super::log2::log2;
use super::mixing;
use super::model::Model;
use super::order::Changed;
use super::orientation::Orientation;
use super::tables::{Question, TableSet, Tables, voxel_probability};
use super::voxel_contexts::VoxelContexts;
use fearless_simd::Simd;
use flockmap_coder::Probability;

/// Blocks that are looked at: so many from the front and so many from the middle, at most one in
/// `SAMPLE_PART`.
const SAMPLE_BLOCKS: usize = 16;
const SAMPLE_PART: usize = 6;
/// So many in a row, from one and from the other place in turns.
const SAMPLE_RUN: usize = 4;
/// Bits by which a set has to be ahead to be taken before all of them are looked at.
const LEAD_BITS: u64 = 32;
/// Dense tables have to be ahead by one part in so many of what they cost.
const DENSE_PART: u64 = 32;
/// The same of those of free space.
const FREE_PART: u64 = 8;

/// The set with which some of `blocks` take the fewest bits; as few as are needed to choose.
pub(crate) fn choose(
    model: &mut Model,
    known: &Known<'_>,
    sets: &[TableSet],
    sensor: [i32; 3],
    blocks: &[Changed<'_>],
) -> Result<TableSet, BaseSuperseded> {
    let mut trial = Trial { sets: sets.iter().map(|set| (0, *set, set.tables())).collect() };
    let sample = sample(blocks);
    let region = sample.iter().map(|(index, _)| BlockBox::of(*index)).reduce(BlockBox::union);
    if let Some(region) = region.filter(|region| region.volume() <= REACH_MAX) {
        model.field.clear(region);
        for (index, states) in sample {
            if trial.is_decided() {
                break;
            }
            let classes = model.field.classes(known, *index)?;
            let view = Orientation::of(*index, sensor);
            model.code(&mut trial, known, *index, view, classes, Some(states))?;
        }
    }
    Ok(trial.best().0)
}

/// Some of the blocks of a batch, to be looked at in this order.
fn sample<'a>(blocks: &[Changed<'a>]) -> Vec<Changed<'a>> {
    let count = (blocks.len() / (2 * SAMPLE_PART)).clamp(2, SAMPLE_BLOCKS);
    let (front, back) = blocks.split_at(blocks.len() / 2);
    let [mut front, mut back] = [front, back].map(|part| part[..count.min(part.len())].chunks(SAMPLE_RUN));
    (0..count.div_ceil(SAMPLE_RUN))
        .flat_map(|_| [front.next(), back.next()])
        .flatten()
        .flatten()
        .copied()
        .collect()
}

/// Blocks in the box of a sample, at most.
const REACH_MAX: u128 = 1 << 15;

/// What decisions cost with the probabilities that packages begin with.
struct Trial {
    /// In 256ths of a bit.
    sets: Vec<(u64, TableSet, &'static Tables)>,
}

impl Trial {
    /// The set that looks best, and by how many 256ths of a bit it is ahead of the next one.
    fn best(&self) -> (TableSet, u64) {
        // What is behind the blocks of a sample is not coded, and without that dense scans look likelier than they
        // are.
        let handicap = |cost, set| match set {
            TableSet::Dense => cost + cost / DENSE_PART,
            TableSet::Free => cost + cost / FREE_PART,
            TableSet::Sparse | TableSet::Obstacles => cost,
        };
        let mut costs: Vec<_> =
            self.sets.iter().map(|(cost, set, _)| (handicap(*cost, *set), *set)).collect();
        costs.sort_by_key(|(cost, _)| *cost);
        match costs[..] {
            [(_, only)] => (only, u64::MAX),
            [(best, set), (next, _), ..] => (set, next - best),
            [] => (TableSet::Dense, u64::MAX),
        }
    }

    /// Whether one set is ahead by so much that more blocks would hardly change it; it is if there is but
    /// one.
    fn is_decided(&self) -> bool {
        self.best().1 >= LEAD_BITS * 256
    }

    fn pay(&mut self, bit: bool, probability: impl Fn(&Tables) -> Probability) {
        for (cost, _, tables) in &mut self.sets {
            let probability = probability(tables);
            *cost += u64::from(COST[usize::from(if bit { probability } else { !probability } >> 8)]);
        }
    }
}

impl Decide for Trial {
    fn flag(&mut self, context: usize, truth: bool) -> bool {
        self.pay(truth, |tables| tables.start.flag[context]);
        truth
    }

    fn mixed_flag(
        &mut self,
        flag: MixedFlag,
        context: usize,
        places: impl FnOnce() -> [usize; FLAG_PLACES],
        truth: bool,
    ) -> bool {
        let places = places();
        self.pay(truth, |tables| {
            at_start(tables, tables.start.flag[context], || tables.flag_sum(flag, places))
        });
        truth
    }

    fn row<S: Simd>(&mut self, row: UnknownRow<S>, truth: Bits) -> Bits {
        voxels(self, row, truth)
    }
}

impl DecideVoxel for Trial {
    fn voxel<S: Simd>(&mut self, kind: RowKind, contexts: &VoxelContexts<'_, S>, truth: bool) -> bool {
        self.pay(truth, |tables| {
            let level = voxel_probability(kind, tables.level(Question::Seen, contexts));
            at_start(tables, tables.start.voxel[level], || tables.sum(Question::Seen, contexts))
        });
        truth
    }

    fn kind<S: Simd>(&mut self, contexts: &VoxelContexts<'_, S>, truth: bool) -> bool {
        self.pay(truth, |tables| {
            let level = usize::from(tables.level(Question::Kind, contexts));
            at_start(tables, tables.start.kind[level], || tables.sum(Question::Kind, contexts))
        });
        truth
    }
}

/// What becomes of a probability that packages begin with.
fn at_start(tables: &Tables, probability: Probability, sum: impl FnOnce() -> i32) -> Probability {
    if tables.is_sure(probability) { probability } else { mixing::at_start(probability, sum()) }
}

/// What a bit of this probability (in 256ths) costs, in 256ths of a bit.
static COST: [u16; 256] = {
    let mut table = [0; 256];
    let mut n = 0;
    while n < 256 {
        // −log₂((2n + 1) / 512), rounded up.
        table[n] = (9 * 256 - (log2(2 * n as u64 + 1) >> 24)) as u16;
        n += 1;
    }
    table
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn costs_are_logarithms() {
        for n in [1u32, 3, 77, 255, 511] {
            let (exact, cost) = (-(f64::from(n) / 512.0).log2() * 256.0, COST[n as usize / 2]);
            assert!((f64::from(cost) - exact).abs() < 1.01, "{n}: {cost} and {exact}");
        }
    }
}
