//! What a robot sees on its flight, scan by scan.

use crate::{Lidar, Patrol, ScanOptions, Scanner, World};
use flockmap_grid::{Pose, Stamp};
use flockmap_io::{Frame, Frames};
use std::sync::Arc;

/// The scans of one robot along its patrol, made one at a time as they are asked for. Robots of a swarm share
/// the world, each has a flight of its own (they may run on different threads).
#[derive(Clone, Debug)]
pub struct Flight {
    scanner: Scanner,
    poses: std::vec::IntoIter<(Stamp, Pose)>,
}

impl Flight {
    /// The flight along `patrol` with this LiDAR, which sits at the centre of the robot.
    pub fn new(world: Arc<World>, lidar: Lidar, options: ScanOptions, patrol: Patrol) -> Self {
        Self { scanner: Scanner::new(world, lidar, options), poses: patrol.into_poses().into_iter() }
    }

    /// The flight as a record, to be used like one that was read from a file.
    pub fn into_frames(self) -> Frames {
        Frames::new(self.map(Ok))
    }
}

impl Iterator for Flight {
    type Item = Frame;

    fn next(&mut self) -> Option<Frame> {
        let (stamp, pose) = self.poses.next()?;
        let end = self.poses.as_slice().first().map(|(_, end)| *end);
        let scan = self.scanner.scan(stamp, &pose, end.as_ref(), &[]);
        Some(Frame { scan, t_map_sensor: pose, points_dropped: 0 })
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        self.poses.size_hint()
    }
}

impl ExactSizeIterator for Flight {}
