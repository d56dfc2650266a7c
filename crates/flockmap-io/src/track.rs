//! Where something was over time, and chains of such tracks.

use std::collections::{BTreeMap, BTreeSet};

use flockmap_grid::{Pose, Stamp};
use glam::{DQuat, DVec3};

use crate::ros::{is_within, namespace};

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

/// The frames of a record and how they hang together, for each namespace of tf by itself: robots that publish
/// `/robot1/tf` and `/robot2/tf` may have the same names of frames.
#[derive(Clone, Debug, Default)]
pub(crate) struct FrameForest {
    /// Each child frame has one parent.
    trees: BTreeMap<String, BTreeMap<String, Edge>>,
    frames: usize,
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

impl FrameForest {
    /// Takes over a transform `T_parent_child`. A frame that changes its parent keeps only the new one.
    pub(crate) fn push(
        &mut self,
        namespace: &str,
        parent: String,
        child: String,
        (stamp, pose): (Stamp, Pose),
        fixed: bool,
    ) {
        let is_known = self.trees.get(namespace).is_some_and(|edges| edges.contains_key(&child));
        if !is_known && self.frames >= FRAMES_MAX {
            return;
        }
        self.frames += usize::from(!is_known);
        let edge = self.trees.entry(namespace.to_owned()).or_default().entry(child).or_default();
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
        for edge in self.trees.values_mut().flat_map(BTreeMap::values_mut) {
            edge.moving.sort();
        }
    }

    /// The frames as whoever publishes this topic knows them: by the tf of its own namespace and of those
    /// around it, the nearest first. If only one namespace has tf, beside the one of all, that is meant.
    pub(crate) fn seen_from(&self, topic: &str) -> FrameTree<'_> {
        let within = |name: &&String| is_within(namespace(topic), name);
        let mut names: Vec<&String> = self.trees.keys().filter(within).collect();
        let mut named = self.trees.keys().filter(|name| !name.is_empty());
        if let (Some(only), None) = (named.next(), named.next())
            && !names.contains(&only)
        {
            names.push(only);
        }
        // Of names that begin alike the longest is the nearest.
        names.sort_by_key(|name| core::cmp::Reverse(name.len()));
        FrameTree { edges: names.into_iter().filter_map(|name| self.trees.get(name)).collect() }
    }

    /// The links, as `parent → child`, for messages.
    pub(crate) fn links(&self) -> Vec<String> {
        let edges = self.trees.iter().flat_map(|(name, edges)| edges.iter().map(move |edge| (name, edge)));
        edges.map(|(name, (child, edge))| format!("{} → {child} ({name}/tf)", edge.parent)).collect()
    }
}

/// Frames and how they hang together, from one or several namespaces.
#[derive(Clone, Debug)]
pub(crate) struct FrameTree<'a> {
    /// What is said of a child frame by the first counts.
    edges: Vec<&'a BTreeMap<String, Edge>>,
}

impl<'a> FrameTree<'a> {
    fn edge(&self, child: &str) -> Option<&'a Edge> {
        self.edges.iter().find_map(|edges| edges.get(child))
    }

    /// The frames from `frame` upwards, without `frame` itself.
    pub(crate) fn ancestors(&self, frame: &'a str) -> Vec<&'a str> {
        let mut seen = BTreeSet::from([frame]);
        let mut chain = Vec::new();
        let mut at = frame;
        while let Some(edge) = self.edge(at) {
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
        for _ in 0..=FRAMES_MAX {
            if at == ancestor {
                return Some(pose);
            }
            let edge = self.edge(at)?;
            let step = edge.fixed.or_else(|| edge.moving.at(stamp, reach))?;
            pose = step.compose(&pose);
            at = &edge.parent;
        }
        None
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
        let mut forest = FrameForest::default();
        let at = |x: f64| Pose::from_translation([x, 0.0, 0.0]);
        let moved = (Stamp(0), Pose::from_yaw([5.0, 0.0, 0.0], 1.0));
        forest.push("", "map".into(), "base".into(), moved, false);
        forest.push("", "base".into(), "lidar".into(), (Stamp(0), at(1.0)), true);
        forest.sort();
        let tree = forest.seen_from("/points");
        assert_eq!(tree.ancestors("lidar"), ["base", "map"]);
        let pose = tree.pose("map", "lidar", Stamp(5), REACH).unwrap();
        assert!((pose.translation()[0] - 5.0 - 1f64.cos()).abs() < 1e-12);
        assert!(tree.pose("map", "lidar", Stamp(1_000_000), REACH).is_none());
        assert!(tree.pose("elsewhere", "lidar", Stamp(5), REACH).is_none());
    }

    #[test]
    fn frames_in_a_circle_end_the_chain() {
        let mut forest = FrameForest::default();
        forest.push("", "a".into(), "b".into(), (Stamp(0), Pose::IDENTITY), true);
        forest.push("", "b".into(), "a".into(), (Stamp(0), Pose::IDENTITY), true);
        forest.sort();
        let tree = forest.seen_from("/points");
        assert_eq!(tree.ancestors("a"), ["b"]);
        assert!(tree.pose("map", "a", Stamp(0), REACH).is_none());
    }

    #[test]
    fn each_namespace_has_frames_of_its_own() {
        let mut forest = FrameForest::default();
        let at = |x: f64| (Stamp(0), Pose::from_translation([x, 0.0, 0.0]));
        forest.push("/a", "odom".into(), "lidar".into(), at(1.0), true);
        let x = |forest: &FrameForest, topic: &str, root: &str| {
            forest.seen_from(topic).pose(root, "lidar", Stamp(0), REACH).map(|pose| pose.translation()[0])
        };
        assert_eq!(x(&forest, "/elsewhere/points", "odom"), Some(1.0), "nobody else can be meant");
        forest.push("/ab", "odom".into(), "lidar".into(), at(2.0), true);
        forest.push("", "map".into(), "odom".into(), at(10.0), true);
        forest.sort();
        assert_eq!(x(&forest, "/a/points", "odom"), Some(1.0));
        assert_eq!(x(&forest, "/ab/front/points", "odom"), Some(2.0));
        assert_eq!(x(&forest, "/ab/points", "map"), Some(12.0), "the tf of all lies around that of each");
        assert_eq!(x(&forest, "/points", "map"), None, "it is not known whose it would be");
    }
}
