//! Decisions on their way to bytes.

use super::cells::Bits;
use super::coder::{BitWriter, Chance, Mark};
use super::decide::{Decide, DecideVoxel, RowKind, UnknownRow, voxels};
use super::tables::{Chances, KIND_CHANCES, Lookup, Tables, VOXEL_CHANCES, voxel_chance};

/// How fast a chance follows what happens: a step of one in 2ⁿ.
pub(crate) const VOXEL_RATE: u32 = 5;
pub(crate) const KIND_RATE: u32 = 4;
pub(crate) const FLAG_RATE: u32 = 6;

/// Writes the decisions of one package, learning on the way.
pub(crate) struct Writer<'a> {
    chances: &'a mut Chances,
    tables: &'static Tables,
    bits: BitWriter<'a>,
}

impl<'a> Writer<'a> {
    pub(crate) fn new(tables: &'static Tables, chances: &'a mut Chances, out: &'a mut Vec<u8>) -> Self {
        chances.clone_from(&tables.start);
        Self { chances, tables, bits: BitWriter::new(out) }
    }

    /// Where the writer stands.
    pub(crate) fn mark(&self) -> Mark {
        self.bits.mark()
    }

    /// Takes back what was written after a mark, the newest. Nothing but [`Self::finish`] may follow.
    pub(crate) fn back_to(&mut self, mark: &Mark) {
        self.bits.back_to(mark);
    }

    /// Bytes if it were finished now.
    pub(crate) fn finished_len(&self) -> usize {
        self.bits.finished_len()
    }

    pub(crate) fn finish(self) {
        self.bits.finish();
    }
}

impl Decide for Writer<'_> {
    #[inline]
    fn flag(&mut self, context: usize, truth: bool) -> bool {
        self.bits.put_and_learn(&mut self.chances.flag[context], truth, FLAG_RATE);
        truth
    }

    #[inline]
    fn row(&mut self, row: &UnknownRow, truth: Bits) -> Bits {
        // A copy of its own, so that it can stay in registers.
        let Chances { voxel, kind, .. } = &mut *self.chances;
        let mut writer = RowWriter { voxel, kind, lookup: self.tables.lookup(), bits: self.bits.borrowed() };
        let told = voxels(&mut writer, row, truth);
        let state = writer.bits.state();
        self.bits.set_state(state);
        told
    }
}

struct RowWriter<'a> {
    voxel: &'a mut [Chance; VOXEL_CHANCES],
    kind: &'a mut [Chance; KIND_CHANCES],
    lookup: Lookup<'static>,
    bits: BitWriter<'a>,
}

impl DecideVoxel for RowWriter<'_> {
    #[inline(always)]
    fn voxel(&mut self, kind: RowKind, contexts: [u16; 2], truth: bool) -> bool {
        self.bits.put_and_learn(
            &mut self.voxel[voxel_chance(kind, self.lookup.level(contexts))],
            truth,
            VOXEL_RATE,
        );
        truth
    }

    #[inline(always)]
    fn kind(&mut self, contexts: [u16; 2], truth: bool) -> bool {
        self.bits.put_and_learn(&mut self.kind[self.lookup.kind(contexts)], truth, KIND_RATE);
        truth
    }
}
