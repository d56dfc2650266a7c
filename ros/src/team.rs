//! What topics say of team-mates, on its way to the robot: the newest of each waits, and nobody waits for the robot.

use std::collections::BTreeMap;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use flockmap::{Pose, RobotId};
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
        let State { positions, mut alignments } = wanted.take();
        alignments.retain(|robot, pose| set.insert(*robot, *pose) != Some(*pose));
        let call = move |robot: &mut flockmap::Robot, now| {
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
            faults
        };
        let Some(faults) = node.with_robot(call) else { return };
        faults.iter().for_each(|fault| log.warn(fault));
    }
}
