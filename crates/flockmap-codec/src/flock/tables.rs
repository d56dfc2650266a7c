//! The tables of the model: what a context is worth, and where the chances of a package begin.
//!
//! They are made by a program from generated scenes alone (`docs/codec.md`) and shipped with the codec, so that every
//! package can be read alone. The static part says of each context how likely a bit is, in 64 levels; the chances
//! proper belong to levels, not to contexts, and are learned anew in every package.

use std::sync::OnceLock;

use super::coder::Chance;
use super::decide::RowKind;
use crate::deflate::inflate_exact;

/// Levels of likelihood: steps of ¼ in ln(p / (1 − p)), level 32 is even.
pub(crate) const LEVELS: usize = 64;
/// Contexts of an unknown voxel by the cells around it.
pub(crate) const NEAR_CONTEXTS: usize = 1 << 16;
/// Contexts of an unknown voxel by the cells along its ray.
pub(crate) const RAY_CONTEXTS: usize = 1 << 15;
/// Kinds of rows with unknown voxels: ordinary, a surprise in which nothing was found yet, one in which something was.
pub(crate) const ROW_KINDS: usize = 3;
pub(crate) const VOXEL_CHANCES: usize = ROW_KINDS * LEVELS * LEVELS;
pub(crate) const KIND_CHANCES: usize = LEVELS * LEVELS;
/// Contexts of flags, see `block.rs`.
pub(crate) const FLAG_CONTEXTS: usize = 2_816;

/// What is learned: copied for every package, 39 KB.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) struct Chances {
    /// By kind of row, level of the near context and level of the ray context.
    pub(crate) voxel: [Chance; VOXEL_CHANCES],
    /// By level of the near context and level of the ray context.
    pub(crate) kind: [Chance; KIND_CHANCES],
    pub(crate) flag: [Chance; FLAG_CONTEXTS],
}

impl Chances {
    pub(crate) fn even() -> Box<Self> {
        Box::new(Self {
            voxel: [1 << 15; ROW_KINDS * LEVELS * LEVELS],
            kind: [1 << 15; LEVELS * LEVELS],
            flag: [1 << 15; FLAG_CONTEXTS],
        })
    }
}

/// What a context is worth.
#[derive(Clone, Copy, PartialEq, Eq, Default, Debug)]
pub(crate) struct ContextLevels {
    /// How likely an unknown voxel was seen.
    pub(crate) voxel: u8,
    /// How likely a voxel that was seen is Occupied.
    pub(crate) kind: u8,
}

/// One set of tables, 230 KB.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) struct Tables {
    /// Levels by context, all below [`LEVELS`].
    pub(crate) near: Box<[ContextLevels; NEAR_CONTEXTS]>,
    pub(crate) ray: Box<[ContextLevels; RAY_CONTEXTS]>,
    pub(crate) start: Box<Chances>,
}

/// Sets of tables, in the order in which they are shipped.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum TableSet {
    /// Scans of many rays, so that neighbours are seen together.
    Dense,
    /// Single rays show.
    Sparse,
    /// Cycles of nothing but obstacles.
    Obstacles,
}

impl TableSet {
    pub(crate) const ALL: [Self; 3] = [Self::Dense, Self::Sparse, Self::Obstacles];

    /// The set with this number.
    pub(crate) fn from_id(id: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|set| set.id() == id)
    }

    pub(crate) const fn id(self) -> u8 {
        match self {
            Self::Dense => 0,
            Self::Sparse => 1,
            Self::Obstacles => 2,
        }
    }

    /// The tables that are shipped.
    pub(crate) fn tables(self) -> &'static Tables {
        static SHIPPED: OnceLock<Vec<Tables>> = OnceLock::new();
        let all = SHIPPED.get_or_init(|| shipped(FILE));
        &all[usize::from(self.id())]
    }
}

/// Bytes of one set, as they are before zlib.
pub(crate) const SET_BYTES: usize = NEAR_CONTEXTS
    + RAY_CONTEXTS
    + NEAR_CONTEXTS
    + RAY_CONTEXTS
    + 2 * ((ROW_KINDS + 1) * LEVELS * LEVELS + FLAG_CONTEXTS);

/// The tables that are shipped, one zlib stream of all sets in their order. Anything else would be another codec.
pub(crate) const FILE: &[u8] = include_bytes!("tables.bin");

fn shipped(file: &[u8]) -> Vec<Tables> {
    let mut bytes = vec![0; SET_BYTES * TableSet::ALL.len()];
    // A file that does not fit is a fault of the build, and the tests of this file find it.
    inflate_exact(file, &mut bytes).expect("the shipped tables are whole");
    bytes.chunks_exact(SET_BYTES).map(Tables::from_bytes).collect()
}

/// Which chance an unknown voxel of a certain level has.
#[inline(always)]
pub(crate) fn voxel_chance(kind: RowKind, level: u16) -> usize {
    kind as usize * KIND_CHANCES + usize::from(level)
}

/// From contexts to chances.
#[derive(Clone, Copy)]
pub(crate) struct Lookup<'a> {
    near: &'a [ContextLevels; NEAR_CONTEXTS],
    ray: &'a [ContextLevels; RAY_CONTEXTS],
}

impl Lookup<'_> {
    /// What the contexts of an unknown voxel say of it.
    #[inline(always)]
    pub(crate) fn level(&self, [near, ray]: [u16; 2]) -> u16 {
        let (near, ray) = (self.near[usize::from(near)], self.ray[usize::from(ray) % RAY_CONTEXTS]);
        u16::from(near.voxel) * LEVELS as u16 + u16::from(ray.voxel)
    }

    /// Which chance a voxel has that was seen.
    #[inline(always)]
    pub(crate) fn kind(&self, [near, ray]: [u16; 2]) -> usize {
        let (near, ray) = (self.near[usize::from(near)], self.ray[usize::from(ray) % RAY_CONTEXTS]);
        usize::from(near.kind) * LEVELS + usize::from(ray.kind)
    }
}

impl Tables {
    #[inline(always)]
    pub(crate) fn lookup(&self) -> Lookup<'_> {
        Lookup { near: &self.near, ray: &self.ray }
    }

    /// A set from its [`SET_BYTES`] bytes. What is out of range is brought into range.
    pub(crate) fn from_bytes(bytes: &[u8]) -> Self {
        let mut rest = bytes;
        let mut take = |count: usize| {
            let (head, tail) = rest.split_at(count.min(rest.len()));
            rest = tail;
            head
        };
        fn levels<const N: usize>(voxel: &[u8], kind: &[u8]) -> Box<[ContextLevels; N]> {
            let in_range = |level: u8| level.min(LEVELS as u8 - 1);
            let mut levels = Box::new([ContextLevels::default(); N]);
            for ((to, voxel), kind) in levels.iter_mut().zip(voxel).zip(kind) {
                *to = ContextLevels { voxel: in_range(*voxel), kind: in_range(*kind) };
            }
            levels
        }
        fn chances<const N: usize>(bytes: &[u8]) -> [Chance; N] {
            let mut chances = [1 << 15; N];
            let pairs = bytes.as_chunks::<2>().0;
            chances.iter_mut().zip(pairs).for_each(|(to, pair)| *to = Chance::from_le_bytes(*pair).max(1));
            chances
        }
        let near = levels(take(NEAR_CONTEXTS), take(NEAR_CONTEXTS));
        let ray = levels(take(RAY_CONTEXTS), take(RAY_CONTEXTS));
        let start = Box::new(Chances {
            voxel: chances(take(2 * ROW_KINDS * LEVELS * LEVELS)),
            kind: chances(take(2 * LEVELS * LEVELS)),
            flag: chances(take(2 * FLAG_CONTEXTS)),
        });
        Self { near, ray, start }
    }

    /// The inverse of [`Self::from_bytes`].
    #[cfg(any(test, feature = "training"))]
    pub(crate) fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(SET_BYTES);
        bytes.extend(self.near.iter().map(|levels| levels.voxel));
        bytes.extend(self.near.iter().map(|levels| levels.kind));
        bytes.extend(self.ray.iter().map(|levels| levels.voxel));
        bytes.extend(self.ray.iter().map(|levels| levels.kind));
        let Chances { voxel, kind, flag } = &*self.start;
        for chance in voxel.iter().chain(kind).chain(flag) {
            bytes.extend_from_slice(&chance.to_le_bytes());
        }
        bytes
    }
}
