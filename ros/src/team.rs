//! What topics say of team-mates and of the own submaps, on its way to the robot: the newest of each waits, and nobody
//! waits for the robot.

use std::collections::BTreeMap;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use flockmap::{Pose, Robot, RobotId, Stamp, SubmapError, SubmapId};
use flockmap_node::{Log, NodeHandle};

/// Takes what is to be set.
pub(crate) struct Team {
    wanted: Wanted,
    wake: SyncSender<()>,
}

/// What is to be set. Clones share it.
#[derive(Clone, Default)]
pub(crate) struct Wanted(Arc<Mutex<State>>);

#[derive(Default)]
struct State {
    positions: BTreeMap<RobotId, [f64; 3]>,
    alignments: BTreeMap<RobotId, Pose>,
    submaps: Vec<Pose>,
}

impl Team {
    /// With what [`set_all`] needs.
    pub(crate) fn new() -> (Self, Wanted, Receiver<()>) {
        let (wake, woken) = sync_channel(1);
        let wanted = Wanted::default();
        (Self { wanted: wanted.clone(), wake }, wanted, woken)
    }

    /// Where a team-mate is, in the frame of the map.
    pub(crate) fn set_position(&self, robot: RobotId, position: [f64; 3]) {
        self.wanted.lock().positions.insert(robot, position);
        // Full: it will look anyway.
        let _ = self.wake.try_send(());
    }

    /// `T_own_origin` of a team-mate.
    pub(crate) fn set_alignment(&self, robot: RobotId, pose: Pose) {
        self.wanted.lock().alignments.insert(robot, pose);
        let _ = self.wake.try_send(());
    }

    /// `T_map_submap` of the submaps of the own run, from the first on.
    pub(crate) fn set_submaps(&self, poses: Vec<Pose>) {
        self.wanted.lock().submaps = poses;
        let _ = self.wake.try_send(());
    }
}

/// Begins submaps until there is one for each pose, and puts each where it is to lie. One that is said again costs
/// nothing.
fn put_submaps(robot: &mut Robot, poses: &[Pose], now: Stamp) -> Result<(), SubmapError> {
    for (number, pose) in (0..).zip(poses) {
        let submap = SubmapId::new(number).ok_or(SubmapError::Full)?;
        if robot.submap() < submap {
            robot.begin_submap(now)?;
        }
        robot.set_submap_pose(now, submap, pose)?;
    }
    Ok(())
}

impl Wanted {
    fn lock(&self) -> MutexGuard<'_, State> {
        // What a thread that panicked has left behind is whole.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn take(&self) -> State {
        std::mem::take(&mut self.lock())
    }
}

/// Sets what comes in, until nobody says anything any more or the node has ended. An alignment that is said again
/// costs nothing.
pub(crate) fn set_all(wanted: &Wanted, woken: &Receiver<()>, node: &NodeHandle, log: &Log) {
    let mut set = BTreeMap::<RobotId, Pose>::new();
    while woken.recv().is_ok() {
        let State { positions, mut alignments, submaps } = wanted.take();
        alignments.retain(|robot, pose| set.insert(*robot, *pose) != Some(*pose));
        let call = move |robot: &mut Robot, now| {
            let mut faults = Vec::new();
            for (id, position) in positions {
                let done = robot.set_teammate(id, position, now);
                faults
                    .extend(done.err().map(|error| format!("where robot {} is was left out: {error}", id.0)));
            }
            for (id, pose) in alignments {
                let done = robot.set_alignment(id, &pose);
                faults.extend(
                    done.err().map(|error| format!("the alignment of robot {} stays: {error}", id.0)),
                );
            }
            let put = put_submaps(robot, &submaps, now);
            faults.extend(put.err().map(|error| format!("submaps stay where they were: {error}")));
            faults
        };
        let Some(faults) = node.with_robot(call) else { return };
        faults.iter().for_each(|fault| log.warn(fault));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap::{Resolution, RobotConfig};

    #[test]
    fn as_many_submaps_begin_as_there_are_poses_and_each_lies_as_its_pose_says() {
        let resolution = Resolution::from_metres(0.1).unwrap();
        let mut robot = Robot::new(RobotConfig::new(RobotId(1), resolution, 7.0), Stamp(0)).unwrap();
        let at = |x: f64| Pose::from_translation([x, 0.0, 0.0]);
        put_submaps(&mut robot, &[at(0.0), at(0.5)], Stamp(1)).unwrap();
        put_submaps(&mut robot, &[at(0.25)], Stamp(2)).unwrap();
        put_submaps(&mut robot, &[at(0.25), at(0.5), at(0.75)], Stamp(3)).unwrap();
        assert_eq!(robot.submap().number(), 2);
        for (number, x) in [(0, 0.25), (1, 0.5), (2, 0.75)] {
            assert_eq!(robot.submap_pose(SubmapId::new(number).unwrap()), at(x));
        }
        let far = put_submaps(&mut robot, &[at(1e9)], Stamp(4)).unwrap_err().to_string();
        assert!(!far.is_empty() && robot.submap_pose(SubmapId::FIRST) == at(0.25), "{far}");
    }
}
