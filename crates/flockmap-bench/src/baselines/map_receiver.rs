//! The receiver of every method whose messages say states and no stamps: what is said last holds.

use anyhow::Result;
use flockmap::grid::{BlockIndex, StateBlock};

use crate::baselines::state_map::StateMap;
use crate::baselines::traits::Receiver;

/// Applies messages with the function of the method.
pub(crate) struct MapReceiver {
    map: StateMap,
    apply: fn(&[u8], &mut StateMap) -> Result<()>,
}

impl MapReceiver {
    pub(crate) fn new(apply: fn(&[u8], &mut StateMap) -> Result<()>) -> Self {
        Self { map: StateMap::default(), apply }
    }
}

impl Receiver for MapReceiver {
    fn receive(&mut self, message: &[u8]) -> Result<()> {
        (self.apply)(message, &mut self.map)
    }

    fn states(&self) -> Box<dyn Iterator<Item = (BlockIndex, StateBlock)> + '_> {
        Box::new(self.map.blocks())
    }
}
