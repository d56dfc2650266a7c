//! In which submaps the blocks of the own map are.

use std::collections::BTreeMap;

use super::block::MapBlock;
use crate::submap::BlockBox;
use crate::{BlockIndex, Plane, Sheet, SubmapId};

/// A block of the own map before something became of it.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct MovedBlock {
    /// Which one.
    pub index: BlockIndex,
    /// The submap in which it was.
    pub submap: SubmapId,
    /// The sheet on which it was published.
    pub sheet: Sheet,
    /// What was known of it.
    pub known: Plane,
}

/// Of all blocks of the map.
#[derive(Default)]
pub(super) struct Submaps {
    /// In which it is written.
    pub(super) current: SubmapId,
    /// The first submap in which blocks were forgotten.
    forgot_in: Option<SubmapId>,
    /// A box round the blocks of each.
    pub(super) boxes: BTreeMap<SubmapId, BlockBox>,
    /// Blocks that began anew, or began on a later sheet.
    pub(super) begun_anew: u64,
}

impl Submaps {
    /// A block that is not there: where one may have been forgotten that is over, on a sheet on which there is none.
    pub(super) fn new_block(&mut self, index: BlockIndex, moved: &mut Vec<MovedBlock>) -> MapBlock {
        let is_doubtful = self.forgot_in.is_some_and(|first| is_over(first, self.current));
        let sheet = Sheet::new(self.current.number()).filter(|_| is_doubtful).unwrap_or_default();
        let block = MapBlock::new(sheet, self.current);
        if is_doubtful {
            self.begun_anew += 1;
            moved.push(block.at(index));
        }
        block
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
    pub(super) fn at(&self, index: BlockIndex) -> MovedBlock {
        MovedBlock { index, submap: self.submap, sheet: self.sheet, known: self.states().known() }
    }
}

/// Whether what was touched last in a submap begins anew when it is seen in the current one: neither in it nor in the
/// one before was it seen. Where one begins, what is around the robot goes on.
pub(super) fn is_over(submap: SubmapId, current: SubmapId) -> bool {
    submap.number() + 1 < current.number()
}
