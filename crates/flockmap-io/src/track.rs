//! Where something was over time, and chains of such tracks.

use std::collections::{BTreeMap, BTreeSet};

use flockmap_grid::{Pose, Stamp};
use glam::{DQuat, DVec3};

/// Poses of one frame in another over time. 64 bytes a pose.
#[derive(Clone, Debug, Default)]
pub(crate) struct Track {
    poses: Vec<(Stamp, Pose)>,
    sorted: bool,
}

/// How far a pose may be taken from its own time.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Reach {
    /// Longest time between two poses to interpolate between, in microseconds.
    pub(crate) gap_max: i64,
    /// Longest time to a single pose to take it as it is, in microseconds.
    pub(crate) near: i64,
}

impl Track {
    pub(crate) fn push(&mut self, stamp: Stamp, pose: Pose) {
        self.poses.push((stamp, pose));
        self.sorted = false;
    }

    /// Puts the poses in order; of several with one stamp the last counts. Needed before [`Self::at`].
    pub(crate) fn sort(&mut self) {
        // Turned round, the one that came last stands first among its equals, and the first is kept.
        self.poses.reverse();
        self.poses.sort_by_key(|(stamp, _)| *stamp);
        self.poses.dedup_by_key(|(stamp, _)| *stamp);
        self.sorted = true;
    }

    /// The pose at a time: as recorded, or between the two around it (straight line, shortest turn).
    pub(crate) fn at(&self, stamp: Stamp, reach: Reach) -> Option<Pose> {
        debug_assert!(self.sorted || self.poses.is_empty());
        let after = self.poses.partition_point(|(s, _)| *s < stamp);
        let next = self.poses.get(after);
        let previous = after.checked_sub(1).and_then(|i| self.poses.get(i));
        let near = |entry: Option<&(Stamp, Pose)>| {
            entry.map(|(s, pose)| (s.micros_since(stamp).saturating_abs(), *pose))
        };
        match (previous, next) {
            (_, Some((s, pose))) if *s == stamp => Some(*pose),
            (Some((a, pose_a)), Some((b, pose_b))) if b.micros_since(*a) <= reach.gap_max => {
                let share = stamp.micros_since(*a) as f64 / b.micros_since(*a) as f64;
                between(pose_a, pose_b, share)
            }
            _ => near(previous)
                .into_iter()
                .chain(near(next))
                .min_by_key(|(away, _)| *away)
                .filter(|(away, _)| *away <= reach.near)
                .map(|(_, pose)| pose),
        }
    }
}

fn between(a: &Pose, b: &Pose, share: f64) -> Option<Pose> {
    let place = DVec3::from_array(a.translation()).lerp(DVec3::from_array(b.translation()), share);
    let from = DQuat::from_array(a.quaternion_xyzw());
    let to = DQuat::from_array(b.quaternion_xyzw());
    Pose::new(place.to_array(), from.slerp(to, share).to_array())
}

/// The frames of a record and how they hang together: each child frame has one parent.
#[derive(Clone, Debug, Default)]
pub(crate) struct FrameTree {
    edges: BTreeMap<String, Edge>,
    poses: usize,
}

#[derive(Clone, Debug, Default)]
struct Edge {
    parent: String,
    moving: Track,
    fixed: Option<Pose>,
}

/// Most child frames kept of a record; more are left out.
const FRAMES_MAX: usize = 10_000;

impl FrameTree {
    /// Takes over a transform `T_parent_child`. A frame that changes its parent keeps only the new one.
    pub(crate) fn push(&mut self, parent: String, child: String, stamp: Stamp, pose: Pose, fixed: bool) {
        if self.edges.len() >= FRAMES_MAX && !self.edges.contains_key(&child) {
            return;
        }
        let edge = self.edges.entry(child).or_default();
        if edge.parent != parent {
            *edge = Edge { parent, ..Edge::default() };
        }
        if fixed {
            edge.fixed = Some(pose);
        } else {
            edge.moving.push(stamp, pose);
            self.poses += 1;
        }
    }

    /// Number of poses taken over.
    pub(crate) const fn poses(&self) -> usize {
        self.poses
    }

    pub(crate) fn sort(&mut self) {
        for edge in self.edges.values_mut() {
            edge.moving.sort();
        }
    }

    /// The frames from `frame` upwards, without `frame` itself.
    pub(crate) fn ancestors<'a>(&'a self, frame: &'a str) -> Vec<&'a str> {
        let mut seen = BTreeSet::from([frame]);
        let mut chain = Vec::new();
        let mut at = frame;
        while let Some(edge) = self.edges.get(at) {
            at = &edge.parent;
            if !seen.insert(at) {
                break;
            }
            chain.push(at);
        }
        chain
    }

    /// `T_ancestor_frame` at a time; `None` if a link of the chain has no pose in reach.
    pub(crate) fn pose(&self, ancestor: &str, frame: &str, stamp: Stamp, reach: Reach) -> Option<Pose> {
        let mut pose = Pose::IDENTITY;
        let mut at = frame;
        for _ in 0..=self.edges.len() {
            if at == ancestor {
                return Some(pose);
            }
            let edge = self.edges.get(at)?;
            let step = edge.fixed.or_else(|| edge.moving.at(stamp, reach))?;
            pose = step.compose(&pose);
            at = &edge.parent;
        }
        None
    }

    /// The links, as `parent → child`, for messages.
    pub(crate) fn links(&self) -> Vec<String> {
        self.edges.iter().map(|(child, edge)| format!("{} → {child}", edge.parent)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const REACH: Reach = Reach { gap_max: 500_000, near: 10_000 };

    fn track(poses: &[(i64, f64, f64)]) -> Track {
        let mut track = Track::default();
        for &(stamp, x, yaw) in poses {
            track.push(Stamp(stamp), Pose::from_yaw([x, 0.0, 0.0], yaw));
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
        assert!(track.at(Stamp(300_000), REACH).is_none());
        assert!(track.at(Stamp(-10_001), REACH).is_none());
        assert_eq!(track.at(Stamp(-10_000), REACH).unwrap().translation()[0], 0.0);
        assert_eq!(track.at(Stamp(595_000), REACH).unwrap().translation()[0], 6.0);
        assert_eq!(track.at(Stamp(600_000), REACH).unwrap().translation()[0], 6.0);
        assert!(Track::default().at(Stamp(0), REACH).is_none());
    }

    #[test]
    fn chains_go_through_fixed_and_moving_links() {
        let mut tree = FrameTree::default();
        let at = |x: f64| Pose::from_translation([x, 0.0, 0.0]);
        tree.push("map".into(), "base".into(), Stamp(0), Pose::from_yaw([5.0, 0.0, 0.0], 1.0), false);
        tree.push("base".into(), "lidar".into(), Stamp(0), at(1.0), true);
        tree.sort();
        assert_eq!(tree.ancestors("lidar"), ["base", "map"]);
        let pose = tree.pose("map", "lidar", Stamp(5), REACH).unwrap();
        assert!((pose.translation()[0] - 5.0 - 1f64.cos()).abs() < 1e-12);
        assert!(tree.pose("map", "lidar", Stamp(1_000_000), REACH).is_none());
        assert!(tree.pose("elsewhere", "lidar", Stamp(5), REACH).is_none());
    }

    #[test]
    fn frames_in_a_circle_end_the_chain() {
        let mut tree = FrameTree::default();
        tree.push("a".into(), "b".into(), Stamp(0), Pose::IDENTITY, true);
        tree.push("b".into(), "a".into(), Stamp(0), Pose::IDENTITY, true);
        tree.sort();
        assert_eq!(tree.ancestors("a"), ["b"]);
        assert!(tree.pose("map", "a", Stamp(0), REACH).is_none());
    }
}
