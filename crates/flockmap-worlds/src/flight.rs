//! What a robot sees on its flight, scan by scan.

use crate::{Lidar, ScanOptions, Scanner, Tracks, Trajectory, World};
use flockmap_grid::{Pose, Stamp};
use flockmap_io::Frame;
use std::sync::Arc;

/// The scans of one robot along its trajectory, made one at a time as they are asked for. Robots of a swarm share
/// the world, each has a flight of its own (they may run on different threads).
///
/// With [`ScanOptions::motion`] a scan is taken between the pose of its frame and the next; the last of a
/// flight is taken standing.
#[derive(Clone, Debug)]
pub struct Flight {
    scanner: Scanner,
    tracks: Option<(Arc<Tracks>, Option<usize>)>,
    poses: std::vec::IntoIter<(Stamp, Pose)>,
}

impl Flight {
    /// The flight along `trajectory` with this LiDAR, which sits at the centre of the robot.
    pub fn new(world: Arc<World>, lidar: Lidar, options: ScanOptions, trajectory: Trajectory) -> Self {
        let scanner = Scanner::new(world, lidar, options);
        Self { scanner, tracks: None, poses: trajectory.into_poses().into_iter() }
    }

    /// The same flight among things that move. `own` is the track of the robot itself, if it is one of them:
    /// a robot does not see itself.
    #[must_use]
    pub fn among(mut self, tracks: Arc<Tracks>, own: Option<usize>) -> Self {
        self.tracks = Some((tracks, own));
        self
    }
}

impl Iterator for Flight {
    type Item = Frame;

    fn next(&mut self) -> Option<Frame> {
        let (stamp, pose) = self.poses.next()?;
        let end = self.poses.as_slice().first().map(|(_, end)| *end);
        let bodies = self.tracks.as_ref().map(|(tracks, own)| tracks.bodies_at(stamp, *own));
        let scan = self.scanner.scan(stamp, &pose, end.as_ref(), &bodies.unwrap_or_default());
        Some(Frame { scan, t_map_sensor: pose, points_dropped: 0 })
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        self.poses.size_hint()
    }
}

impl ExactSizeIterator for Flight {}
