//! What a planner keeps away from.

use flockmap_grid::{Plane, State, StateBlock};

/// Which voxels are obstacles.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug, Default)]
pub enum Obstacles {
    /// What was seen to be Occupied. Unknown counts as free: for planners that look for themselves while they go.
    #[default]
    Occupied,
    /// Whatever was not seen to be Free: Occupied and Unknown. For planners that go only where somebody looked.
    NotFree,
}

impl Obstacles {
    /// Whether a voxel of this state is an obstacle.
    pub const fn contain(self, state: State) -> bool {
        match self {
            Self::Occupied => matches!(state, State::Occupied),
            Self::NotFree => !matches!(state, State::Free),
        }
    }

    /// The voxels of a block that are obstacles; `None` is a block of which nothing is known, as
    /// [`flockmap_grid::MapView::block`] has it.
    pub fn of(self, block: Option<&StateBlock>) -> Plane {
        match (self, block) {
            (Self::Occupied, None) => [0; 8],
            (Self::Occupied, Some(block)) => *block.occupied(),
            (Self::NotFree, None) => [u64::MAX; 8],
            (Self::NotFree, Some(block)) => block.free().map(|slice| !slice),
        }
    }
}
