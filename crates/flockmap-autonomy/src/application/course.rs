//! Where the flight goes: a world, two places to start from, a goal.

use super::route::{self, Keep};
use super::slab::{Slab, Window};
use flockmap_worlds::World;
use flockmap_worlds::curve::distance;
use std::sync::Arc;

/// A world with a start and a goal. Robots fly at constant heights.
#[derive(Clone, Debug)]
pub struct Course {
    /// The world. Cheap to share.
    pub world: Arc<World>,
    /// Where the leader starts, in metres.
    pub leader_start: [f64; 3],
    /// Where the follower starts, in metres.
    pub follower_start: [f64; 3],
    /// Where the leader is to go, x and y in metres.
    pub goal: [f64; 2],
    /// Lowest and highest x and y that the robots may fly at: the edge of the world counts as an obstacle.
    pub fence: [[f64; 2]; 2],
}

/// The follower flies higher than the leader, so that the leader does not hide what lies ahead of it from its
/// follower.
pub(super) const FOLLOWER_HIGHER_M: f64 = 0.5;

/// Height of the leader above the ground of a thicket.
const LEADER_HEIGHT_M: f64 = 1.3;

/// A course counts as passable if a path keeps so far from everything (centre of a robot): 20 cm more than
/// its body.
const PASSABLE: Keep = Keep { clearance_m: 0.4, comfort_m: 0.41 };

impl Course {
    /// From one end of [`World::thicket`] to the other, 30 m. Takes some 0.1 s in a release build.
    pub fn thicket(seed: u64) -> Self {
        Self {
            world: Arc::new(World::thicket(seed)),
            leader_start: [4.0, 0.0, LEADER_HEIGHT_M],
            follower_start: [1.5, 0.0, LEADER_HEIGHT_M + FOLLOWER_HIGHER_M],
            goal: [34.0, 0.0],
            fence: [[0.3, -5.7], [35.7, 5.7]],
        }
    }

    /// Whether the leader could reach the goal if it knew the world. Looks at the world itself, as no robot can.
    /// O(cells of the world).
    pub fn is_passable(&self) -> bool {
        let start = [self.leader_start[0], self.leader_start[1]];
        let [low, high] = self.fence;
        let centre = [0, 1].map(|a| 0.5 * (low[a] + high[a]));
        let half_m = 0.5 * (high[0] - low[0]).max(high[1] - low[1]) + 1.0;
        let heights = [-0.3, 0.0, 0.3].map(|dz| self.leader_start[2] + dz);
        let mut slab = Slab::of_world(&self.world, &Window { centre, half_m, heights });
        slab.fence(self.fence);
        slab.measure();
        let path = route::find(&slab, start, self.goal, &[], &PASSABLE);
        path.and_then(|path| path.last().copied()).is_some_and(|end| distance(end, self.goal) < 0.1)
    }
}
