//! What readers ask of the driver.

use std::sync::Arc;
use std::time::Instant as StdInstant;

use flockmap::grid::BlockIndex;
use flockmap::{Robot, Stamp};
use flockmap_feed::Block;
use flockmap_view::serve::{BlocksFuture, BlocksNow, Giver};
use tokio::sync::{Mutex, mpsc, oneshot};
use tokio::time::{Instant, sleep_until};

use crate::command::Command;

/// Blocks of which the driver is asked at once who saw them: 6 ms of its time if each of their voxels is
/// contested.
const ASKED_MAX: usize = 64;
/// It is asked again after so many times what that took: a tenth of its time for all readers together.
const ASK_REST: u32 = 9;

/// The driver, as readers see it.
pub(super) struct Driver {
    commands: mpsc::WeakUnboundedSender<Command>,
    /// Readers ask one after the other, and not before this.
    not_before: Arc<Mutex<Option<Instant>>>,
}

impl Driver {
    pub(super) fn new(commands: mpsc::WeakUnboundedSender<Command>) -> Self {
        Self { commands, not_before: Arc::default() }
    }
}

impl Giver for Driver {
    fn wake(&self) {
        // The driver may be asleep.
        if let Some(commands) = self.commands.upgrade() {
            let _ = commands.send(Command::Robot(Box::new(|_, _| {})));
        }
    }

    fn blocks_with_origins(&self, mut due: Vec<BlockIndex>) -> BlocksFuture {
        due.truncate(ASKED_MAX);
        let (commands, not_before) = (self.commands.clone(), Arc::clone(&self.not_before));
        Box::pin(async move {
            let mut not_before = not_before.lock().await;
            if let Some(time) = *not_before {
                sleep_until(time).await;
            }
            let (answer, result) = oneshot::channel();
            let ask = move |robot: &mut Robot, now: Stamp| {
                let began = StdInstant::now();
                let states = robot.map().states_of(&due);
                let block = |(index, states)| Block {
                    index,
                    states,
                    origins: robot.fusion().origins(robot.mapper(), index),
                };
                let blocks = due.into_iter().zip(states).map(block).collect();
                let blocks = BlocksNow { blocks, newest: robot.map().version(), now };
                // The reader may be gone.
                let _ = answer.send((blocks, began.elapsed()));
            };
            // What the driver will not answer any more, it ends.
            commands.upgrade()?.send(Command::Robot(Box::new(ask))).ok()?;
            let (blocks, took) = result.await.ok()?;
            *not_before = Some(Instant::now() + took * ASK_REST);
            Some(blocks)
        })
    }
}
