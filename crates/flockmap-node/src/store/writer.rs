//! The thread that writes the log, and the hand on it.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, SyncSender, channel, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use flockmap::{Event, Package, Robot, Stream};

use super::compaction::{Compaction, StreamCopy};
use super::log::{Log, LogError};
use super::record::{CONTENT_MAX, Record, SegmentHeader};
use super::{Disk, Store, StoreCounters, StoreError, StoreOptions};
use crate::Level;

/// Bytes of records that may wait for the disk; of more, the newest are left out. Their packages are held by the session as well, as a rule.
const WAITING_BYTES_MAX: usize = 16 << 20;
/// From so many segments on, a run that begins makes one of them.
const SEGMENTS_MAX: usize = 64;

/// Takes what is to be stored. Never waits for the disk. Dropping it writes what waits, makes it safe, and lets go of the folder.
#[derive(Debug)]
pub struct StoreWriter {
    jobs: Option<Sender<Job>>,
    thread: Option<JoinHandle<()>>,
    shared: Arc<Shared>,
    running: Option<Running>,
    compaction_thread: Option<JoinHandle<()>>,
}

/// What the threads share.
#[derive(Debug)]
struct Shared {
    disk: Arc<dyn Disk>,
    options: StoreOptions,
    log: crate::Log,
    counters: Mutex<StoreCounters>,
    /// A compacted segment that is to be made.
    wanted: Mutex<Option<SegmentHeader>>,
    waiting_bytes: AtomicUsize,
    is_slowness_told: AtomicBool,
}

enum Job {
    Store(Vec<Record>),
    Compacted(SegmentHeader, Result<u64, String>),
    Flush(SyncSender<()>),
}

/// A compaction on its way.
#[derive(Debug)]
struct Running {
    copies: SyncSender<Step>,
    is_busy: Arc<AtomicBool>,
    last: Option<Stream>,
}

enum Step {
    Stream(Box<StreamCopy>),
    End,
}

impl Store {
    /// Begins the segment of this run, after [`Self::restore`]. When this returns, the epoch is safe on disk: a later run will not use it. Where the disk
    /// refuses, that is said and counted, and nothing is stored in this run: the robot works from memory.
    ///
    /// # Errors
    /// [`StoreError::Epoch`] if the epoch is not higher than all before; [`StoreError::Disk`] if there is no thread to be had.
    pub fn start(self, epoch: u64, log: crate::Log) -> Result<StoreWriter, StoreError> {
        if let Some(last) = self.last_epoch.filter(|last| *last >= epoch) {
            return Err(StoreError::Epoch { got: epoch, last });
        }
        let Self { disk, identity, options, segments, restored, .. } = self;
        let disk_bytes = segments.values().sum();
        let shared = Arc::new(Shared {
            disk: Arc::clone(&disk),
            options,
            log,
            counters: Mutex::new(StoreCounters { disk_bytes, ..restored.into() }),
            wanted: Mutex::new(None),
            waiting_bytes: AtomicUsize::new(0),
            is_slowness_told: AtomicBool::new(false),
        });
        let log = Log::begin(disk, identity, epoch, options.bytes_max, segments);
        let log = log.map_err(|error| shared.fail(&error)).ok();
        let (jobs, jobs_in) = channel();
        let writer = Writer {
            shared: Arc::clone(&shared),
            log,
            sync_due: None,
            is_compacting: false,
            compacted_at: None,
        };
        let thread = std::thread::Builder::new()
            .name("store".into())
            .spawn(move || writer.run(&jobs_in))
            .map_err(super::disk_error("start a thread"))?;
        Ok(StoreWriter {
            jobs: Some(jobs),
            thread: Some(thread),
            shared,
            running: None,
            compaction_thread: None,
        })
    }
}

impl StoreWriter {
    /// Stores what an event says is to be stored.
    pub fn note(&self, event: &Event) {
        match event {
            Event::CycleClosed { packages, .. } => self.store(packages),
            Event::Merged { package, .. } => self.store(std::slice::from_ref(package)),
            _ => {}
        }
    }

    fn store(&self, packages: &[Package]) {
        let fits = |package: &&Package| package.bytes().len() <= CONTENT_MAX;
        let records: Vec<Record> = packages.iter().filter(fits).cloned().map(Record::Package).collect();
        let bytes = bytes_of(&records);
        let waiting = self.shared.waiting_bytes.fetch_add(bytes, Ordering::Relaxed);
        let is_full = waiting + bytes > WAITING_BYTES_MAX;
        if is_full && !self.shared.is_slowness_told.swap(true, Ordering::Relaxed) {
            self.shared.log.warn(
                "store: the disk does not keep up; packages are left out, and asked for after a restart",
            );
        }
        let is_sent =
            !is_full && self.jobs.as_ref().is_some_and(|jobs| jobs.send(Job::Store(records)).is_ok());
        if !is_sent {
            self.shared.waiting_bytes.fetch_sub(bytes, Ordering::Relaxed);
            self.shared.counters().left_out += packages.len() as u64;
        }
    }

    /// Does a part of a compaction if one is on its way: copies one layer. To be called often, between two events, with no event left unread.
    pub fn step(&mut self, robot: &Robot) {
        if self.running.is_none() {
            let Some(header) = lock(&self.shared.wanted).take() else { return };
            self.running = self.begin_compaction(header);
        }
        let Some(running) = &mut self.running else { return };
        if running.is_busy.swap(true, Ordering::Acquire) {
            return;
        }
        let step = StreamCopy::next(robot, running.last).map_or(Step::End, |copy| {
            running.last = Some(copy.stream());
            Step::Stream(Box::new(copy))
        });
        let is_over = matches!(step, Step::End);
        if running.copies.send(step).is_err() || is_over {
            self.running = None;
        }
    }

    /// Waits until all that was noted is safe on disk, or has failed.
    pub fn flush(&self) {
        let (done, is_done) = sync_channel(1);
        if let Some(jobs) = &self.jobs
            && jobs.send(Job::Flush(done)).is_ok()
        {
            // An error means that the thread is gone, and with it what it could do.
            let _ = is_done.recv();
        }
    }

    /// What was done so far.
    pub fn counters(&self) -> StoreCounters {
        *self.shared.counters()
    }

    fn begin_compaction(&mut self, header: SegmentHeader) -> Option<Running> {
        if let Some(before) = self.compaction_thread.take() {
            // It has told its end.
            let _ = before.join();
        }
        let (copies, copies_in) = sync_channel(1);
        let is_busy = Arc::new(AtomicBool::new(false));
        let (shared, jobs, busy) = (Arc::clone(&self.shared), self.jobs.clone()?, Arc::clone(&is_busy));
        let work = move || {
            let result = compact(&shared, header, &copies_in, &busy);
            // Without a writer there is nothing to tell.
            let _ = jobs.send(Job::Compacted(header, result));
        };
        match std::thread::Builder::new().name("store compaction".into()).spawn(work) {
            Ok(thread) => self.compaction_thread = Some(thread),
            Err(error) => {
                let result = Err(format!("cannot start a thread: {error}"));
                let _ = self.jobs.as_ref()?.send(Job::Compacted(header, result));
                return None;
            }
        }
        Some(Running { copies, is_busy, last: None })
    }
}

/// Writes a compacted segment of the copies that come.
fn compact(
    shared: &Shared,
    header: SegmentHeader,
    copies: &Receiver<Step>,
    is_busy: &AtomicBool,
) -> Result<u64, String> {
    // So that together with the log that it replaces, and what is written meanwhile, it stays within the cap.
    let bytes_max = shared.options.bytes_max / 16 * 7;
    let mut compaction =
        Compaction::begin(Arc::clone(&shared.disk), header, bytes_max).map_err(|error| error.to_string())?;
    loop {
        let result = match copies.recv() {
            Ok(Step::Stream(copy)) => compaction.add(*copy),
            Ok(Step::End) => return compaction.finish(),
            Err(_) => Err("the node ended before".into()),
        };
        if let Err(why) = result {
            compaction.abandon();
            return Err(why);
        }
        is_busy.store(false, Ordering::Release);
    }
}

impl Drop for StoreWriter {
    fn drop(&mut self) {
        // A compaction that is not complete ends without its last step.
        self.running = None;
        let threads = self.compaction_thread.take();
        for thread in threads.into_iter() {
            let _ = thread.join();
        }
        self.jobs = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Shared {
    fn counters(&self) -> MutexGuard<'_, StoreCounters> {
        lock(&self.counters)
    }

    /// Said once: nothing is written after it.
    fn fail(&self, error: &LogError) {
        self.counters().failures += 1;
        let text = format!(
            "store: {error}. The robot flies on in memory; nothing more is stored until it is started again"
        );
        self.log.say(Level::Error, text);
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// What the thread works on.
struct Writer {
    shared: Arc<Shared>,
    /// `None` after a failure.
    log: Option<Log>,
    /// When what was written has to be made safe.
    sync_due: Option<Instant>,
    is_compacting: bool,
    /// Bytes on disk after the last compaction of this run.
    compacted_at: Option<u64>,
}

impl Writer {
    fn run(mut self, jobs: &Receiver<Job>) {
        self.consider_compaction();
        loop {
            let job = match self.sync_due {
                None => jobs.recv().map_err(|_| RecvTimeoutError::Disconnected),
                Some(due) => jobs.recv_timeout(due.saturating_duration_since(Instant::now())),
            };
            match job {
                Ok(Job::Store(records)) => self.store(&records),
                Ok(Job::Compacted(header, result)) => self.replace(&header, result),
                Ok(Job::Flush(done)) => {
                    self.sync();
                    // Who asked may be gone.
                    let _ = done.send(());
                }
                Err(RecvTimeoutError::Timeout) => self.sync(),
                Err(RecvTimeoutError::Disconnected) => break,
            }
            // While jobs keep coming, the time-out does not.
            if self.sync_due.is_some_and(|due| due <= Instant::now()) {
                self.sync();
            }
        }
        self.sync();
    }

    fn store(&mut self, records: &[Record]) {
        self.shared.waiting_bytes.fetch_sub(bytes_of(records), Ordering::Relaxed);
        let count = records.len() as u64;
        let Some(bytes) = self.attempt(|log| log.append(records.iter())) else {
            self.shared.counters().left_out += count;
            return;
        };
        {
            let mut counters = self.shared.counters();
            counters.written += count;
            counters.written_bytes += bytes;
        }
        self.note_bytes();
        let period = self.shared.options.sync_period;
        self.sync_due.get_or_insert_with(|| Instant::now() + period.min(Duration::from_secs(3_600)));
        self.consider_compaction();
    }

    fn sync(&mut self) {
        self.sync_due = None;
        if self.log.as_ref().is_some_and(|log| !log.is_synced()) && self.attempt(Log::sync).is_some() {
            self.shared.counters().syncs += 1;
        }
    }

    /// Begins to replace the log by present states if it has grown enough.
    fn consider_compaction(&mut self) {
        let Some(log) = &self.log else { return };
        let bytes_max = self.shared.options.bytes_max;
        let is_due = match self.compacted_at {
            None => log.bytes() > bytes_max / 2 || log.segments() > SEGMENTS_MAX,
            Some(then) => log.bytes() > (bytes_max / 2).max(then.saturating_add(bytes_max / 16)),
        };
        if is_due && !self.is_compacting {
            let Some(header) = self.attempt(Log::roll) else { return };
            self.is_compacting = true;
            self.note_bytes();
            *lock(&self.shared.wanted) = Some(header);
        }
    }

    fn replace(&mut self, header: &SegmentHeader, result: Result<u64, String>) {
        self.is_compacting = false;
        match result {
            Ok(bytes) => {
                if self.attempt(|log| log.replace(header, bytes)).is_some() {
                    self.note_bytes();
                    self.shared.counters().compactions += 1;
                }
            }
            Err(why) => {
                self.shared.counters().compactions_failed += 1;
                self.shared
                    .log
                    .warn(format!("store: the log could not be made shorter, and grows on: {why}"));
            }
        }
        self.compacted_at = self.log.as_ref().map(Log::bytes);
        self.note_bytes();
    }

    fn note_bytes(&self) {
        if let Some(log) = &self.log {
            self.shared.counters().disk_bytes = log.bytes();
        }
    }

    /// Does something with the log; after a failure there is none any more.
    fn attempt<T>(&mut self, work: impl FnOnce(&mut Log) -> Result<T, LogError>) -> Option<T> {
        match work(self.log.as_mut()?) {
            Ok(done) => Some(done),
            Err(error) => {
                self.shared.fail(&error);
                self.log = None;
                None
            }
        }
    }
}

fn bytes_of(records: &[Record]) -> usize {
    let bytes = |record: &Record| match record {
        Record::Package(package) => package.bytes().len() + 100,
        Record::Held { .. } => 0,
    };
    records.iter().map(bytes).sum()
}
