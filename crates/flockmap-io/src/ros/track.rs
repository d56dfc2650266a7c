//! Where something was over time.

use std::collections::VecDeque;

use flockmap_grid::{Pose, Stamp};
use glam::{DQuat, DVec3};

/// Poses of one frame in another over time, in the order of their stamps. 64 bytes a pose.
#[derive(Clone, Debug, Default)]
pub struct Track {
    poses: VecDeque<(Stamp, Pose)>,
    unordered: bool,
}

/// How far a pose may be taken from its own time.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Reach {
    /// Longest time between two poses to interpolate between, in microseconds.
    pub gap_max: i64,
    /// Longest time to a single pose to take it as it is, in microseconds. 0: whoever looks up poses as they come
    /// waits for the next one.
    pub near: i64,
}

/// Why a track has no pose at a time.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
pub enum NoPoseThen {
    /// The time lies behind the newest pose: the pose may come yet.
    #[error("{}", match newest {
        Some(newest) => format!("the newest pose is of {:.6} s", newest.seconds()),
        None => "no pose came so far".to_owned(),
    })]
    NotYet {
        /// Stamp of the newest pose, if there is one.
        newest: Option<Stamp>,
    },
    /// The time lies before the oldest pose that is kept.
    #[error("the oldest pose is of {:.6} s", oldest.seconds())]
    TooOld {
        /// Stamp of the oldest pose.
        oldest: Stamp,
    },
    /// The poses around the time are too far apart.
    #[error("no pose between {:.6} s and {:.6} s", before.seconds(), after.seconds())]
    Gap {
        /// Stamp of the pose before.
        before: Stamp,
        /// Stamp of the pose after.
        after: Stamp,
    },
}

impl Track {
    /// Takes over a pose, wherever it belongs in time; it replaces one of the same stamp. Cost: nothing for a
    /// pose later than all others, else the poses behind it are moved.
    pub fn push(&mut self, stamp: Stamp, pose: Pose) {
        if self.poses.back().is_none_or(|(newest, _)| *newest < stamp) {
            self.poses.push_back((stamp, pose));
            return;
        }
        let at = self.poses.partition_point(|(s, _)| *s < stamp);
        match self.poses.get_mut(at) {
            Some(entry) if entry.0 == stamp => entry.1 = pose,
            _ => self.poses.insert(at, (stamp, pose)),
        }
    }

    /// Takes over a pose of a log, which may have millions in any order: [`Self::sort`] puts them in order.
    pub(crate) fn collect(&mut self, stamp: Stamp, pose: Pose) {
        self.poses.push_back((stamp, pose));
        self.unordered = true;
    }

    /// Puts the poses in order; of several with one stamp the last counts. Needed after [`Self::collect`].
    pub(crate) fn sort(&mut self) {
        // Turned round, the one that came last stands first among its equals, and the first is kept.
        let mut poses = Vec::from(core::mem::take(&mut self.poses));
        poses.reverse();
        poses.sort_by_key(|(stamp, _)| *stamp);
        poses.dedup_by_key(|(stamp, _)| *stamp);
        self.poses = poses.into();
        self.unordered = false;
    }

    /// Forgets the poses before a time, except the last of them: what is asked at that time or later gets the
    /// same answer as before.
    pub fn forget_before(&mut self, stamp: Stamp) {
        let after = self.poses.partition_point(|(s, _)| *s <= stamp);
        self.poses.drain(..after.saturating_sub(1));
    }

    /// Forgets the oldest poses if there are more than `most`.
    pub fn keep_newest(&mut self, most: usize) {
        self.poses.drain(..self.poses.len().saturating_sub(most));
    }

    /// Number of poses.
    pub fn len(&self) -> usize {
        self.poses.len()
    }

    /// Whether there is no pose.
    pub fn is_empty(&self) -> bool {
        self.poses.is_empty()
    }

    /// Stamp of the newest pose.
    pub fn newest(&self) -> Option<Stamp> {
        self.poses.back().map(|(stamp, _)| *stamp)
    }

    /// The pose at a time: as recorded, or between the two around it (straight line, shortest turn), or that of
    /// a single one near it.
    ///
    /// # Errors
    /// There is none within `reach`: [`NoPoseThen`] says why.
    pub fn at(&self, stamp: Stamp, reach: Reach) -> Result<Pose, NoPoseThen> {
        debug_assert!(!self.unordered);
        let after = self.poses.partition_point(|(s, _)| *s < stamp);
        let next = self.poses.get(after);
        let previous = after.checked_sub(1).and_then(|i| self.poses.get(i));
        let away = |entry: &&(Stamp, Pose)| entry.0.micros_since(stamp).saturating_abs();
        let found = match (previous, next) {
            (_, Some((s, pose))) if *s == stamp => Some(*pose),
            (Some((a, pose_a)), Some((b, pose_b))) if b.micros_since(*a) <= reach.gap_max => {
                let share = stamp.micros_since(*a) as f64 / b.micros_since(*a) as f64;
                between(pose_a, pose_b, share)
            }
            _ => previous
                .into_iter()
                .chain(next)
                .min_by_key(away)
                .filter(|entry| away(entry) <= reach.near)
                .map(|(_, pose)| *pose),
        };
        found.ok_or_else(|| match (previous, next) {
            (Some((before, _)), Some((after, _))) => NoPoseThen::Gap { before: *before, after: *after },
            (None, Some((oldest, _))) => NoPoseThen::TooOld { oldest: *oldest },
            (newest, None) => NoPoseThen::NotYet { newest: newest.map(|(stamp, _)| *stamp) },
        })
    }
}

fn between(a: &Pose, b: &Pose, share: f64) -> Option<Pose> {
    let place = DVec3::from_array(a.translation()).lerp(DVec3::from_array(b.translation()), share);
    let from = DQuat::from_array(a.quaternion_xyzw());
    let to = DQuat::from_array(b.quaternion_xyzw());
    Pose::new(place.to_array(), from.slerp(to, share).to_array())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const REACH: Reach = Reach { gap_max: 500_000, near: 10_000 };

    fn track(poses: &[(i64, f64, f64)]) -> Track {
        let mut track = Track::default();
        for &(stamp, x, yaw) in poses {
            track.collect(Stamp(stamp), Pose::from_yaw([x, 0.0, 0.0], yaw));
        }
        track.sort();
        track
    }

    #[test]
    fn a_pose_between_two_is_on_the_line_and_on_the_shortest_turn() {
        let track = track(&[(400_000, 2.0, 3.0), (0, 0.0, -3.0)]);
        let pose = track.at(Stamp(100_000), REACH).unwrap();
        assert!((pose.translation()[0] - 0.5).abs() < 1e-12);
        // From −3 rad the short path to 3 rad is over −π: 0.283 rad in all.
        let turned = Pose::from_yaw([0.0; 3], -3.0 - (2.0 * core::f64::consts::PI - 6.0) / 4.0);
        let expected = turned.transform([1.0, 0.0, 0.0]);
        let got = pose.transform([1.0, 0.0, 0.0]);
        assert!((got[0] - 0.5 - expected[0]).abs() < 1e-9 && (got[1] - expected[1]).abs() < 1e-9);
    }

    #[test]
    fn no_pose_is_made_up_across_a_gap_or_beyond_the_ends() {
        let track = track(&[(0, 0.0, 0.0), (600_000, 6.0, 0.0)]);
        assert!(track.at(Stamp(300_000), REACH).is_err());
        assert!(track.at(Stamp(-10_001), REACH).is_err());
        assert_eq!(track.at(Stamp(-10_000), REACH).unwrap().translation()[0], 0.0);
        assert_eq!(track.at(Stamp(595_000), REACH).unwrap().translation()[0], 6.0);
        assert_eq!(track.at(Stamp(600_000), REACH).unwrap().translation()[0], 6.0);
        assert!(Track::default().at(Stamp(0), REACH).is_err());
    }

    proptest! {
        #[test]
        fn a_log_in_any_order_gives_the_same_track_as_poses_that_come_one_by_one(
            stamps in prop::collection::vec(0..20i64, 0..40),
        ) {
            let (mut log, mut live) = (Track::default(), Track::default());
            for (x, stamp) in stamps.into_iter().enumerate() {
                let pose = Pose::from_translation([x as f64, 0.0, 0.0]);
                log.collect(Stamp(stamp), pose);
                live.push(Stamp(stamp), pose);
            }
            log.sort();
            prop_assert_eq!(log.poses, live.poses);
        }
    }
}
