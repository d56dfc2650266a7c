//! Submaps that a robot begins and moves, and where they are to lie at the end.

use std::collections::BTreeMap;

use flockmap::{Pose, Robot, Stamp, SubmapId};
use flockmap_worlds::random::Random;

/// Most submaps of a run, and how often some are moved: in a world as small as these all of them lie over each other,
/// and a flight of many minutes would move hundreds.
const SUBMAPS_MAX: usize = 8;
const MOVES_MAX: u32 = 30;

/// What a robot has said of its submaps in this run.
pub(super) struct Moves {
    random: Random,
    /// How likely at a scan.
    begins: f64,
    moves: f64,
    moves_left: u32,
    /// Where each lies that was begun; the first one too.
    poses: BTreeMap<SubmapId, Pose>,
}

impl Moves {
    pub(super) fn new(mut random: Random) -> Self {
        let (begins, moves) = (random.range(0.02, 0.3), random.range(0.02, 0.4));
        Self {
            random,
            begins,
            moves,
            moves_left: MOVES_MAX,
            poses: BTreeMap::from([(SubmapId::FIRST, Pose::IDENTITY)]),
        }
    }

    /// Another run begins.
    pub(super) fn begin_run(&mut self) {
        self.poses = BTreeMap::from([(SubmapId::FIRST, Pose::IDENTITY)]);
        self.moves_left = MOVES_MAX;
    }

    /// Begins a submap, or moves some, or not.
    pub(super) fn act(&mut self, robot: &mut Robot, now: Stamp) {
        if self.random.happens(self.begins)
            && self.poses.len() < SUBMAPS_MAX
            && let Ok(submap) = robot.begin_submap(now)
        {
            let before = self.poses.last_key_value().map_or(Pose::IDENTITY, |(_, pose)| *pose);
            self.poses.insert(submap, before);
        }
        if self.random.happens(self.moves) && self.moves_left > 0 {
            self.moves_left -= 1;
            for _ in 0..1 + self.random.below(3) {
                let number = self.random.below(self.poses.len() as u64) as u16;
                let submap = SubmapId::new(number).unwrap_or_default();
                let pose = self.pose();
                if robot.set_submap_pose(now, submap, &pose).is_ok() {
                    self.poses.insert(submap, pose);
                }
            }
        }
    }

    /// Small ones, whole blocks, and what turns all over; each as it comes over the radio.
    fn pose(&mut self) -> Pose {
        let mut range = |most: f64| self.random.range(-most, most);
        let pose = match range(1.0) {
            kind if kind < -0.6 => Pose::IDENTITY,
            kind if kind < -0.3 => Pose::from_translation([range(3.0).round() * 4.0, 0.0, 0.0]),
            kind if kind < 0.6 => {
                // An odd number of tenths of a millimetre: by half a voxel up, centres would lie on the faces of voxels.
                let z = ((range(0.3) * 5_000.0).round() * 2.0 + 1.0) / 10_000.0;
                Pose::from_yaw([range(1.0), range(1.0), z], range(0.2))
            }
            _ => Pose::new([range(9.0), range(9.0), range(2.0)], [range(1.0), range(1.0), range(1.0), 1.0])
                .unwrap_or_default(),
        };
        pose.rounded().unwrap_or_default()
    }

    /// Where each of the submaps is to lie.
    pub(super) fn poses(&self) -> &BTreeMap<SubmapId, Pose> {
        &self.poses
    }
}
