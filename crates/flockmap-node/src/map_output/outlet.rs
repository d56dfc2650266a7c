//! The driver's side: when a view is given out.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc as std_mpsc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use flockmap::{KnownPose, Pose, Resolution, Robot, RobotId, Scan, Stamp};
use flockmap_feed::{Link, NodeCounts, RobotPose, SeenScan};
use flockmap_view::Series;
use flockmap_view::serve::{Connection, Given, Identity, Numbered, Tally};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::{mpsc, watch};

use super::MapOutput;
use super::said::{links_of, poses_of};
use super::server::{Listeners, Server};
use super::submaps::Submaps;
use crate::command::Command;
use crate::{Log, NodeCounters};

/// Counters, and how old poses are, are said so often.
const COUNTS_PERIOD: Duration = Duration::from_secs(1);

/// Headers of each datagram, with IPv4.
const IP_UDP_BYTES: u64 = 28;

/// Scans are given out so often at most.
const SCAN_PERIOD: Duration = Duration::from_millis(100);

/// In-process readers that wait to be taken.
const READERS_WAITING_MAX: usize = 64;

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
    /// The map, the scan and the submaps that were given out last, as long as there are readers.
    given: Option<[u64; 3]>,
    due: Instant,
    counts_due: Instant,
    known: Vec<KnownPose>,
    poses: Numbered<Vec<RobotPose>>,
    counts: Numbered<NodeCounts>,
    links: Numbered<Vec<Link>>,
    scan: Numbered<Option<SeenScan>>,
    scan_due: Instant,
    submaps: Submaps,
    readers: MapReaders,
    beside: Vec<(&'static str, Arc<AtomicU64>)>,
    series: Arc<Series>,
    series_due: Instant,
}

/// Readers in the same process connect to the map of a node here.
#[derive(Clone, Debug)]
pub struct MapReaders(mpsc::Sender<Box<dyn Connection>>);

impl MapReaders {
    /// Serves a reader as one that comes over a socket, with the same limits: `stream` is the node's end of it.
    /// It is closed if the node has ended, or 64 others wait.
    pub fn take(&self, stream: impl AsyncRead + AsyncWrite + Send + Unpin + 'static) {
        // What is not taken is dropped, and so closed.
        let _ = self.0.try_send(Box::new(stream));
    }
}

impl Outlet {
    /// Opens the sockets and serves them on a thread of its own.
    ///
    /// # Errors
    /// The place that cannot be listened at, and why.
    pub(crate) fn start(
        output: MapOutput,
        (name, robot, resolution): (String, RobotId, Resolution),
        beside: Vec<(&'static str, Arc<AtomicU64>)>,
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
        let (readers, readers_in) = mpsc::channel(READERS_WAITING_MAX);
        let (started, start) = std_mpsc::channel();
        let (period, in_thread) = (output.period, Arc::clone(&tally));
        let work = move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
            let runtime = match runtime {
                Ok(runtime) => runtime,
                Err(error) => return drop(started.send(Err(here(error)))),
            };
            runtime.block_on(async move {
                match Listeners::open(&output, readers_in).await {
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
            links: Numbered::default(),
            scan: Numbered::default(),
            scan_due: now,
            submaps: Submaps::new(now),
            readers: MapReaders(readers),
            series: Arc::new(Series::new(series_names(&beside))),
            beside,
            series_due: now,
        })
    }

    /// Where readers connect.
    pub(crate) fn addresses(&self) -> &[String] {
        &self.addresses
    }

    /// Where readers of this process connect.
    pub(crate) fn map_readers(&self) -> MapReaders {
        self.readers.clone()
    }

    /// What goes over the radio in each second.
    pub(crate) fn series(&self) -> Arc<Series> {
        Arc::clone(&self.series)
    }

    /// Readers that there are now.
    pub(crate) fn readers(&self) -> usize {
        self.tally.readers()
    }

    /// The counters of the node with what is counted here.
    pub(crate) fn counters(&self, node: NodeCounters) -> NodeCounters {
        let [map_readers_refused, map_readers_closed, map_bytes_out] = self.tally.totals();
        NodeCounters { map_readers_refused, map_readers_closed, map_bytes_out, ..node }
    }

    /// A scan was mapped. It is thinned where somebody wants scans, and it is time; else this costs nothing.
    pub(crate) fn note_scan(&mut self, scan: &Scan, t_map_sensor: &Pose) {
        let now = Instant::now();
        if !self.tally.wants_scans() || now < self.scan_due {
            return;
        }
        self.scan_due = now + SCAN_PERIOD;
        let every = scan.points.len().div_ceil(SeenScan::POINTS_MAX).max(1);
        let finite = |point: &[f32; 3]| point.iter().all(|at| at.is_finite());
        self.scan.replace(Some(SeenScan {
            stamp: scan.stamp,
            position: t_map_sensor.translation(),
            orientation: t_map_sensor.quaternion_xyzw(),
            points_all: u32::try_from(scan.points.len()).unwrap_or(u32::MAX),
            points: scan.points.iter().step_by(every).copied().filter(finite).collect(),
        }));
    }

    /// Notes what went over the radio, once a second.
    pub(crate) fn note_traffic(&mut self, now: Stamp, node: &NodeCounters) {
        let instant = Instant::now();
        if instant >= self.series_due {
            self.series_due = instant + COUNTS_PERIOD;
            let wire = |bytes: u64, datagrams: u64| bytes + IP_UDP_BYTES * datagrams;
            let own = [wire(node.bytes_out, node.datagrams_out), wire(node.bytes_in, node.datagrams_in)];
            let beside = self.beside.iter().map(|(_, count)| count.load(Ordering::Relaxed));
            self.series.push(now, &own.into_iter().chain(beside).collect::<Vec<_>>());
        }
    }

    /// Gives the map out if there are readers and it is time, or `at_once`. O(1), O(robots) when it gives, and
    /// O(submaps) where somebody wants these.
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
                self.scan.replace(None);
            }
            return;
        }
        let instant = Instant::now();
        let is_count_due = instant >= self.counts_due;
        let may_give = at_once || is_count_due || instant >= self.due;
        if self.tally.wants_submaps() {
            self.submaps.look(robot, may_give, at_once);
        } else {
            self.submaps.rest();
        }
        let is_due = at_once || is_count_due || (may_give && self.is_news());
        if !is_due || self.submaps.unseen_until().is_some() {
            return;
        }
        let known = robot.poses();
        if known != self.known || is_count_due {
            self.poses.replace(poses_of(robot, now));
            self.known = known;
        }
        if is_count_due || at_once {
            let beside =
                self.beside.iter().map(|(name, count)| ((*name).into(), count.load(Ordering::Relaxed)));
            let counters = counters().into_iter().chain(beside).collect();
            self.counts.replace(NodeCounts { now, counters });
            if self.tally.wants_links() {
                self.links.replace(links_of(robot, now));
            }
            self.counts_due = instant + COUNTS_PERIOD;
        }
        let (poses, counts) = (self.poses.clone(), self.counts.clone());
        let (links, scan) = (self.links.clone(), self.scan.clone());
        let (map, stamp, submaps) = (robot.view(), self.stamp, self.submaps.said());
        let playback = Numbered::default();
        let given = Given { map, stamp, poses, counts, links, scan, submaps, playback };
        give.send_replace(Some(Arc::new(given)));
        self.given = Some(self.newest());
        self.due = instant + self.period;
    }

    /// When to offer again.
    pub(crate) fn poll_timeout(&self) -> Option<Instant> {
        let is_wanted = self.give.is_some() && self.readers() > 0;
        let unseen = self.submaps.unseen_until();
        let may_be_news = unseen.is_some() || self.is_news();
        let due = if may_be_news { self.due.min(self.counts_due) } else { self.counts_due };
        let offer = is_wanted.then(|| unseen.map_or(due, |until| due.max(until)));
        Some(offer.unwrap_or(self.series_due).min(self.series_due))
    }

    /// Whether there is something else than what was given out last.
    fn is_news(&self) -> bool {
        self.given != Some(self.newest())
    }

    fn newest(&self) -> [u64; 3] {
        [self.version, self.scan.number(), self.submaps.number()]
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

/// Counters beside the node's own whose names end so have a line of their own over time.
fn series_names(beside: &[(&'static str, Arc<AtomicU64>)]) -> Vec<String> {
    let beside = beside.iter().map(|(name, _)| name.trim_end_matches("_bytes_out"));
    ["sent", "received"].into_iter().chain(beside).map(str::to_owned).collect()
}
