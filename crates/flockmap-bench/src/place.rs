//! Generated worlds to fly through.

use flockmap_worlds::World;

/// A kind of generated world.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// 60 × 25 × 10 m.
    Forest,
    /// 35 × 30 × 4 m.
    Indoor,
}

impl Place {
    pub const fn name(self) -> &'static str {
        match self {
            Self::Forest => "forest",
            Self::Indoor => "indoor",
        }
    }

    pub fn world(self, seed: u64) -> World {
        match self {
            Self::Forest => World::forest(seed),
            Self::Indoor => World::indoor(seed),
        }
    }
}
