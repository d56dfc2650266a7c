//! The receiver of every method whose messages say states and no stamps: what is said last holds.

use flockmap_grid::{BlockIndex, State, StateBlock, Voxel};

use crate::{ReceiveError, Receiver, StateMap};

/// Applies messages with the function of the method.
pub(crate) struct MapReceiver {
    map: StateMap,
    apply: fn(&[u8], &mut StateMap) -> Result<(), ReceiveError>,
}

impl MapReceiver {
    pub(crate) fn new(apply: fn(&[u8], &mut StateMap) -> Result<(), ReceiveError>) -> Self {
        Self { map: StateMap::default(), apply }
    }
}

impl Receiver for MapReceiver {
    fn receive(&mut self, message: &[u8]) -> Result<(), ReceiveError> {
        (self.apply)(message, &mut self.map)
    }

    fn state(&self, voxel: Voxel) -> State {
        self.map.state(voxel)
    }

    fn states(&self) -> Box<dyn Iterator<Item = (BlockIndex, StateBlock)> + '_> {
        Box::new(self.map.blocks())
    }
}
