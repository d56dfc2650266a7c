//! The thread that records what the node sees and sends. It reads the map as any reader does, so that the driver never
//! waits for it; scans come to it through a channel with a limit.

use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use flockmap::{Pose, Robot, Stamp, SubmapId};
use flockmap_io::{FlightOptions, FlightRecorder, Frame, WriteError};
use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream, duplex};
use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, interval, timeout};

use crate::map_output::MapReaders;
use crate::{Clock, Log, NodeCounters};

/// Bytes of scans that may wait for the disk; of more, the newest are left out.
const WAITING_BYTES_MAX: usize = 16 << 20;

/// What was recorded is made safe from the end of the program so often.
const FLUSH_PERIOD: Duration = Duration::from_secs(1);

/// Before it connects again, where the node has closed it, since the disk took nothing for too long.
const CONNECT_PAUSE: Duration = Duration::from_secs(1);

/// For the rest of the map to come, each part of it.
const REST_TIME: Duration = Duration::from_millis(500);

/// What is read at once, and what may wait to be read.
const READ_BYTES: usize = 1 << 16;

/// Where the flight is recorded, and what of it.
#[derive(Clone, PartialEq, Debug)]
pub struct Recording {
    /// The `.mcap`; if there is one of that name, the new one gets a number.
    pub path: PathBuf,
    /// What is recorded.
    pub options: FlightOptions,
}

/// The driver's side. Dropping it ends the file.
pub(crate) struct Recorder {
    /// `None` at the end, and where scans are not wanted.
    scans: Option<mpsc::UnboundedSender<Seen>>,
    is_with_scans: bool,
    /// How many submaps had begun, and how many had been moved, when it was recorded last how they lie.
    submap_changes: u64,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

/// What is recorded beside the feed.
enum Seen {
    Scan(Frame),
    /// How all submaps lie from a time on.
    Submaps(Stamp, Vec<Pose>),
}

#[derive(Default)]
struct Shared {
    bytes: AtomicU64,
    scans_left_out: AtomicU64,
    stopped: AtomicU64,
    waiting_bytes: AtomicUsize,
}

impl Recorder {
    /// Makes the file and starts the thread.
    ///
    /// # Errors
    /// Either is not possible.
    pub(crate) fn start(
        recording: &Recording,
        name: &str,
        clock: Clock,
        readers: MapReaders,
        log: Log,
    ) -> Result<Self, io::Error> {
        let flight =
            FlightRecorder::create(&recording.path, name, recording.options).map_err(io::Error::other)?;
        log.info(format!("records the flight to {}", flight.path().display()));
        let shared = Arc::<Shared>::default();
        let (scans, scans_in) = mpsc::unbounded_channel();
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let work = Work { flight, scans: scans_in, shared: Arc::clone(&shared), clock, readers, log };
        let thread = std::thread::Builder::new()
            .name(format!("record of {name}"))
            .spawn(move || runtime.block_on(work.run()))?;
        let is_with_scans = recording.options.scans;
        Ok(Self { scans: Some(scans), is_with_scans, submap_changes: 0, shared, thread: Some(thread) })
    }

    /// Records a scan if scans are wanted. Never waits.
    pub(crate) fn note_scan(&self, frame: Frame) {
        if !self.note(Seen::Scan(frame)) {
            self.shared.scans_left_out.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Records how the submaps of the robot lie from a time on, if scans are wanted and submaps began or were moved.
    /// To be called before the scan that was taken in so. A list that has no room is tried again at the next one.
    /// Never waits.
    pub(crate) fn note_submaps(&mut self, now: Stamp, robot: &Robot) {
        let counters = robot.counters();
        let changes = counters.submaps_begun + counters.submap_poses;
        if !self.is_with_scans || changes == self.submap_changes {
            return;
        }
        let submaps = (0..=robot.submap().number()).filter_map(SubmapId::new);
        let poses = submaps.map(|submap| robot.submap_pose(submap)).collect();
        if self.note(Seen::Submaps(now, poses)) {
            self.submap_changes = changes;
        }
    }

    /// Whether there is room for it, or it is not wanted.
    fn note(&self, seen: Seen) -> bool {
        let Some(scans) = self.scans.as_ref().filter(|_| self.is_with_scans) else { return true };
        let bytes = bytes_of(&seen);
        let waiting = self.shared.waiting_bytes.fetch_add(bytes, Ordering::Relaxed);
        // One that is larger than the limit goes alone.
        let has_room = waiting == 0 || waiting + bytes <= WAITING_BYTES_MAX;
        let is_taken = has_room && scans.send(seen).is_ok();
        if !is_taken {
            self.shared.waiting_bytes.fetch_sub(bytes, Ordering::Relaxed);
        }
        is_taken
    }

    /// The counters of the node with what is counted here.
    pub(crate) fn counters(&self, node: NodeCounters) -> NodeCounters {
        let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        NodeCounters {
            record_bytes: read(&self.shared.bytes),
            record_scans_left_out: read(&self.shared.scans_left_out),
            record_stopped: read(&self.shared.stopped),
            ..node
        }
    }

    /// Ends the file, once the map has ended for its readers, and waits for that.
    pub(crate) fn end(&mut self) {
        self.scans = None;
        if let Some(thread) = self.thread.take() {
            // If it panicked there is nothing to mend.
            let _ = thread.join();
        }
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        self.end();
    }
}

fn bytes_of(seen: &Seen) -> usize {
    100 + match seen {
        Seen::Scan(frame) => 12 * (frame.scan.points.len() + frame.scan.no_returns.len()),
        Seen::Submaps(_, poses) => size_of::<Pose>() * poses.len(),
    }
}

/// What the thread works on.
struct Work {
    flight: FlightRecorder,
    scans: mpsc::UnboundedReceiver<Seen>,
    shared: Arc<Shared>,
    clock: Clock,
    readers: MapReaders,
    log: Log,
}

impl Work {
    async fn run(mut self) {
        let recorded = self.record().await;
        let Self { flight, shared, clock, log, .. } = self;
        let path = flight.path().to_owned();
        let ended = match recorded {
            Ok(()) => flight.finish(clock.now()),
            Err(full @ WriteError::Full { .. }) => {
                shared.stopped.store(1, Ordering::Relaxed);
                log.warn(format!("the record has ended, and the flight goes on without: {full}"));
                flight.finish(clock.now())
            }
            Err(error) => {
                flight.abandon();
                Err(error)
            }
        };
        if let Err(error) = ended {
            shared.stopped.store(1, Ordering::Relaxed);
            log.error(format!("the record has ended, and the flight goes on without: {error}"));
        }
        if let Ok(file) = std::fs::metadata(path) {
            shared.bytes.store(file.len(), Ordering::Relaxed);
        }
    }

    /// Until the node ends.
    async fn record(&mut self) -> Result<(), WriteError> {
        let mut flush = interval(FLUSH_PERIOD);
        flush.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut buffer = vec![0; READ_BYTES];
        loop {
            let mut stream = self.connect().await;
            loop {
                tokio::select! {
                    read = stream.read(&mut buffer) => match read {
                        Ok(0) | Err(_) => break,
                        Ok(count) => self.flight.push(self.clock.now(), buffer.get(..count).unwrap_or_default())?,
                    },
                    scan = self.scans.recv() => match scan {
                        Some(seen) => self.take(&seen)?,
                        None => return self.take_rest(stream).await,
                    },
                    _ = flush.tick() => {
                        self.flight.flush()?;
                        self.shared.bytes.store(self.flight.bytes(), Ordering::Relaxed);
                    }
                }
            }
            // The map has ended, or the disk was too slow for it.
            let scans = async {
                while let Some(seen) = self.scans.recv().await {
                    self.take(&seen)?;
                }
                Ok(())
            };
            if let Ok(ended) = timeout(CONNECT_PAUSE, scans).await {
                return ended;
            }
        }
    }

    /// The driver has ended the record: what the map still says is recorded, if it ends soon.
    async fn take_rest(&mut self, mut stream: DuplexStream) -> Result<(), WriteError> {
        let mut buffer = vec![0; READ_BYTES];
        // Where the node could not start, it does not end.
        while let Ok(Ok(count @ 1..)) = timeout(REST_TIME, stream.read(&mut buffer)).await {
            self.flight.push(self.clock.now(), buffer.get(..count).unwrap_or_default())?;
        }
        Ok(())
    }

    async fn connect(&mut self) -> DuplexStream {
        let (mut ours, theirs) = duplex(READ_BYTES);
        self.readers.take(theirs);
        // Where the node is gone, reading says so.
        let _ = ours.write_all(&self.flight.hello()).await;
        ours
    }

    fn take(&mut self, seen: &Seen) -> Result<(), WriteError> {
        self.shared.waiting_bytes.fetch_sub(bytes_of(seen), Ordering::Relaxed);
        let written = match seen {
            Seen::Scan(frame) => self.flight.write_scan(&frame.scan, &frame.t_map_sensor),
            Seen::Submaps(now, poses) => self.flight.write_submaps(*now, poses),
        };
        match written {
            Err(WriteError::Unfit { .. }) => {
                self.shared.scans_left_out.fetch_add(1, Ordering::Relaxed);
                Ok(())
            }
            written => written,
        }
    }
}
