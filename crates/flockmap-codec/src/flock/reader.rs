//! Bytes back to decisions.

use super::cells::Bits;
use super::coder::{BitReader, Chance};
use super::decide::{Decide, DecideVoxel, RowKind, UnknownRow, voxels};
use super::tables::{Chances, KIND_CHANCES, Lookup, Tables, VOXEL_CHANCES, voxel_chance};
use super::writer::{FLAG_RATE, KIND_RATE, VOXEL_RATE};

/// Reads the decisions of one package, learning on the way as the writer did. Any bytes give some decisions.
pub(crate) struct Reader<'a> {
    chances: &'a mut Chances,
    tables: &'static Tables,
    bits: BitReader<'a>,
}

impl<'a> Reader<'a> {
    pub(crate) fn new(tables: &'static Tables, chances: &'a mut Chances, bytes: &'a [u8]) -> Self {
        chances.clone_from(&tables.start);
        Self { chances, tables, bits: BitReader::new(bytes) }
    }
}

impl Decide for Reader<'_> {
    const KNOWS: bool = false;

    #[inline]
    fn flag(&mut self, context: usize, _: bool) -> bool {
        self.bits.get_and_learn(&mut self.chances.flag[context], FLAG_RATE)
    }

    #[inline]
    fn row(&mut self, row: &UnknownRow, truth: Bits) -> Bits {
        // A copy of its own, so that it can stay in registers.
        let Chances { voxel, kind, .. } = &mut *self.chances;
        let mut reader = RowReader { voxel, kind, lookup: self.tables.lookup(), bits: self.bits.clone() };
        let told = voxels(&mut reader, row, truth);
        self.bits = reader.bits;
        told
    }
}

struct RowReader<'a, 'b> {
    voxel: &'b mut [Chance; VOXEL_CHANCES],
    kind: &'b mut [Chance; KIND_CHANCES],
    lookup: Lookup<'static>,
    bits: BitReader<'a>,
}

impl DecideVoxel for RowReader<'_, '_> {
    #[inline(always)]
    fn voxel(&mut self, kind: RowKind, contexts: [u16; 2], _: bool) -> bool {
        self.bits.get_and_learn(&mut self.voxel[voxel_chance(kind, self.lookup.level(contexts))], VOXEL_RATE)
    }

    #[inline(always)]
    fn kind(&mut self, contexts: [u16; 2], _: bool) -> bool {
        self.bits.get_and_learn(&mut self.kind[self.lookup.kind(contexts)], KIND_RATE)
    }
}
