//! The tables of the model: what a context is worth, and where the probabilities of a package begin.
//!
//! They are made by a program from generated scenes (`docs/codec.md`) and shipped with the codec, so that
//! every package can be read without another. The static part says of each context how likely a bit is, in 64
//! levels; the probabilities proper belong to levels, not to contexts, and adapt anew in every package.

use std::sync::OnceLock;

use super::decide::RowKind;
use super::flag_contexts::{FLAG_PLACES, FLAG_SUMS, MIXED_FLAGS, MixedFlag};
use super::mixing;
use super::voxel_contexts::{NEAR_CONTEXTS, RAY_CONTEXTS, VoxelContexts, WIDE_SUMS};
use crate::deflate::inflate_exact;
use fearless_simd::Simd;
use flockmap_coder::Probability;

/// Levels of likelihood: steps of ¼ in ln(p / (1 − p)), level 32 is even.
pub(crate) const LEVELS: usize = 64;
/// Kinds of rows with unknown voxels: ordinary, a surprise in which nothing was found yet, one in which
/// something was.
pub(crate) const ROW_KINDS: usize = 3;
pub(crate) const VOXEL_PROBABILITIES: usize = ROW_KINDS * KIND_PROBABILITIES;
pub(crate) const KIND_PROBABILITIES: usize = LEVELS * LEVELS;
/// Contexts of flags, see `block.rs`.
pub(crate) const FLAG_CONTEXTS: usize = 2_816;

/// What adapts, 39 KB: copied for every package.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) struct Probabilities {
    /// By kind of row, level of the near context and level of the ray context.
    pub(crate) voxel: [Probability; VOXEL_PROBABILITIES],
    /// By level of the near context and level of the ray context.
    pub(crate) kind: [Probability; KIND_PROBABILITIES],
    pub(crate) flag: [Probability; FLAG_CONTEXTS],
}

impl Default for Probabilities {
    /// All are even.
    fn default() -> Self {
        let even = 1 << 15;
        Self {
            voxel: [even; VOXEL_PROBABILITIES],
            kind: [even; KIND_PROBABILITIES],
            flag: [even; FLAG_CONTEXTS],
        }
    }
}

impl Probabilities {
    /// Straight to where they belong, where `clone_from` would go by the stack.
    pub(crate) fn copy_from(&mut self, other: &Self) {
        self.voxel.copy_from_slice(&other.voxel);
        self.kind.copy_from_slice(&other.kind);
        self.flag.copy_from_slice(&other.flag);
    }
}

/// What is asked of a voxel. Both questions are asked in the same contexts, so what is known of both stands together in
/// the caches.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Question {
    /// Whether an Unknown voxel was seen.
    Seen = 0,
    /// Whether one that was is Occupied.
    Kind = 1,
}

pub(crate) const QUESTIONS: usize = 2;

/// What a context of the nearest cells or of the ray says of each [`Question`].
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Worth {
    /// Below [`LEVELS`].
    pub(crate) level: [u8; QUESTIONS],
    /// What it adds to the log-odds.
    pub(crate) value: [i8; QUESTIONS],
}

impl Worth {
    pub(crate) const EVEN: Self = Self { level: [LEVELS as u8 / 2; QUESTIONS], value: [0; QUESTIONS] };
}

/// One set of tables, 550 KB.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) struct Tables {
    pub(crate) near: Box<[Worth; NEAR_CONTEXTS]>,
    pub(crate) ray: Box<[Worth; RAY_CONTEXTS]>,
    /// What the other contexts of a voxel add to the log-odds of each [`Question`].
    pub(crate) wide: Box<[[i8; WIDE_SUMS]; QUESTIONS]>,
    /// What contexts add to the log-odds of flags, by [`MixedFlag`](super::flag_contexts::MixedFlag).
    pub(crate) flags: Box<[[i8; FLAG_SUMS]; MIXED_FLAGS]>,
    pub(crate) start: Box<Probabilities>,
    /// See [`TableSet::is_all_occupied`].
    pub(crate) is_all_occupied: bool,
    sure: Probability,
}

/// So many of a value, which never were on the stack.
fn boxed<T: Clone, const N: usize>(value: T) -> Box<[T; N]> {
    let all: Result<Box<[T; N]>, _> = vec![value; N].into_boxed_slice().try_into();
    all.unwrap_or_else(|_| unreachable!("there are as many as were asked for"))
}

impl Tables {
    /// All are even, and add nothing.
    pub(crate) fn even(set: TableSet) -> Self {
        Self {
            is_all_occupied: set.is_all_occupied(),
            sure: set.sure(),
            near: boxed(Worth::EVEN),
            ray: boxed(Worth::EVEN),
            wide: boxed([0; WIDE_SUMS]),
            flags: boxed([0; FLAG_SUMS]),
            start: Box::default(),
        }
    }

    /// Whether an adaptive probability is so sure that sums are not asked.
    #[inline(always)]
    pub(crate) fn is_sure(&self, probability: Probability) -> bool {
        mixing::is_sure(probability, self.sure)
    }

    /// The levels of the nearest cells and of the ray as one number, below `LEVELS`².
    #[inline(always)]
    pub(crate) fn level<S: Simd>(&self, question: Question, contexts: &VoxelContexts<'_, S>) -> u16 {
        let level = |worth: Worth| u16::from(worth.level[question as usize]);
        level(self.near[contexts.near()]) * LEVELS as u16 + level(self.ray[contexts.ray()])
    }

    /// What all contexts of a voxel add up to.
    #[inline(always)]
    pub(crate) fn sum<S: Simd>(&self, question: Question, contexts: &VoxelContexts<'_, S>) -> i32 {
        let value = |worth: Worth| i32::from(worth.value[question as usize]);
        let wide = contexts.wide_places().map(|place| i32::from(self.wide[question as usize][place]));
        value(self.near[contexts.near()]) + value(self.ray[contexts.ray()]) + wide.into_iter().sum::<i32>()
    }

    /// What the contexts of a flag add up to.
    #[inline(always)]
    pub(crate) fn flag_sum(&self, flag: MixedFlag, places: [usize; FLAG_PLACES]) -> i32 {
        places.into_iter().map(|place| i32::from(self.flags[flag as usize][place])).sum()
    }
}

/// Sets of tables, in the order in which they are shipped.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum TableSet {
    /// Scans of many rays, so that neighbours are seen together.
    Dense,
    /// Single rays show.
    Sparse,
    /// Batches of nothing but obstacles.
    Obstacles,
    /// Free space with hardly an obstacle: those went ahead.
    Free,
}

impl TableSet {
    pub(crate) const ALL: [Self; 4] = [Self::Dense, Self::Sparse, Self::Obstacles, Self::Free];

    /// The set with this number.
    pub(crate) fn from_id(id: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|set| set.id() == id)
    }

    pub(crate) const fn id(self) -> u8 {
        self as u8
    }

    /// Probabilities below this one are left alone, see `mixing.rs`: the less, the more bytes are saved, and the more time
    /// it takes.
    pub(crate) const fn sure(self) -> Probability {
        match self {
            Self::Dense => 2_450,
            Self::Sparse => 2_600,
            Self::Obstacles => 328,
            Self::Free => 656,
        }
    }

    /// Whether all voxels that were seen are Occupied, so that nobody asks.
    pub(crate) const fn is_all_occupied(self) -> bool {
        matches!(self, Self::Obstacles)
    }

    /// The tables that are shipped.
    pub(crate) fn tables(self) -> &'static Tables {
        static SHIPPED: OnceLock<Vec<Tables>> = OnceLock::new();
        let all = SHIPPED.get_or_init(|| shipped(FILE));
        &all[usize::from(self.id())]
    }
}

/// Bytes of one set, as they are before zlib.
pub(crate) const SET_BYTES: usize = 2
    * (2 * (NEAR_CONTEXTS + RAY_CONTEXTS)
        + VOXEL_PROBABILITIES
        + KIND_PROBABILITIES
        + FLAG_CONTEXTS
        + WIDE_SUMS)
    + MIXED_FLAGS * FLAG_SUMS;

/// The tables that are shipped, one zlib stream of all sets in their order. Anything else would be another
/// codec.
pub(crate) const FILE: &[u8] = include_bytes!("tables.bin");

fn shipped(file: &[u8]) -> Vec<Tables> {
    let mut bytes = vec![0; SET_BYTES * TableSet::ALL.len()];
    // A file that does not fit is a fault of the build, and the tests of this file find it.
    inflate_exact(file, &mut bytes).expect("the shipped tables are whole");
    TableSet::ALL
        .into_iter()
        .zip(bytes.chunks_exact(SET_BYTES))
        .map(|(set, bytes)| Tables::from_bytes(set, bytes))
        .collect()
}

/// Which probability an unknown voxel of a certain level has.
#[inline(always)]
pub(crate) fn voxel_probability(kind: RowKind, level: u16) -> usize {
    kind as usize * KIND_PROBABILITIES + usize::from(level)
}

impl Tables {
    /// A set from its [`SET_BYTES`] bytes. What is out of range is brought into range.
    pub(crate) fn from_bytes(set: TableSet, bytes: &[u8]) -> Self {
        let mut rest = bytes;
        let mut take = |count: usize| {
            let (head, tail) = rest.split_at(count.min(rest.len()));
            rest = tail;
            head
        };
        fn probabilities<const N: usize>(bytes: &[u8]) -> [Probability; N] {
            let mut probabilities = [1 << 15; N];
            let pairs = bytes.as_chunks::<2>().0;
            probabilities
                .iter_mut()
                .zip(pairs)
                .for_each(|(to, pair)| *to = Probability::from_le_bytes(*pair).max(1));
            probabilities
        }
        let mut tables = Self::even(set);
        for question in 0..QUESTIONS {
            for worths in [&mut tables.near[..], &mut tables.ray[..]] {
                let levels = take(worths.len());
                let set =
                    |(to, level): (&mut Worth, &u8)| to.level[question] = (*level).min(LEVELS as u8 - 1);
                worths.iter_mut().zip(levels).for_each(set);
                let values = take(worths.len());
                let set = |(to, value): (&mut Worth, &u8)| to.value[question] = value.cast_signed();
                worths.iter_mut().zip(values).for_each(set);
            }
            let wide = tables.wide[question].iter_mut().zip(take(WIDE_SUMS));
            wide.for_each(|(to, value)| *to = value.cast_signed());
        }
        for flags in tables.flags.iter_mut() {
            flags.iter_mut().zip(take(FLAG_SUMS)).for_each(|(to, value)| *to = value.cast_signed());
        }
        *tables.start = Probabilities {
            voxel: probabilities(take(2 * VOXEL_PROBABILITIES)),
            kind: probabilities(take(2 * KIND_PROBABILITIES)),
            flag: probabilities(take(2 * FLAG_CONTEXTS)),
        };
        tables
    }

    /// The inverse of [`Self::from_bytes`].
    #[cfg(feature = "training")]
    pub(crate) fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(SET_BYTES);
        for question in 0..QUESTIONS {
            for worths in [&self.near[..], &self.ray[..]] {
                bytes.extend(worths.iter().map(|worth| worth.level[question]));
                bytes.extend(worths.iter().map(|worth| worth.value[question].cast_unsigned()));
            }
            bytes.extend(self.wide[question].iter().map(|value| value.cast_unsigned()));
        }
        bytes.extend(self.flags.iter().flatten().map(|value| value.cast_unsigned()));
        let Probabilities { voxel, kind, flag } = &*self.start;
        for probability in voxel.iter().chain(kind).chain(flag) {
            bytes.extend_from_slice(&probability.to_le_bytes());
        }
        bytes
    }
}
