//! Collision-free flights through a world.

mod options;
mod region;
mod route;
mod smooth;
mod space;

use crate::World;
use crate::random::Random;
use flockmap_grid::{Pose, Stamp};
pub use options::{ROBOTS_MAX, TrajectoryError, TrajectoryOptions};
use space::Space;

/// The flight of one robot: its poses, ten a second.
#[derive(Clone, PartialEq, Debug)]
pub struct Trajectory {
    poses: Vec<(Stamp, Pose)>,
    clearance_m: f64,
}

impl Trajectory {
    /// Flights for `robots` robots that never touch anything and never come closer to each other than
    /// [`TrajectoryOptions::separation_m`].
    ///
    /// The space is divided into as many connected parts of about the same size; each robot flies in its own
    /// part, so that no flight depends on another's timing (their sensors see across the borders). It starts
    /// near the common middle and visits places spread over its part, nearest first, again and again, at
    /// changing heights. Robots fly level, nose first. The same arguments give the same flights on every
    /// machine. Cost: about 10 bytes and 50 ns for each cell of 10 to 20 cm of the world, and some
    /// milliseconds a leg.
    pub fn plan(
        world: &World,
        robots: usize,
        seed: u64,
        options: &TrajectoryOptions,
    ) -> Result<Vec<Self>, TrajectoryError> {
        options.check(robots)?;
        let space = Space::new(world, options)?;
        let regions = region::divide(&space, robots, options)?;
        let mut trajectories = Vec::with_capacity(robots);
        for (robot, region) in regions.iter().enumerate() {
            let mut random = Random::new(seed, 0x9a7 + robot as u64);
            let path = route::trajectory(&space, region, options, &mut random);
            let poses = smooth::fly(&space, region, &path, options);
            trajectories.push(Self { poses, clearance_m: space.clearance_m });
        }
        Ok(trajectories)
    }

    /// Stamps and poses of the robot, 0.1 s apart.
    pub fn poses(&self) -> &[(Stamp, Pose)] {
        &self.poses
    }

    /// The same, moved out.
    pub fn into_poses(self) -> Vec<(Stamp, Pose)> {
        self.poses
    }

    /// Metres that the robot keeps at least from anything solid.
    pub const fn clearance_m(&self) -> f64 {
        self.clearance_m
    }
}
