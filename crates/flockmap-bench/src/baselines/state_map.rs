//! A map of states without stamps: what a receiver makes of messages without stamps.

use anyhow::{Context, Result, ensure};
use flockmap::grid::{BlockIndex, Changes, State, StateBlock, Voxel, voxel_bit};
use rustc_hash::FxHashMap;

use crate::baselines::traits::Receiver;

/// Of a message that no sender made.
pub(crate) const DAMAGED: &str = "damaged message";

/// Most blocks that a map of states holds, 2²¹: about 340 MB, room for a million cubic metres at 0.1 m voxels.
pub const BLOCKS_MAX: usize = 1 << 21;

/// States by block; the newest message holds. At most [`BLOCKS_MAX`] blocks.
#[derive(Clone, Debug, Default)]
pub struct StateMap {
    blocks: FxHashMap<BlockIndex, StateBlock>,
}

impl StateMap {
    /// Takes over what is known in `newer`; the other voxels of the block stay.
    ///
    /// # Errors
    /// If there is no room for one more block.
    pub fn overlay(&mut self, index: BlockIndex, newer: &StateBlock) -> Result<()> {
        if newer.is_empty() {
            return Ok(());
        }
        ensure!(
            self.blocks.len() < BLOCKS_MAX || self.blocks.contains_key(&index),
            "the map would grow beyond {BLOCKS_MAX} blocks of 8³ voxels"
        );
        self.blocks.entry(index).or_default().overlay(newer);
        Ok(())
    }

    /// Takes over all changes.
    ///
    /// # Errors
    /// As for [`Self::overlay`].
    pub fn apply(&mut self, changes: &Changes) -> Result<()> {
        changes.blocks().iter().try_for_each(|(index, block)| self.overlay(*index, block))
    }

    /// Sets one voxel of a block that is in the map already; without that block nothing is done.
    pub(crate) fn set(&mut self, index: BlockIndex, bit: usize, state: State) {
        if let Some(block) = self.blocks.get_mut(&index) {
            block.set(bit, state);
        }
    }

    /// State of a voxel.
    pub fn state(&self, voxel: Voxel) -> State {
        self.blocks.get(&voxel.block()).map_or(State::Unknown, |block| block.get(voxel_bit(voxel)))
    }

    /// The states of a block; nothing known, if there is none.
    pub fn block(&self, index: BlockIndex) -> StateBlock {
        self.blocks.get(&index).copied().unwrap_or_default()
    }

    /// All blocks, in no order.
    pub fn blocks(&self) -> impl Iterator<Item = (BlockIndex, StateBlock)> + '_ {
        self.blocks.iter().map(|(index, block)| (*index, *block))
    }
}

/// The receiver of every method whose messages hold states and no stamps.
pub(crate) struct MapReceiver {
    map: StateMap,
    /// What a message changes; `None` if it is damaged.
    parse: fn(&[u8]) -> Option<Changes>,
}

impl MapReceiver {
    pub(crate) fn new(parse: fn(&[u8]) -> Option<Changes>) -> Self {
        Self { map: StateMap::default(), parse }
    }
}

impl Receiver for MapReceiver {
    fn receive(&mut self, message: &[u8]) -> Result<()> {
        self.map.apply(&(self.parse)(message).context(DAMAGED)?)
    }

    fn states(&self) -> Box<dyn Iterator<Item = (BlockIndex, StateBlock)> + '_> {
        Box::new(self.map.blocks())
    }
}
