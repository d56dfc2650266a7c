//! The driver's side: when a view is given out.

use std::io;
use std::sync::Arc;
use std::sync::mpsc as std_mpsc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use flockmap::{KnownPose, Resolution, Robot, RobotId, Stamp};
use flockmap_feed::{NodeCounts, RobotPose};
use tokio::sync::{mpsc, watch};

use super::MapOutput;
use super::given::{Given, Identity, Numbered, Tally, read};
use super::server::{Listeners, Server};
use crate::command::Command;
use crate::{Log, NodeCounters};

/// Counters, and how old poses are, are said so often.
const COUNTS_PERIOD: Duration = Duration::from_secs(1);

/// Gives views to the thread that serves the readers.
pub(crate) struct Outlet {
    tally: Arc<Tally>,
    /// `None` at the end.
    give: Option<watch::Sender<Option<Arc<Given>>>>,
    thread: Option<JoinHandle<()>>,
    addresses: Vec<String>,
    period: Duration,
    /// The version of the map, and when it came to it.
    version: u64,
    stamp: Stamp,
    /// What was given out last, as long as there are readers.
    given: Option<u64>,
    due: Instant,
    counts_due: Instant,
    known: Vec<KnownPose>,
    poses: Numbered<Vec<RobotPose>>,
    counts: Numbered<NodeCounts>,
}

impl Outlet {
    /// Opens the sockets and serves them on a thread of its own.
    ///
    /// # Errors
    /// The place that cannot be listened at, and why.
    pub(crate) fn start(
        output: MapOutput,
        (name, robot, resolution): (String, RobotId, Resolution),
        commands: mpsc::WeakUnboundedSender<Command>,
        log: Log,
    ) -> Result<Self, (String, io::Error)> {
        let here = |error| ("its sockets".to_owned(), error);
        let mut feed = [0; 8];
        getrandom::fill(&mut feed).map_err(|error| here(io::Error::other(error)))?;
        // 0 means nothing.
        let feed = u64::from_le_bytes(feed).max(1);
        let identity = Identity { robot, resolution, feed, name: name.clone(), frame: output.frame.clone() };
        let tally = Arc::<Tally>::default();
        let (give, given) = watch::channel(None);
        let (started, start) = std_mpsc::channel();
        let (period, in_thread) = (output.period, Arc::clone(&tally));
        let work = move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
            let runtime = match runtime {
                Ok(runtime) => runtime,
                Err(error) => return drop(started.send(Err(here(error)))),
            };
            runtime.block_on(async move {
                match Listeners::open(&output).await {
                    Err(error) => drop(started.send(Err(error))),
                    Ok(listeners) => {
                        // The caller waits for this.
                        let _ = started.send(Ok(listeners.addresses()));
                        let readers_max = output.readers_max;
                        Server::new(identity, readers_max, given, in_thread, commands, log)
                            .serve(listeners)
                            .await;
                    }
                }
            });
        };
        let thread = std::thread::Builder::new().name(format!("map of {name}")).spawn(work).map_err(here)?;
        let died = || here(io::Error::other("their thread panicked"));
        let addresses = start.recv().map_err(|_| died())??;
        let now = Instant::now();
        Ok(Self {
            tally,
            give: Some(give),
            thread: Some(thread),
            addresses,
            period,
            version: 0,
            stamp: Stamp(0),
            given: None,
            due: now,
            counts_due: now,
            known: Vec::new(),
            poses: Numbered::default(),
            counts: Numbered::default(),
        })
    }

    /// Where readers connect.
    pub(crate) fn addresses(&self) -> &[String] {
        &self.addresses
    }

    /// Readers that there are now.
    pub(crate) fn readers(&self) -> usize {
        self.tally.readers()
    }

    /// The counters of the node with what is counted here.
    pub(crate) fn counters(&self, node: NodeCounters) -> NodeCounters {
        NodeCounters {
            map_readers_refused: read(&self.tally.refused),
            map_readers_closed: read(&self.tally.closed),
            map_bytes_out: read(&self.tally.bytes_out),
            ..node
        }
    }

    /// Gives the map out if there are readers and it is time, or `at_once`. O(1), and O(robots) when it gives.
    pub(crate) fn offer(
        &mut self,
        robot: &Robot,
        now: Stamp,
        at_once: bool,
        counters: impl FnOnce() -> Vec<(String, u64)>,
    ) {
        let Some(give) = &self.give else { return };
        let version = robot.map().version();
        if version != self.version {
            (self.version, self.stamp) = (version, now);
        }
        if self.readers() == 0 {
            // A view that nobody wants would still make every change of the map a copy.
            if self.given.take().is_some() {
                give.send_replace(None);
            }
            return;
        }
        let instant = Instant::now();
        let is_news = self.given != Some(version);
        let is_count_due = instant >= self.counts_due;
        let is_due = at_once || is_count_due || (is_news && instant >= self.due);
        if !is_due {
            return;
        }
        let known = robot.poses();
        if known != self.known || is_count_due {
            let age = |seen: Stamp| Duration::from_micros(now.micros_since(seen).max(0).unsigned_abs());
            let pose = |pose: &KnownPose| RobotPose {
                stream: pose.stream,
                position: pose.position,
                orientation: pose.orientation,
                age: age(pose.seen),
            };
            self.poses.replace(known.iter().map(pose).collect());
            self.known = known;
        }
        if is_count_due || at_once {
            self.counts.replace(NodeCounts { now, counters: counters() });
            self.counts_due = instant + COUNTS_PERIOD;
        }
        let (poses, counts) = (self.poses.clone(), self.counts.clone());
        give.send_replace(Some(Arc::new(Given { map: robot.view(), stamp: self.stamp, poses, counts })));
        self.given = Some(version);
        self.due = instant + self.period;
    }

    /// When to offer again.
    pub(crate) fn poll_timeout(&self) -> Option<Instant> {
        let is_wanted = self.give.is_some() && self.readers() > 0;
        let due = if self.given == Some(self.version) { self.counts_due } else { self.due };
        is_wanted.then(|| due.min(self.counts_due))
    }

    /// Says the end to the readers, once they have all that was given out, and waits for a moment until that is
    /// done; the sockets are gone then.
    pub(crate) fn end(&mut self) {
        self.give = None;
        if let Some(thread) = self.thread.take() {
            // It ends by itself, and if it panicked there is nothing to mend.
            let _ = thread.join();
        }
    }
}

impl Drop for Outlet {
    fn drop(&mut self) {
        self.end();
    }
}
