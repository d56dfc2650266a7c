//! Which blocks of a layer are in which submap.

use std::collections::BTreeMap;

use rustc_hash::FxHashMap;

use super::{BlockBox, Sheet, SubmapId};
use crate::memory::table_bytes;
use crate::{BlockIndex, Stamp};

/// When the submaps of a stream began, and the newest stamp of each block that may be in another one than the first.
///
/// A block is in the submap in which its newest stamp lies, as far as it is known when submaps began. On sheet n lies
/// nothing of the first n submaps: what by the known ones would be, is of one of which it is not known yet.
#[derive(Debug, Default)]
pub(crate) struct Spans {
    /// Of all that are known but the first. Numbers ascend, and stamps do not descend.
    begins: Vec<(Stamp, SubmapId)>,
    newest: FxHashMap<BlockIndex, Stamp>,
    /// Round the blocks of each submap on each sheet, and perhaps others.
    boxes: BTreeMap<(SubmapId, Sheet), BlockBox>,
}

/// A block in the table.
const BLOCK_BYTES: usize = size_of::<(BlockIndex, Stamp)>();
/// A submap, and a box, about.
const SUBMAP_BYTES: usize = 96;

impl Spans {
    /// Whether no submap is known but the first.
    pub(crate) const fn is_empty(&self) -> bool {
        self.begins.is_empty()
    }

    /// The known submaps in their order, the first one too.
    pub(crate) fn submaps(&self) -> impl Iterator<Item = SubmapId> {
        core::iter::once(SubmapId::FIRST).chain(self.begins.iter().map(|(_, submap)| *submap))
    }

    /// When a submap began, if that is known.
    pub(crate) fn began(&self, submap: SubmapId) -> Option<Stamp> {
        let place = self.begins.binary_search_by_key(&submap, |(_, known)| *known).ok()?;
        self.begins.get(place).map(|(stamp, _)| *stamp)
    }

    /// When the earliest began of those that are known, but the first.
    pub(crate) fn first_begin(&self) -> Option<Stamp> {
        self.begins.first().map(|(stamp, _)| *stamp)
    }

    /// Notes when a submap began. Whether that was not known, and can be. `blocks`: a box round all blocks so far, of
    /// the first submap if no other is known.
    pub(crate) fn begin(
        &mut self,
        submap: SubmapId,
        stamp: Stamp,
        blocks: impl FnOnce() -> Option<BlockBox>,
    ) -> bool {
        let place = self.begins.partition_point(|(_, other)| *other < submap);
        let before = place.checked_sub(1).and_then(|before| self.begins.get(before));
        let after = self.begins.get(place);
        // Several may begin at once: nothing was published in those before the last of them.
        let is_sound = before.is_none_or(|(before, _)| *before <= stamp)
            && after.is_none_or(|(after, next)| *next != submap && stamp <= *after);
        if submap == SubmapId::FIRST || !is_sound {
            return false;
        }
        let before = before.map_or(SubmapId::FIRST, |(_, before)| *before);
        if self.begins.is_empty()
            && let Some(blocks) = blocks()
        {
            self.boxes.insert((SubmapId::FIRST, Sheet::FIRST), blocks);
        }
        // What was counted to the one before may be in this one.
        let divided = self.boxes.range((before, Sheet::FIRST)..);
        let divided = divided.take_while(|((of, _), _)| *of == before);
        let divided: Vec<_> = divided.map(|((_, sheet), blocks)| ((submap, *sheet), *blocks)).collect();
        self.boxes.extend(divided);
        self.begins.insert(place, (stamp, submap));
        true
    }

    /// The submap at a time.
    pub(crate) fn at(&self, stamp: Stamp) -> SubmapId {
        let begun = self.begins.partition_point(|(began, _)| *began <= stamp).checked_sub(1);
        begun.and_then(|last| self.begins.get(last)).map_or(SubmapId::FIRST, |(_, submap)| *submap)
    }

    /// The submap of a block; `None` if it is not known, or no block of a map lies there.
    pub(crate) fn of(&self, block: BlockIndex) -> Option<SubmapId> {
        let sheet = Sheet::of(block)?;
        let submap = self.newest.get(&block).map_or(SubmapId::FIRST, |newest| self.at(*newest));
        (submap.number() >= sheet.number()).then_some(submap)
    }

    /// Notes the newest stamp of a block, `None` if there is none any more.
    pub(crate) fn note(&mut self, block: BlockIndex, newest: Option<Stamp>) {
        let (Some(sheet), Some(first)) = (Sheet::of(block), self.first_begin()) else { return };
        let Some(newest) = newest else {
            self.newest.remove(&block);
            return;
        };
        if first <= newest {
            self.newest.insert(block, newest);
        } else {
            self.newest.remove(&block);
        }
        let blocks = self.boxes.entry((self.at(newest), sheet));
        blocks.or_insert_with(|| BlockBox::new(block)).add(block);
    }

    /// Each sheet with something of a submap, and a box round that.
    pub(crate) fn parts(&self) -> impl Iterator<Item = (SubmapId, Sheet, BlockBox)> {
        let parts = self.boxes.iter().map(|((submap, sheet), blocks)| (*submap, *sheet, *blocks));
        parts.filter(|(submap, sheet, _)| submap.number() >= sheet.number())
    }

    /// Bytes on the heap, about. O(1).
    pub(crate) fn memory_bytes(&self) -> usize {
        table_bytes(self.newest.capacity(), BLOCK_BYTES)
            + (self.begins.len() + self.boxes.len()) * SUBMAP_BYTES
    }

    /// The most by which so many further blocks can make it grow.
    pub(crate) fn growth_max(&self, blocks: usize) -> usize {
        if self.is_empty() {
            return 0;
        }
        let now = table_bytes(self.newest.capacity(), BLOCK_BYTES);
        // While a table grows, the old one is there too.
        let then = table_bytes(self.newest.len() + blocks, BLOCK_BYTES);
        blocks.min(64) * SUBMAP_BYTES + if then > now { then } else { 0 }
    }
}
