//! Which submap the blocks of the own map are in, and which of them begin anew.

use std::collections::BTreeMap;

use super::block::MapBlock;
use super::{Mapper, MovedBlock, ScanReport};
use crate::submap::BlockBox;
use crate::{BlockIndex, Plane, Sheet, Stamp, State, StateBlock, SubmapId, Voxel, voxel_bit};

/// Of all blocks of the map.
#[derive(Default)]
pub(super) struct Submaps {
    /// In which it is written.
    current: SubmapId,
    /// The first submap in which blocks were forgotten.
    forgot_in: Option<SubmapId>,
    /// A box round the blocks of each.
    boxes: BTreeMap<SubmapId, BlockBox>,
    /// Blocks that began anew, or began on a later sheet.
    begun_anew: u64,
}

impl Submaps {
    /// A block that is not there: where one may have been forgotten that is over, on a sheet on which there is none.
    pub(super) fn new_block(&mut self) -> MapBlock {
        let is_doubtful = self.forgot_in.is_some_and(|first| is_over(first, self.current));
        let sheet = Sheet::new(self.current.number()).filter(|_| is_doubtful).unwrap_or_default();
        self.begun_anew += u64::from(is_doubtful);
        MapBlock::new(sheet, self.current)
    }

    /// A block is touched in the current submap, and moves with that from now on.
    pub(super) fn note_touched(
        &mut self,
        index: BlockIndex,
        block: &mut MapBlock,
        moved: &mut Vec<MovedBlock>,
    ) {
        if block.submap != self.current {
            moved.push(block.at(index));
            block.submap = self.current;
        }
        let of_submap = self.boxes.entry(self.current).or_insert_with(|| BlockBox::new(index));
        of_submap.add(index);
    }

    /// A block is gone, with the number of its sheet.
    pub(super) fn note_forgotten(
        &mut self,
        index: BlockIndex,
        block: &MapBlock,
        moved: &mut Vec<MovedBlock>,
    ) {
        self.forgot_in.get_or_insert(self.current);
        if self.current != SubmapId::FIRST {
            moved.push(block.at(index));
        }
    }
}

impl MapBlock {
    fn at(&self, index: BlockIndex) -> MovedBlock {
        MovedBlock { index, submap: self.submap, sheet: self.sheet, known: self.states().known() }
    }
}

/// Whether what was touched last in a submap begins anew when it is seen in the current one: neither in it nor in the
/// one before was it seen. Where one begins, what is around the robot goes on.
fn is_over(submap: SubmapId, current: SubmapId) -> bool {
    submap.number() + 1 < current.number()
}

impl Mapper {
    /// Begins the next submap, in which scans are written from now on; `None` if there are [`SubmapId::COUNT`]
    /// already. Blocks that were touched neither in the one that ends nor in the new one begin anew when a scan would
    /// change them and all of them is published; until then, and where nothing changes, they stay as they are.
    pub fn begin_submap(&mut self) -> Option<SubmapId> {
        let next = self.submaps.current.next()?;
        self.submaps.current = next;
        Some(next)
    }

    /// The submap in which scans are written.
    pub const fn submap(&self) -> SubmapId {
        self.submaps.current
    }

    /// How many blocks began anew.
    pub const fn begun_anew(&self) -> u64 {
        self.submaps.begun_anew
    }

    /// Whether a block may begin anew. What is not published yet would be lost.
    pub(super) fn is_over(&self, index: BlockIndex) -> bool {
        if self.submaps.current.number() < 2 {
            return false;
        }
        let block = self.blocks.get(&index);
        block.is_some_and(|block| is_over(block.submap, self.submaps.current) && block.changes().is_empty())
    }

    /// A block that is over is met again: where `change` makes no difference there, it counts as one more observation
    /// of what is known, which goes on to move with its own submap. Else the block begins anew, if there is a sheet for
    /// it, and is still to be changed: so it says.
    pub(super) fn revisit(
        &mut self,
        index: BlockIndex,
        report: &mut ScanReport,
        change: impl FnOnce(&mut MapBlock) -> Plane,
    ) -> bool {
        let Some(block) = self.blocks.get_mut(&index) else { return true };
        let mut seen_again = block.clone();
        let touched = change(&mut seen_again);
        if seen_again.states() == block.states() {
            *block = seen_again;
            if touched != [0; 8] {
                report.touched.push((index, touched));
            }
            return false;
        }
        let next = Sheet::new(block.sheet.number() + 1).filter(|sheet| sheet.block(index).is_some());
        if let Some(sheet) = next {
            report.moved.push(block.at(index));
            **block = MapBlock::new(sheet, self.submaps.current);
            self.submaps.begun_anew += 1;
        }
        true
    }

    /// The blocks of each submap, with a box round them.
    pub(crate) fn submaps(&self) -> impl Iterator<Item = (SubmapId, BlockBox)> {
        self.submaps.boxes.iter().map(|(submap, blocks)| (*submap, *blocks))
    }

    /// The blocks of a submap.
    pub(crate) const fn blocks_of(&self, submap: SubmapId) -> OwnBlocks<'_> {
        OwnBlocks { mapper: self, submap }
    }

    /// The submap and the sheet of a block.
    pub(crate) fn place_of(&self, index: BlockIndex) -> Option<(SubmapId, Sheet)> {
        self.blocks.get(&index).map(|block| (block.submap, block.sheet))
    }

    /// The indices of all blocks, in no order.
    pub(crate) fn indices(&self) -> impl Iterator<Item = BlockIndex> {
        self.blocks.keys().copied()
    }
}

/// What of the own map is in one submap.
#[derive(Clone, Copy)]
pub(crate) struct OwnBlocks<'a> {
    mapper: &'a Mapper,
    submap: SubmapId,
}

impl OwnBlocks<'_> {
    pub(crate) fn block(&self, index: BlockIndex) -> Option<StateBlock> {
        self.find(index).map(|block| *block.states())
    }

    pub(crate) fn get(&self, voxel: Voxel) -> Option<(State, Stamp)> {
        let (block, bit) = (self.find(voxel.block())?, voxel_bit(voxel));
        let number = usize::from(block.seen(bit)).checked_sub(1);
        let stamp = number.and_then(|number| self.mapper.scan_stamps.get(number).copied());
        let state = Some(block.states().get(bit)).filter(|state| *state != State::Unknown)?;
        Some((state, stamp.unwrap_or(Stamp(i64::MIN))))
    }

    fn find(&self, index: BlockIndex) -> Option<&MapBlock> {
        self.mapper.blocks.get(&index).map(Box::as_ref).filter(|block| block.submap == self.submap)
    }
}
