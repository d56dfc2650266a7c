//! What becomes of a block that is seen again when its submap is over.

use super::block::MapBlock;
use super::submaps::is_over;
use super::{Mapper, ScanReport};
use crate::submap::BlockBox;
use crate::{BlockIndex, Plane, Sheet, Stamp, State, StateBlock, SubmapId, Voxel, voxel_bit};

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
        let block = self.blocks.get(index);
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
        let Some(block) = self.blocks.get_mut(index) else { return true };
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
            *block = MapBlock::new(sheet, self.submaps.current);
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

    /// The submap with which a block moves, and the sheet on which it is published.
    pub fn place_of(&self, index: BlockIndex) -> Option<(SubmapId, Sheet)> {
        self.blocks.get(index).map(|block| (block.submap, block.sheet))
    }

    /// The indices of all blocks, in no order.
    pub(crate) fn indices(&self) -> impl Iterator<Item = BlockIndex> {
        self.blocks.iter().map(|(index, _)| index)
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
        self.mapper.blocks.get(index).filter(|block| block.submap == self.submap)
    }
}
