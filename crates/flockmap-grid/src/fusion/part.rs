//! A part of what a robot has seen that lies in the fused map in one way.

use std::borrow::Cow;

use super::align::{Alignment, Blocks, one_by_one};
use super::received::Received;
use crate::mapper::OwnBlocks;
use crate::submap::Spans;
use crate::{BlockIndex, Layer, Mapper, Plane, Sheet, Stamp, State, StateBlock, Stream, SubmapId, Voxel};

/// What is known of one robot in one frame: a layer, a submap on a sheet of one, or a submap of the own map.
pub(super) struct Part<'a> {
    pub stream: Stream,
    pub submap: SubmapId,
    pub alignment: Cow<'a, Alignment>,
    pub blocks: PartBlocks<'a>,
    /// When it came here, and how far the clock of its origin is off; `None`: it is of this robot.
    pub received: Option<(&'a Received, i64)>,
}

pub(super) enum PartBlocks<'a> {
    Layer(&'a Layer),
    Submap { layer: &'a Layer, spans: &'a Spans, submap: SubmapId, sheet: Sheet },
    Own(OwnBlocks<'a>),
    OwnBefore { layer: &'a Layer, spans: &'a Spans, submap: SubmapId, sheet: Sheet, mapper: &'a Mapper },
}

impl PartBlocks<'_> {
    /// Whether a block of a layer is of this part.
    fn has(&self, index: BlockIndex) -> bool {
        let is_of =
            |spans: &Spans, submap, sheet| Sheet::of(index) == Some(sheet) && spans.of(index) == Some(submap);
        match *self {
            Self::Layer(_) | Self::Own(_) => true,
            Self::Submap { spans, submap, sheet, .. } => is_of(spans, submap, sheet),
            Self::OwnBefore { spans, submap, sheet, mapper, .. } => {
                is_over(mapper, index) && is_of(spans, submap, sheet)
            }
        }
    }
}

/// Whether the own map has begun a block anew since what was published there.
pub(super) fn is_over(mapper: &Mapper, index: BlockIndex) -> bool {
    let Some(sheet) = Sheet::of(index) else { return false };
    mapper.place_of(sheet.local(index)).is_some_and(|(_, now)| now > sheet)
}

impl Blocks for PartBlocks<'_> {
    fn block(&self, index: BlockIndex) -> Option<StateBlock> {
        match self {
            Self::Own(blocks) => blocks.block(index),
            Self::Layer(layer) => layer.block(index),
            Self::Submap { layer, .. } | Self::OwnBefore { layer, .. } => {
                layer.block(index).filter(|_| self.has(index))
            }
        }
    }

    fn get(&self, voxel: Voxel) -> Option<(State, Stamp)> {
        match self {
            Self::Own(blocks) => blocks.get(voxel),
            Self::Layer(layer) => layer.get(voxel),
            Self::Submap { layer, .. } | Self::OwnBefore { layer, .. } => {
                layer.get(voxel).filter(|_| self.has(voxel.block()))
            }
        }
    }

    fn each_block(&self, indices: impl Iterator<Item = BlockIndex>, found: impl FnMut(usize, StateBlock)) {
        match self {
            Self::Layer(layer) => layer.each_block(indices, found),
            _ => one_by_one(self, indices, found),
        }
    }
}

impl Part<'_> {
    /// What it says of voxels of the fused map, block by block, with the number of the target.
    pub(super) fn blocks(&self, targets: &[(BlockIndex, Plane)], found: impl FnMut(usize, StateBlock)) {
        self.alignment.blocks(&self.blocks, targets, found);
    }

    /// What it says of a voxel of the fused map, and when that counts as made.
    pub(super) fn look_up(&self, voxel: Voxel, own_priority_micros: i64) -> Option<(State, Stamp)> {
        let (state, stamp) = self.alignment.look_up(&self.blocks, voxel)?;
        let made = match self.received {
            Some((received, clock_offset_micros)) => received.made(stamp, clock_offset_micros),
            None => stamp.plus_micros(own_priority_micros),
        };
        Some((state, made))
    }
}
