//! Frames and how they hang together over time: what tf says.

use std::collections::{BTreeMap, BTreeSet};

use flockmap_grid::{Pose, Stamp};

use super::topic::{is_within, namespace};
use super::track::{NoPoseThen, Reach, Track};

/// Most child frames that a [`FrameForest`] keeps; more are left out.
pub const FRAMES_MAX: usize = 10_000;

/// The frames of robots and how they hang together, for each namespace of tf by itself: robots that publish
/// `/robot1/tf` and `/robot2/tf` may have the same names of frames.
///
/// Poses may be looked up while others come. Memory: 64 bytes a pose, of each frame at most those that
/// [`Self::new`] allows; about 200 bytes and its names for each of at most [`FRAMES_MAX`] frames.
///
/// ```
/// use flockmap_grid::{Pose, Stamp};
/// use flockmap_io::ros::{FrameForest, Reach};
///
/// let mut forest = FrameForest::new(100, 1_000);
/// // Transforms of /tf_static and /tf, which are in the namespace of all.
/// forest.push_fixed("", "base".into(), "lidar".into(), Pose::from_translation([0.0, 0.0, 0.5]));
/// forest.push("", "map".into(), "base".into(), Stamp(0), Pose::IDENTITY);
/// let reach = Reach { gap_max: 500_000, near: 0 };
/// let scan = Stamp(50_000);
/// let look_up = |forest: &FrameForest| forest.seen_from("/points").pose("map", "lidar", scan, reach);
/// assert!(look_up(&forest).unwrap_err().may_come());
/// forest.push("", "map".into(), "base".into(), Stamp(100_000), Pose::from_translation([1.0, 0.0, 0.0]));
/// assert_eq!(look_up(&forest).unwrap().translation(), [0.5, 0.0, 0.5]);
/// ```
#[derive(Clone, Debug, Default)]
pub struct FrameForest {
    /// Each child frame has one parent.
    trees: BTreeMap<String, BTreeMap<String, Edge>>,
    frames: usize,
    poses: usize,
    /// Most frames, and most poses of each.
    limits: Option<[usize; 2]>,
}

#[derive(Clone, Debug, Default)]
struct Edge {
    parent: String,
    moving: Track,
    fixed: Option<Pose>,
}

impl FrameForest {
    /// A forest of at most this many frames, and no more than [`FRAMES_MAX`], that keeps the newest poses of each, at
    /// most this many and at least one: 64 bytes × `frames_max` × `poses_max`. The default keeps all poses, as a log
    /// needs it.
    pub fn new(frames_max: usize, poses_max: usize) -> Self {
        Self { limits: Some([frames_max.min(FRAMES_MAX), poses_max.max(1)]), ..Self::default() }
    }

    /// Takes over `T_parent_child` at a time, in any order. A frame that changes its parent keeps only the new
    /// one. Returns whether there was room for the frame.
    pub fn push(&mut self, namespace: &str, parent: String, child: String, stamp: Stamp, pose: Pose) -> bool {
        let most = self.limits.map_or(usize::MAX, |[_, poses_max]| poses_max);
        self.with_edge(namespace, parent, child, |edge| {
            edge.moving.push(stamp, pose);
            edge.moving.keep_newest(most);
        })
    }

    /// Takes over `T_parent_child` for all times, as `/tf_static` gives it. It comes before poses with a time.
    /// Returns whether there was room for the frame.
    pub fn push_fixed(&mut self, namespace: &str, parent: String, child: String, pose: Pose) -> bool {
        self.with_edge(namespace, parent, child, |edge| edge.fixed = Some(pose))
    }

    /// Forgets the poses before a time, except the last of each frame: what is asked at that time or later
    /// gets the same answer as before.
    pub fn forget_before(&mut self, stamp: Stamp) {
        self.edges_mut().for_each(|edge| edge.moving.forget_before(stamp));
    }

    /// Forgets all poses with a time; those for all times stay. For a clock that went back.
    pub fn forget_moving(&mut self) {
        self.edges_mut().for_each(|edge| edge.moving = Track::default());
    }

    /// [`Self::push`] for a log, which may have millions of poses in any order: [`Self::sort`] puts them in order.
    pub(crate) fn collect(
        &mut self,
        namespace: &str,
        parent: String,
        child: String,
        (stamp, pose): (Stamp, Pose),
    ) {
        let is_taken = self.with_edge(namespace, parent, child, |edge| edge.moving.collect(stamp, pose));
        self.poses += usize::from(is_taken);
    }

    /// Number of poses that [`Self::collect`] took over.
    pub(crate) const fn collected(&self) -> usize {
        self.poses
    }

    pub(crate) fn sort(&mut self) {
        self.edges_mut().for_each(|edge| edge.moving.sort());
    }

    fn with_edge(
        &mut self,
        namespace: &str,
        parent: String,
        child: String,
        act: impl FnOnce(&mut Edge),
    ) -> bool {
        let is_known = self.trees.get(namespace).is_some_and(|edges| edges.contains_key(&child));
        if !is_known && self.frames >= self.limits.map_or(FRAMES_MAX, |[frames_max, _]| frames_max) {
            return false;
        }
        self.frames += usize::from(!is_known);
        let edge = self.trees.entry(namespace.to_owned()).or_default().entry(child).or_default();
        if edge.parent != parent {
            *edge = Edge { parent, ..Edge::default() };
        }
        act(edge);
        true
    }

    fn edges_mut(&mut self) -> impl Iterator<Item = &mut Edge> {
        self.trees.values_mut().flat_map(BTreeMap::values_mut)
    }

    /// The frames as whoever publishes this topic knows them: by the tf of its own namespace and of those
    /// around it, the nearest first. If only one namespace has tf, beside the one of all, that is meant.
    pub fn seen_from(&self, topic: &str) -> FrameTree<'_> {
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

    /// The links, as `parent → child (/namespace/tf)`, for people.
    pub fn links(&self) -> Vec<String> {
        let edges = self.trees.iter().flat_map(|(name, edges)| edges.iter().map(move |edge| (name, edge)));
        edges.map(|(name, (child, edge))| format!("{} → {child} ({name}/tf)", edge.parent)).collect()
    }
}

/// Frames and how they hang together, from one or several namespaces.
#[derive(Clone, Debug)]
pub struct FrameTree<'a> {
    /// What is said of a child frame by the first counts.
    edges: Vec<&'a BTreeMap<String, Edge>>,
}

/// Why there is no pose of one frame in another at a time.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
pub enum NoPose {
    /// No transform names this frame so far.
    #[error("the frame \"{0}\" is unknown")]
    UnknownFrame(String),
    /// Both are known, but transforms do not lead from the one up to the other.
    #[error("transforms do not lead from \"{frame}\" up to \"{ancestor}\"")]
    NotConnected {
        /// The frame in which the pose would be.
        ancestor: String,
        /// The frame whose pose was asked for.
        frame: String,
    },
    /// Transforms lead there, but one of them has no pose at the time.
    #[error("no pose of \"{child}\" in \"{parent}\" at {:.6} s: {reason}", stamp.seconds())]
    Link {
        /// Upper frame of the transform.
        parent: String,
        /// Lower frame of the transform.
        child: String,
        /// When it was asked for.
        stamp: Stamp,
        /// What it has instead.
        reason: NoPoseThen,
    },
}

impl NoPose {
    /// Whether waiting may help: a pose that has not come yet, or a frame of which nothing has come. It does not for
    /// a time that lies too far back, or in a gap.
    pub const fn may_come(&self) -> bool {
        !matches!(self, Self::Link { reason: NoPoseThen::TooOld { .. } | NoPoseThen::Gap { .. }, .. })
    }
}

impl<'a> FrameTree<'a> {
    fn edge(&self, child: &str) -> Option<&'a Edge> {
        self.edges.iter().find_map(|edges| edges.get(child))
    }

    /// The frames from `frame` upwards, without `frame` itself.
    pub fn ancestors(&self, frame: &'a str) -> Vec<&'a str> {
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

    /// `T_ancestor_frame` at a time.
    ///
    /// # Errors
    /// [`NoPose`] says why there is none. If several links have no pose, one for which waiting does not help is
    /// told.
    pub fn pose(&self, ancestor: &str, frame: &str, stamp: Stamp, reach: Reach) -> Result<Pose, NoPose> {
        let mut pose = Ok(Pose::IDENTITY);
        let mut at = frame;
        // A chain without a circle has no more links than there are.
        let links: usize = self.edges.iter().map(|edges| edges.len()).sum();
        for _ in 0..=links {
            if at == ancestor {
                return pose;
            }
            let Some(edge) = self.edge(at) else { break };
            let step = edge.fixed.map_or_else(|| edge.moving.at(stamp, reach), Ok);
            let step = step.map_err(|reason| NoPose::Link {
                parent: edge.parent.clone(),
                child: at.to_owned(),
                stamp,
                reason,
            });
            pose = match (pose, step) {
                (Ok(below), Ok(step)) => Ok(step.compose(&below)),
                (Err(first), Err(second)) if first.may_come() && !second.may_come() => Err(second),
                (Err(first), _) | (Ok(_), Err(first)) => Err(first),
            };
            at = &edge.parent;
        }
        let unknown = [frame, ancestor].into_iter().find(|name| !self.knows(name));
        Err(unknown.map_or_else(
            || NoPose::NotConnected { ancestor: ancestor.to_owned(), frame: frame.to_owned() },
            |name| NoPose::UnknownFrame(name.to_owned()),
        ))
    }

    fn knows(&self, frame: &str) -> bool {
        let is_parent = |edges: &&BTreeMap<String, Edge>| edges.values().any(|edge| edge.parent == frame);
        self.edge(frame).is_some() || self.edges.iter().any(is_parent)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const REACH: Reach = Reach { gap_max: 500_000, near: 10_000 };

    #[test]
    fn chains_go_through_fixed_and_moving_links() {
        let mut forest = FrameForest::default();
        let at = |x: f64| Pose::from_translation([x, 0.0, 0.0]);
        let moved = (Stamp(0), Pose::from_yaw([5.0, 0.0, 0.0], 1.0));
        forest.collect("", "map".into(), "base".into(), moved);
        forest.push_fixed("", "base".into(), "lidar".into(), at(1.0));
        forest.sort();
        let tree = forest.seen_from("/points");
        assert_eq!(tree.ancestors("lidar"), ["base", "map"]);
        let pose = tree.pose("map", "lidar", Stamp(5), REACH).unwrap();
        assert!((pose.translation()[0] - 5.0 - 1f64.cos()).abs() < 1e-12);
        assert!(tree.pose("map", "lidar", Stamp(1_000_000), REACH).is_err());
        assert!(tree.pose("elsewhere", "lidar", Stamp(5), REACH).is_err());
    }

    #[test]
    fn frames_in_a_circle_end_the_chain() {
        let mut forest = FrameForest::default();
        forest.push_fixed("", "a".into(), "b".into(), Pose::IDENTITY);
        forest.push_fixed("", "b".into(), "a".into(), Pose::IDENTITY);
        forest.sort();
        let tree = forest.seen_from("/points");
        assert_eq!(tree.ancestors("a"), ["b"]);
        assert!(tree.pose("map", "a", Stamp(0), REACH).is_err());
    }

    #[test]
    fn each_namespace_has_frames_of_its_own() {
        let mut forest = FrameForest::default();
        let at = |x: f64| Pose::from_translation([x, 0.0, 0.0]);
        forest.push_fixed("/a", "odom".into(), "lidar".into(), at(1.0));
        let x = |forest: &FrameForest, topic: &str, root: &str| {
            forest
                .seen_from(topic)
                .pose(root, "lidar", Stamp(0), REACH)
                .ok()
                .map(|pose| pose.translation()[0])
        };
        assert_eq!(x(&forest, "/elsewhere/points", "odom"), Some(1.0), "nobody else can be meant");
        forest.push_fixed("/ab", "odom".into(), "lidar".into(), at(2.0));
        forest.push_fixed("", "map".into(), "odom".into(), at(10.0));
        forest.sort();
        assert_eq!(x(&forest, "/a/points", "odom"), Some(1.0));
        assert_eq!(x(&forest, "/ab/front/points", "odom"), Some(2.0));
        assert_eq!(x(&forest, "/ab/points", "map"), Some(12.0), "the tf of all lies around that of each");
        assert_eq!(x(&forest, "/points", "map"), None, "it is not known whose it would be");
    }
}
