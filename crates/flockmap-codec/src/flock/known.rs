//! What is known of blocks before a batch.

use core::cell::Cell;

use flockmap_grid::{BaseSuperseded, BlockIndex, Layer, Stamp, StateBlock};
use rustc_hash::FxHashMap;

/// The states before a batch, block by block.
#[derive(Clone, Debug)]
pub(crate) struct Known<'a> {
    before: Before<'a>,
    newest: Cell<Option<Stamp>>,
}

#[derive(Clone, Copy, Debug)]
enum Before<'a> {
    Nothing,
    /// What a layer knew before the batch with this end.
    Batch(&'a Layer, Stamp),
    /// These states, whose stamps do not matter.
    States(&'a FxHashMap<BlockIndex, StateBlock>),
}

impl<'a> Known<'a> {
    /// Nothing is known without a layer.
    pub(crate) fn new(layer: Option<&'a Layer>, batch_end: Stamp) -> Self {
        let before = layer.map_or(Before::Nothing, |layer| Before::Batch(layer, batch_end));
        Self { before, newest: Cell::new(None) }
    }

    /// Exactly these states are known.
    pub(crate) const fn of_states(states: &'a FxHashMap<BlockIndex, StateBlock>) -> Self {
        Self { before: Before::States(states), newest: Cell::new(None) }
    }

    /// What was known of a block before the batch.
    pub(crate) fn block(&self, index: BlockIndex) -> Result<Option<StateBlock>, BaseSuperseded> {
        let (layer, batch_end) = match self.before {
            Before::Nothing => return Ok(None),
            Before::States(states) => return Ok(states.get(&index).copied()),
            Before::Batch(layer, batch_end) => (layer, batch_end),
        };
        Ok(layer.known_before(index, batch_end)?.map(|(states, newest)| {
            self.newest.set(self.newest.get().max(Some(newest)));
            states
        }))
    }

    /// The newest stamp in the blocks asked for since this was called last. Before the batch, if nothing of
    /// it was applied.
    pub(crate) fn take_newest(&self) -> Option<Stamp> {
        self.newest.take()
    }
}

/// How much of a block is known, in classes.
#[derive(Clone, Copy, PartialEq, Eq, Default, Debug)]
pub(crate) struct KnownClasses {
    /// 0 … 6, and 0 if no voxel is Free.
    pub(crate) free: usize,
    /// 0 … 2, and 0 if no voxel is Occupied.
    pub(crate) occupied: usize,
}

impl KnownClasses {
    pub(crate) fn of(states: &StateBlock) -> Self {
        let (free, occupied) = (states.free(), states.occupied());
        let touched = free.iter().filter(|slice| **slice != 0).count();
        let full = free.iter().zip(occupied).filter(|(f, o)| **f | **o == u64::MAX).count();
        let free = match (touched, full) {
            (0, _) => 0,
            (1..=2, 0) => 1,
            (3..=6, 0) => 2,
            (_, 0) => 3,
            (_, 1..=4) => 4,
            (_, 5..=7) => 5,
            (_, _) => 6,
        };
        let occupied = match occupied.iter().filter(|slice| **slice != 0).count() {
            0 => 0,
            1..=2 => 1,
            _ => 2,
        };
        Self { free, occupied }
    }

    /// Whether anything is known.
    pub(crate) const fn is_any(self) -> bool {
        self.free + self.occupied != 0
    }
}
