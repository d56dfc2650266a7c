//! The tables of the model: what a context is worth, and where the probabilities of a package begin.
//!
//! They are made by a program from generated scenes (`docs/codec.md`) and shipped with the codec, so that
//! every package can be read without another. The static part says of each context how likely a bit is, in 64
//! levels; the probabilities proper belong to levels, not to contexts, and are learned anew in every package.

use std::sync::OnceLock;

use super::decide::RowKind;
use super::flag_contexts::{MIXED_FLAGS, FLAG_SUMS};
use super::voxel_contexts::{VOXEL_SUMS, VoxelContexts};
use crate::deflate::inflate_exact;
use fearless_simd::Simd;
use flockmap_coder::Probability;

/// Levels of likelihood: steps of ¼ in ln(p / (1 − p)), level 32 is even.
pub(crate) const LEVELS: usize = 64;
/// Contexts of an unknown voxel by the cells around it.
pub(crate) const NEAR_CONTEXTS: usize = 1 << 16;
/// Contexts of an unknown voxel by the cells along its ray.
pub(crate) const RAY_CONTEXTS: usize = 1 << 15;
/// Kinds of rows with unknown voxels: ordinary, a surprise in which nothing was found yet, one in which
/// something was.
pub(crate) const ROW_KINDS: usize = 3;
pub(crate) const VOXEL_PROBABILITIES: usize = ROW_KINDS * KIND_PROBABILITIES;
pub(crate) const KIND_PROBABILITIES: usize = LEVELS * LEVELS;
/// Contexts of flags, see `block.rs`.
pub(crate) const FLAG_CONTEXTS: usize = 2_816;

/// What is learned: copied for every package, 39 KB.
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

/// What each context is worth for one sort of decision: levels below [`LEVELS`]. A byte each, so that much of
/// it stays in the caches.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) struct Levels {
    pub(crate) near: [u8; NEAR_CONTEXTS],
    pub(crate) ray: [u8; RAY_CONTEXTS],
}

impl Levels {
    pub(crate) fn even() -> Box<Self> {
        let even = LEVELS as u8 / 2;
        Box::new(Self { near: [even; NEAR_CONTEXTS], ray: [even; RAY_CONTEXTS] })
    }

    /// The levels of both contexts as one number, below `LEVELS`².
    #[inline(always)]
    pub(crate) fn of<S: Simd>(&self, contexts: &VoxelContexts<'_, S>) -> u16 {
        let (near, ray) = (self.near[contexts.near()], self.ray[contexts.ray()]);
        u16::from(near) * LEVELS as u16 + u16::from(ray)
    }
}

/// What contexts add to the log-odds of a decision, beside what its adaptive probability says.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) struct Sums<T> {
    /// Of a voxel that may have been seen.
    pub(crate) voxel: [T; VOXEL_SUMS],
    /// Of one that was: whether it is Occupied.
    pub(crate) kind: [T; VOXEL_SUMS],
    /// Of flags of rows, by [`MixedFlag`](super::flag_contexts::MixedFlag).
    pub(crate) row: [[T; FLAG_SUMS]; MIXED_FLAGS],
}

impl Sums<i8> {
    pub(crate) fn none() -> Box<Self> {
        Box::new(Self { voxel: [0; VOXEL_SUMS], kind: [0; VOXEL_SUMS], row: [[0; FLAG_SUMS]; MIXED_FLAGS] })
    }
}

/// What the values at these places add up to.
#[inline(always)]
pub(crate) fn sum<const N: usize>(values: &[i8], places: [usize; N]) -> i32 {
    places.into_iter().map(|place| i32::from(values[place])).sum()
}

/// One set of tables, 540 KB.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) struct Tables {
    /// How likely an unknown voxel was seen.
    pub(crate) voxel: Box<Levels>,
    /// How likely a voxel that was seen is Occupied.
    pub(crate) kind: Box<Levels>,
    pub(crate) start: Box<Probabilities>,
    pub(crate) sums: Box<Sums<i8>>,
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
}

impl TableSet {
    pub(crate) const ALL: [Self; 3] = [Self::Dense, Self::Sparse, Self::Obstacles];

    /// The set with this number.
    pub(crate) fn from_id(id: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|set| set.id() == id)
    }

    pub(crate) const fn id(self) -> u8 {
        self as u8
    }

    /// The tables that are shipped.
    pub(crate) fn tables(self) -> &'static Tables {
        static SHIPPED: OnceLock<Vec<Tables>> = OnceLock::new();
        let all = SHIPPED.get_or_init(|| shipped(FILE));
        &all[usize::from(self.id())]
    }
}

/// Bytes of one set, as they are before zlib.
pub(crate) const SET_BYTES: usize =
    2 * (NEAR_CONTEXTS + RAY_CONTEXTS + VOXEL_PROBABILITIES + KIND_PROBABILITIES + FLAG_CONTEXTS)
        + 2 * VOXEL_SUMS
        + MIXED_FLAGS * FLAG_SUMS;

/// The tables that are shipped, one zlib stream of all sets in their order. Anything else would be another
/// codec.
pub(crate) const FILE: &[u8] = include_bytes!("tables.bin");

fn shipped(file: &[u8]) -> Vec<Tables> {
    let mut bytes = vec![0; SET_BYTES * TableSet::ALL.len()];
    // A file that does not fit is a fault of the build, and the tests of this file find it.
    inflate_exact(file, &mut bytes).expect("the shipped tables are whole");
    bytes.chunks_exact(SET_BYTES).map(Tables::from_bytes).collect()
}

/// Which probability an unknown voxel of a certain level has.
#[inline(always)]
pub(crate) fn voxel_probability(kind: RowKind, level: u16) -> usize {
    kind as usize * KIND_PROBABILITIES + usize::from(level)
}

impl Tables {
    /// A set from its [`SET_BYTES`] bytes. What is out of range is brought into range.
    pub(crate) fn from_bytes(bytes: &[u8]) -> Self {
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
        let (mut voxel, mut kind) = (Levels::even(), Levels::even());
        for levels in [&mut voxel.near[..], &mut kind.near, &mut voxel.ray, &mut kind.ray] {
            let bytes = take(levels.len());
            levels.iter_mut().zip(bytes).for_each(|(to, level)| *to = (*level).min(LEVELS as u8 - 1));
        }
        let start = Box::new(Probabilities {
            voxel: probabilities(take(2 * VOXEL_PROBABILITIES)),
            kind: probabilities(take(2 * KIND_PROBABILITIES)),
            flag: probabilities(take(2 * FLAG_CONTEXTS)),
        });
        let mut sums = Sums::none();
        let Sums { voxel: of_voxel, kind: of_kind, row } = &mut *sums;
        for values in [&mut of_voxel[..], of_kind].into_iter().chain(row.iter_mut().map(|row| &mut row[..])) {
            let bytes = take(values.len());
            values.iter_mut().zip(bytes).for_each(|(to, value)| *to = value.cast_signed());
        }
        Self { voxel, kind, start, sums }
    }

    /// The inverse of [`Self::from_bytes`].
    #[cfg(feature = "training")]
    pub(crate) fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(SET_BYTES);
        for levels in [&self.voxel.near[..], &self.kind.near, &self.voxel.ray, &self.kind.ray] {
            bytes.extend_from_slice(levels);
        }
        let Probabilities { voxel, kind, flag } = &*self.start;
        for probability in voxel.iter().chain(kind).chain(flag) {
            bytes.extend_from_slice(&probability.to_le_bytes());
        }
        let Sums { voxel, kind, row } = &*self.sums;
        for values in [&voxel[..], kind].into_iter().chain(row.iter().map(|row| &row[..])) {
            bytes.extend(values.iter().map(|value| value.cast_unsigned()));
        }
        bytes
    }
}
