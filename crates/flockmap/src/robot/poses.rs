//! Where the robots are, as far as one of them knows.

use std::collections::BTreeMap;

use flockmap_grid::{RobotId, Stamp, Stream};

use super::Robot;

/// Where a robot was last, as far as this one knows.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct KnownPose {
    /// The robot and its run.
    pub stream: Stream,
    /// Where its sensor was, in metres in the frame of the own map.
    pub position: [f64; 3],
    /// How its sensor was turned in the own map: a quaternion x, y, z, w. Of the own robot only; packages do
    /// not say it.
    pub orientation: Option<[f64; 4]>,
    /// When, on the own clock.
    pub seen: Stamp,
}

impl Robot {
    /// Where the robots are, in ascending order of their ids. The own one: where its newest scan was made, once
    /// there is one. The others: where the sensor was in the newest batch that was received, to a sixteenth of
    /// a voxel, moved by [`Self::set_alignment`]; so they are late by the publish period and the radio. Nothing
    /// is sent for this. O(streams).
    pub fn poses(&self) -> Vec<KnownPose> {
        let mut poses = BTreeMap::<RobotId, KnownPose>::new();
        for (stream, position, seen) in self.fusion.sensors() {
            let pose = KnownPose { stream, position, orientation: None, seen };
            let newest = poses.entry(stream.origin).or_insert(pose);
            if newest.seen < seen {
                *newest = pose;
            }
        }
        if let Some((seen, pose)) = self.pose {
            let orientation = Some(pose.quaternion_xyzw());
            let own =
                KnownPose { stream: self.own_stream(), position: pose.translation(), orientation, seen };
            poses.insert(self.config.id, own);
        }
        poses.into_values().collect()
    }
}
