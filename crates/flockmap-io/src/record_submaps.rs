//! What a record says of submaps: when each begins, and how it lies from then on.

use std::collections::VecDeque;

use flockmap_grid::{Pose, Stamp, SubmapId};

use crate::error::{Fault, check_room};

/// From a time on, a submap lies so.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct SubmapPose {
    /// From when on: before a scan of the same stamp.
    pub stamp: Stamp,
    /// Which one. What is said of it first is that it begins.
    pub submap: SubmapId,
    /// `T_map_submap`, how it lies in the map, rounded as a robot rounds it.
    pub t_map_submap: Pose,
}

/// What a record says of its submaps, in the order of time: each begins after the one before it, the first is submap 0.
/// Only what changed is kept. 72 bytes each.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct SubmapPoses {
    poses: VecDeque<SubmapPose>,
}

impl SubmapPoses {
    /// Number of poses that are left.
    pub fn len(&self) -> usize {
        self.poses.len()
    }

    /// Whether nothing is left.
    pub fn is_empty(&self) -> bool {
        self.poses.is_empty()
    }

    /// What is left, in the order of time.
    pub fn iter(&self) -> impl Iterator<Item = &SubmapPose> {
        self.poses.iter()
    }

    /// When the next one is due.
    pub fn next_stamp(&self) -> Option<Stamp> {
        self.poses.front().map(|pose| pose.stamp)
    }

    /// Takes the next one, if it is due by now.
    pub fn take_due(&mut self, now: Stamp) -> Option<SubmapPose> {
        self.poses.pop_front_if(|pose| pose.stamp <= now)
    }

    /// The same for a run that begins in the middle: the submap that was open then is its submap 0. What is said of
    /// older ones is left out, since the run wrote nothing in them.
    #[must_use]
    pub fn begun_at(mut self, from: Stamp) -> Self {
        let before = self.poses.iter().take_while(|pose| pose.stamp <= from);
        let open = before.map(|pose| pose.submap.number()).max().unwrap_or_default();
        let of_run = self.poses.drain(..).filter_map(|pose| {
            let submap = pose.submap.number().checked_sub(open).and_then(SubmapId::new)?;
            Some(SubmapPose { stamp: pose.stamp.max(from), submap, ..pose })
        });
        Self { poses: of_run.collect() }
    }

    /// The same for a run that ends before the record does: submaps that begin later are left out, and what is said
    /// later of the others is said right behind its end.
    #[must_use]
    pub fn ended_at(mut self, last: Stamp) -> Self {
        let until = self.poses.iter().filter(|pose| pose.stamp <= last);
        let newest = until.map(|pose| pose.submap).max();
        self.poses.retain(|pose| Some(pose.submap) <= newest);
        self.at(|stamp| stamp.min(last.plus_micros(1)))
    }

    /// Leaves out what is said later than this.
    #[must_use]
    pub fn until(mut self, last: Stamp) -> Self {
        self.poses.retain(|pose| pose.stamp <= last);
        self
    }

    /// The same with other stamps. They must not come into another order.
    #[must_use]
    pub fn at(mut self, stamp: impl Fn(Stamp) -> Stamp) -> Self {
        self.poses.iter_mut().for_each(|pose| pose.stamp = stamp(pose.stamp));
        self
    }
}

/// Makes [`SubmapPoses`] of lists of the poses of all submaps, which mostly say again what was said before.
#[derive(Default)]
pub(crate) struct SubmapLists {
    said: SubmapPoses,
    /// The newest pose of each.
    newest: Vec<Pose>,
}

impl SubmapLists {
    /// Takes the poses of all submaps, at most [`SubmapId::COUNT`], as they are from a time on. A list may say less
    /// than the one before; one with an earlier stamp counts from that of the one before, as it came after it. There
    /// is room for `most` poses, with those of other things `beside` them.
    pub(crate) fn take(
        &mut self,
        stamp: Stamp,
        poses: &[Pose],
        [beside, most]: [usize; 2],
    ) -> Result<(), Fault> {
        let before = self.said.poses.back().map_or(stamp, |last| last.stamp);
        let stamp = stamp.max(before);
        for (submap, pose) in (0..).map_while(SubmapId::new).zip(poses) {
            let place = usize::from(submap.number());
            if self.newest.get(place) == Some(pose) {
                continue;
            }
            check_room("the number of poses", beside + self.said.len(), most)?;
            match self.newest.get_mut(place) {
                Some(newest) => *newest = *pose,
                None => self.newest.push(*pose),
            }
            self.said.poses.push_back(SubmapPose { stamp, submap, t_map_submap: *pose });
        }
        Ok(())
    }

    /// Number of poses that were taken.
    pub(crate) fn len(&self) -> usize {
        self.said.len()
    }

    pub(crate) fn into_poses(self) -> SubmapPoses {
        self.said
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x: f64) -> Pose {
        Pose::from_translation([x, 0.0, 0.0])
    }

    /// Stamp, number and x of each.
    fn shown(poses: &SubmapPoses) -> Vec<(i64, u16, f64)> {
        poses
            .iter()
            .map(|pose| (pose.stamp.0, pose.submap.number(), pose.t_map_submap.translation()[0]))
            .collect()
    }

    fn said() -> SubmapPoses {
        let mut lists = SubmapLists::default();
        for (stamp, poses) in [
            (10, &[at(0.0)][..]),
            (20, &[at(0.0), at(0.0)]),
            (30, &[at(1.0), at(2.0), at(2.0)]),
            (25, &[at(1.0), at(3.0)]),
            (40, &[]),
        ] {
            lists.take(Stamp(stamp), poses, [0, 100]).unwrap();
        }
        lists.into_poses()
    }

    #[test]
    fn only_what_changed_is_kept_and_time_never_goes_back() {
        let expected = [(10, 0, 0.0), (20, 1, 0.0), (30, 0, 1.0), (30, 1, 2.0), (30, 2, 2.0), (30, 1, 3.0)];
        assert_eq!(shown(&said()), expected);
    }

    #[test]
    fn a_part_of_a_record_has_submaps_of_its_own() {
        assert_eq!(said().begun_at(Stamp(0)), said());
        let later = said().begun_at(Stamp(22));
        assert_eq!(shown(&later), [(22, 0, 0.0), (30, 0, 2.0), (30, 1, 2.0), (30, 0, 3.0)]);
        let earlier = said().ended_at(Stamp(22));
        let expected = [(10, 0, 0.0), (20, 1, 0.0), (23, 0, 1.0), (23, 1, 2.0), (23, 1, 3.0)];
        assert_eq!(shown(&earlier), expected, "it hears of what was put right later");
        assert!(said().ended_at(Stamp(5)).is_empty());
        assert_eq!(shown(&said().until(Stamp(20))), [(10, 0, 0.0), (20, 1, 0.0)]);
        assert_eq!(said().begun_at(Stamp(100)).at(|stamp| Stamp(stamp.0 - 100)).next_stamp(), Some(Stamp(0)));
    }

    #[test]
    fn each_is_due_at_its_time() {
        let mut poses = said();
        assert_eq!(poses.take_due(Stamp(9)), None);
        assert_eq!(poses.take_due(Stamp(20)).unwrap().stamp, Stamp(10));
        assert_eq!(poses.take_due(Stamp(20)).unwrap().stamp, Stamp(20));
        assert_eq!((poses.take_due(Stamp(20)), poses.len()), (None, 4));
    }

    #[test]
    fn poses_have_a_limit() {
        let mut lists = SubmapLists::default();
        lists.take(Stamp(0), &[at(0.0), at(0.0)], [3, 5]).unwrap();
        lists.take(Stamp(1), &[at(0.0), at(0.0)], [3, 5]).unwrap();
        let error = lists.take(Stamp(2), &[at(0.0), at(1.0)], [3, 5]).unwrap_err();
        assert_eq!(error.to_string(), "the number of poses is 6, the limit is 5");
    }
}
