//! Makes the tables of the `flock` codec from batches of mapping. Integers only, so that the same batches give
//! the same tables on every machine.
//!
//! Two rounds over the same batches: the first counts how often an unknown voxel in each context was seen,
//! which gives the levels; the second counts by levels, which gives the probabilities that packages begin
//! with.

use flockmap_grid::{Changes, Layer};

use super::adding::{Adding, RATES};
use super::block_box::BlockBox;
use super::cells::Bits;
use super::decide::{Decide, DecideVoxel, RowKind, UnknownRow, voxels};
use super::flags::Flags;
use super::known::Known;
use super::model::Model;
use super::order::{self, Changed, in_order};
use super::orientation::Orientation;
use super::tables::{
    self, FLAG_CONTEXTS, KIND_PROBABILITIES, LEVELS, Question, SET_BYTES, TableSet, Tables,
    VOXEL_PROBABILITIES, voxel_probability,
};
use super::voxel_contexts::{NEAR_CONTEXTS, RAY_CONTEXTS, VoxelContexts};
use crate::deflate::inflate_exact;
use crate::source::Batch;
use fearless_simd::Simd;
use flockmap_coder::Probability;

/// Changed voxels in a package of usual size. The voxels at its rim have less beside them.
const PACKAGE_VOXELS: usize = 1_500;

/// How likely a bit of each level is, in 65,536ths.
const LEVEL_PROBABILITIES: [u32; LEVELS] = [
    22, 28, 36, 47, 60, 77, 98, 126, 162, 208, 267, 342, 439, 562, 720, 922, 1179, 1506, 1921, 2446, 3108,
    3938, 4971, 6249, 7812, 9702, 11955, 14595, 17625, 21025, 24743, 28693, 32768, 36843, 40793, 44511,
    47911, 50941, 53581, 55834, 57724, 59287, 60565, 61598, 62428, 63090, 63615, 64030, 64357, 64614, 64816,
    64974, 65097, 65194, 65269, 65328, 65374, 65410, 65438, 65459, 65476, 65489, 65500, 65508,
];
/// Where one level ends and the next begins.
const LEVEL_BOUNDS: [u32; LEVELS - 1] = [
    25, 32, 41, 53, 68, 87, 111, 143, 184, 236, 302, 387, 497, 636, 815, 1042, 1333, 1701, 2168, 2758, 3500,
    4427, 5577, 6992, 8714, 10782, 13226, 16062, 19282, 22849, 26695, 30723, 34813, 38841, 42687, 46254,
    49474, 52310, 54754, 56822, 58544, 59959, 61109, 62036, 62778, 63368, 63835, 64203, 64494, 64721, 64900,
    65039, 65149, 65234, 65300, 65352, 65393, 65425, 65449, 65468, 65483, 65495, 65504,
];

/// What the sets of a file are for, in their order in it.
pub const SETS: [&str; TableSet::ALL.len()] = ["dense", "sparse", "obstacles", "free"];

/// Bytes that are not a file of tables.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
#[error("not a file of tables: expected one zlib stream of {} bytes", SET_BYTES * TableSet::ALL.len())]
pub struct NotTables;

/// The file that the codec ships, of the [`Trainer::tables`] of each of [`SETS`].
pub fn file(sets: &[Vec<u8>]) -> Vec<u8> {
    let mut file = Vec::new();
    // Made once and read for years: a seventh smaller than by zlib itself, which does not begin its blocks where other
    // bytes begin.
    let options = zopfli::Options { maximum_block_splits: 120, ..zopfli::Options::default() };
    let written = zopfli::compress(options, zopfli::Format::Zlib, &*sets.concat(), &mut file);
    written.unwrap_or_else(|error| unreachable!("memory takes all that is written: {error}"));
    file
}

/// The sets of a [`file()`].
pub fn read(file: &[u8]) -> Result<Vec<Vec<u8>>, NotTables> {
    let mut bytes = vec![0; SET_BYTES * TableSet::ALL.len()];
    inflate_exact(file, &mut bytes).ok_or(NotTables)?;
    Ok(bytes.chunks_exact(SET_BYTES).map(<[u8]>::to_vec).collect())
}

/// The file that this build of the codec ships.
pub const fn shipped() -> &'static [u8] {
    tables::FILE
}

/// How often a bit was not set, and was.
type Counts = [u64; 2];

/// Trains one set of tables.
pub struct Trainer {
    set: TableSet,
    learning: Learning,
    model: Model,
    coded: Vec<u8>,
}

/// What a round is for.
enum Learning {
    /// How often bits are set, in each context or at each level.
    Counting(Box<Counting>),
    /// What contexts add; the round.
    Adding(Box<Adding>, usize),
}

/// How sure a decision may be to teach something. A little surer than those that are mixed, where that is better.
const fn learned(set: TableSet) -> Probability {
    match set {
        TableSet::Dense | TableSet::Free => 656,
        TableSet::Sparse | TableSet::Obstacles => 328,
    }
}

/// Rounds that training takes.
pub const ROUNDS: usize = 2 + RATES.len();

impl Trainer {
    /// Of the set with this number among [`SETS`], before the first round.
    ///
    /// # Panics
    /// If there is no such set.
    pub fn new(set: usize) -> Self {
        let set = TableSet::ALL[set];
        Self {
            set,
            learning: Learning::Counting(Box::new(Counting::new(set, None))),
            model: Model::default(),
            coded: Vec::new(),
        }
    }

    /// Learns from a batch; `layer` is what was known before it. Each round has to be given the same batches.
    pub fn learn(&mut self, layer: &Layer, batch: &Batch, changes: &Changes) {
        let known = Known::new(Some(layer), batch.end);
        let sensor = batch.sensor;
        let blocks = in_order(changes, sensor);
        let mut rest = blocks.as_slice();
        while !rest.is_empty() {
            let mut voxels = 0;
            let full = rest.iter().position(|(_, states)| {
                voxels += states.known_count() as usize;
                voxels >= PACKAGE_VOXELS
            });
            let (package, after) = rest.split_at(full.map_or(rest.len(), |last| last + 1));
            rest = after;
            let Self { learning, model, coded, .. } = self;
            match learning {
                Learning::Counting(counting) => {
                    Self::package(&mut **counting, model, coded, &known, sensor, package)
                }
                Learning::Adding(adding, _) => {
                    Self::package(&mut **adding, model, coded, &known, sensor, package)
                }
            }
        }
        if let Learning::Adding(adding, _) = &mut self.learning {
            adding.end_batch();
        }
    }

    fn package<D: Decide>(
        decide: &mut D,
        model: &mut Model,
        coded: &mut Vec<u8>,
        known: &Known<'_>,
        sensor: [i32; 3],
        blocks: &[Changed<'_>],
    ) {
        let Some((first, _)) = blocks.first() else { return };
        let all = blocks.iter().map(|(index, _)| BlockBox::of(*index));
        let region = all.fold(BlockBox::of(*first), BlockBox::union);
        model.field.clear(region);
        let mut flags = Flags::new(region, coded);
        let mut left = blocks.iter().peekable();
        for index in order::blocks(region, order::sensor_block(sensor), 0).skip_while(|index| index != first)
        {
            if left.peek().is_none() {
                break;
            }
            let changes = left.next_if(|(next, _)| *next == index).map(|(_, states)| states);
            let view = Orientation::of(index, sensor);
            // A layer of whole batches, in order, has not been superseded.
            let Ok(classes) = model.field.classes(known, index) else { return };
            decide.flag(flags.context(index, view.0, classes), changes.is_some());
            flags.note(index, changes.is_some());
            if changes.is_some() && model.code(decide, known, index, view, classes, changes).is_err() {
                return;
            }
        }
    }

    /// Ends a round. After the last of [`ROUNDS`], [`Self::tables`] are ready.
    pub fn end_round(&mut self) {
        self.learning = match &mut self.learning {
            Learning::Counting(counting) => match &counting.tables {
                None => Learning::Counting(Box::new(Counting::new(self.set, Some(counting.with_levels())))),
                Some(tables) => {
                    let mut adding =
                        Adding::new(counting.with_probabilities(tables.clone()), learned(self.set));
                    adding.begin(RATES[0]);
                    Learning::Adding(Box::new(adding), 0)
                }
            },
            Learning::Adding(adding, round) => {
                *round += 1;
                if let Some(rate) = RATES.get(*round) {
                    adding.begin(*rate);
                }
                return;
            }
        };
    }

    /// The tables as bytes, as they stand after the rounds so far.
    pub fn tables(&self) -> Vec<u8> {
        match &self.learning {
            Learning::Counting(counting) => {
                counting.tables.as_ref().map(Tables::to_bytes).unwrap_or_default()
            }
            Learning::Adding(adding, _) => adding.tables().to_bytes(),
        }
    }
}

struct Counting {
    set: TableSet,
    tables: Option<Tables>,
    near: Vec<Counts>,
    ray: Vec<Counts>,
    kind_near: Vec<Counts>,
    kind_ray: Vec<Counts>,
    voxel_probability: Vec<Counts>,
    kind_probability: Vec<Counts>,
    flag: Vec<Counts>,
}

impl Counting {
    fn new(set: TableSet, tables: Option<Tables>) -> Self {
        let none = |count| vec![[0; 2]; count];
        Self {
            set,
            tables,
            near: none(NEAR_CONTEXTS),
            ray: none(RAY_CONTEXTS),
            kind_near: none(NEAR_CONTEXTS),
            kind_ray: none(RAY_CONTEXTS),
            voxel_probability: none(VOXEL_PROBABILITIES),
            kind_probability: none(KIND_PROBABILITIES),
            flag: none(FLAG_CONTEXTS),
        }
    }

    /// What contexts are worth. Contexts that were rarely met lean on groups of similar ones.
    fn with_levels(&self) -> Tables {
        let near_group = |context: usize| {
            // The two bits of a state stand two apart: those of two voxels in each four bits.
            let state = |cell: usize| {
                let bits = context >> (cell / 2 * 4 + cell % 2);
                bits & 1 | bits >> 1 & 2
            };
            let new = (0..6).filter(|cell| state(*cell) == 1).count();
            new * 8 + usize::from(state(0) == 1) * 4 + (context >> 13 & 1) * 2 + (context >> 12 & 1)
        };
        let ray_group = |context: usize| context & 255;
        let mut tables = Tables::even(self.set);
        for (question, near, ray, prior) in [
            (Question::Seen, &self.near, &self.ray, EVEN_ODDS),
            (Question::Kind, &self.kind_near, &self.kind_ray, THREE_IN_TEN),
        ] {
            let (near, ray) = (levels(near, near_group, prior), levels(ray, ray_group, prior));
            for (to, level) in tables.near.iter_mut().zip(near).chain(tables.ray.iter_mut().zip(ray)) {
                to.level[question as usize] = level;
            }
        }
        tables
    }

    fn with_probabilities(&self, mut tables: Tables) -> Tables {
        let start = &mut tables.start;
        for (probabilities, counts) in
            [(&mut start.voxel[..], &self.voxel_probability), (&mut start.kind[..], &self.kind_probability)]
        {
            for (index, (probability, counts)) in probabilities.iter_mut().zip(counts).enumerate() {
                let (near, ray) = (index / LEVELS % LEVELS, index % LEVELS);
                // What the two levels say together where there is no experience: 0.6 of their sum.
                let middle = LEVELS as i64 / 2;
                let level = middle + (6 * (near as i64 + ray as i64 - 2 * middle)).div_euclid(10);
                let prior = LEVEL_PROBABILITIES[level.clamp(0, LEVELS as i64 - 1) as usize];
                *probability = to_probability(share(*counts, prior, 4));
            }
        }
        for (probability, counts) in start.flag.iter_mut().zip(&self.flag) {
            *probability = to_probability(share(*counts, THREE_IN_TEN, 1));
        }
        tables
    }
}

const EVEN_ODDS: u32 = 1 << 15;
const THREE_IN_TEN: u32 = 19_661;

/// How often a bit was set, in 65,536ths, as if a prior had been met `weight` times before.
fn share(counts: Counts, prior: u32, weight: u64) -> u32 {
    let [clear, set] = counts;
    (((set << 16) + weight * u64::from(prior)) / (clear + set + weight)) as u32
}

/// Never so sure that a surprise costs more than 10 bits.
fn to_probability(share: u32) -> Probability {
    share.clamp(48, 65_536 - 48) as Probability
}

/// Levels of contexts; the prior of a context is what its group met.
fn levels(counts: &[Counts], group: impl Fn(usize) -> usize, prior: u32) -> Vec<u8> {
    let mut groups = vec![[1u64, 1]; 256];
    for (context, counts) in counts.iter().enumerate() {
        let sum = &mut groups[group(context)];
        sum[0] += counts[0];
        sum[1] += counts[1];
    }
    let level = |(context, counts): (usize, &Counts)| {
        let prior = share(groups[group(context)], prior, 1);
        let share = share(*counts, prior, 16);
        LEVEL_BOUNDS.partition_point(|bound| *bound <= share) as u8
    };
    counts.iter().enumerate().map(level).collect()
}

impl Decide for Counting {
    fn flag(&mut self, context: usize, truth: bool) -> bool {
        self.flag[context][usize::from(truth)] += 1;
        truth
    }

    fn row<S: Simd>(&mut self, row: UnknownRow<S>, truth: Bits) -> Bits {
        voxels(self, row, truth)
    }
}

impl DecideVoxel for Counting {
    fn voxel<S: Simd>(&mut self, kind: RowKind, contexts: &VoxelContexts<'_, S>, truth: bool) -> bool {
        let (near, ray) = (contexts.near(), contexts.ray());
        let level = self.tables.as_ref().map_or(0, |tables| tables.level(Question::Seen, contexts));
        self.near[near][usize::from(truth)] += 1;
        self.ray[ray][usize::from(truth)] += 1;
        self.voxel_probability[voxel_probability(kind, level)][usize::from(truth)] += 1;
        truth
    }

    fn kind<S: Simd>(&mut self, contexts: &VoxelContexts<'_, S>, truth: bool) -> bool {
        if self.set.is_all_occupied() {
            return truth;
        }
        let (near, ray) = (contexts.near(), contexts.ray());
        self.kind_near[near][usize::from(truth)] += 1;
        self.kind_ray[ray][usize::from(truth)] += 1;
        if let Some(tables) = &self.tables {
            self.kind_probability[usize::from(tables.level(Question::Kind, contexts))][usize::from(truth)] +=
                1;
        }
        truth
    }
}
