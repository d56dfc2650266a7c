//! What a robot sees on its flight, scan by scan.

use crate::{Lidar, Patrol, ScanOptions, World};
use flockmap_grid::{Pose, Scan, Stamp};
use std::sync::Arc;

/// One scan and where it was taken.
#[allow(non_snake_case)]
#[derive(Clone, PartialEq, Debug)]
pub struct Frame {
    /// When.
    pub stamp: Stamp,
    /// The scan, in the frame of the sensor.
    pub scan: Scan,
    /// The pose of the sensor in the frame of the world.
    pub T_map_sensor: Pose,
}

/// The scans of one robot along its patrol, made one at a time as they are asked for. Robots of a swarm share the world, each has a flight
/// of its own (they may run on different threads).
#[derive(Clone, Debug)]
pub struct Flight {
    world: Arc<World>,
    lidar: Lidar,
    options: ScanOptions,
    poses: std::vec::IntoIter<(Stamp, Pose)>,
}

impl Flight {
    /// The flight along `patrol` with this LiDAR, which sits at the centre of the robot.
    pub fn new(world: Arc<World>, lidar: Lidar, options: ScanOptions, patrol: Patrol) -> Self {
        Self { world, lidar, options, poses: patrol.into_poses().into_iter() }
    }
}

impl Iterator for Flight {
    type Item = Frame;

    fn next(&mut self) -> Option<Frame> {
        let (stamp, pose) = self.poses.next()?;
        let scan = self.lidar.scan(&self.world, &pose, stamp, &self.options);
        Some(Frame { stamp, scan, T_map_sensor: pose })
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        self.poses.size_hint()
    }
}

impl ExactSizeIterator for Flight {}
