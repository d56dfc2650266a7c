//! The threads on which the robot's disk is written, and the channel to them: the robot never waits for it.

use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, SyncSender, channel, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use flockmap::codec::Header;
use flockmap::{Event, Package, Robot, Stamp, Stream};
use flockmap_store::{
    Compacted, Compaction, Contents, EpochFile, Notice, StoreCounters, StoreLog, StreamCopy, contents_of,
    packages_of,
};

use crate::{Level, Log};

/// Bytes of packages that may wait for the disk; of more, the newest are left out. Their packages are held by
/// the session as well, as a rule.
const WAITING_BYTES_MAX: usize = 16 << 20;

/// Packages of a run begun while flying that are given to the disk as one.
const PACKAGES_AT_ONCE: usize = 256;

/// Takes what is to be on disk. Never waits for the disk. Dropping it writes what waits, makes it safe, and
/// lets go of the folder.
#[derive(Debug)]
pub struct StoreWriter {
    jobs: Sender<Job>,
    thread: Option<JoinHandle<()>>,
    shared: Arc<Shared>,
    has_store: bool,
    /// The run that was begun while flying, and the last of its packages that was stored with it.
    begun: Option<(Stream, u32)>,
    /// The copies that a compaction asks for.
    asked: Option<Receiver<Asked>>,
}

/// What the threads share.
#[derive(Debug)]
struct Shared {
    log: Log,
    counters: Mutex<StoreCounters>,
    /// Left out before they came to the store.
    left_out: AtomicU64,
    waiting_bytes: AtomicUsize,
    is_slowness_logged: AtomicBool,
}

enum Job {
    Store(Vec<Package>),
    Contents(Contents),
    Epoch(u64),
    Compacted(Compacted),
    Flush(SyncSender<()>),
    End,
}

/// A compaction asks for the next stream after one, to be given here; `None` says that there is none any more.
struct Asked {
    after: Option<Stream>,
    answer: SyncSender<Option<StreamCopy>>,
}

impl StoreWriter {
    /// Takes the store of this run, and the file of its epoch, each if there is one. Where the system gives
    /// no thread, that is logged and nothing is stored.
    pub fn start(store: Option<StoreLog>, epochs: Option<EpochFile>, log: Log) -> Self {
        let shared = Arc::new(Shared {
            log,
            counters: Mutex::default(),
            left_out: AtomicU64::new(0),
            waiting_bytes: AtomicUsize::new(0),
            is_slowness_logged: AtomicBool::new(false),
        });
        let has_store = store.is_some();
        let (jobs, jobs_in) = channel();
        let (asks, asked) = channel();
        let mut writer = Writer {
            shared: Arc::clone(&shared),
            store,
            epochs,
            began: Instant::now(),
            jobs: jobs.clone(),
            asks,
            compaction: None,
        };
        writer.report();
        let thread = std::thread::Builder::new().name("store".into()).spawn(move || writer.run(&jobs_in));
        if let Err(error) = &thread {
            let mut counters = shared.counters();
            counters.failures += u64::from(has_store);
            counters.is_off = has_store;
            drop(counters);
            shared.log.error(format!("store: cannot start a thread: {error}. The robot flies on in memory"));
        }
        Self { jobs, thread: thread.ok(), shared, has_store, begun: None, asked: Some(asked) }
    }

    /// Stores what an event says is to be stored.
    pub fn note(&self, event: &Event) {
        if let Some(contents) = contents_of(event).filter(|_| self.has_store) {
            // Without a thread nothing is kept, which was logged.
            let _ = self.give(Job::Contents(contents));
        }
        let packages = packages_of(event);
        let is_begun = |header: &Header| {
            self.begun.is_some_and(|(run, upto)| header.stream == run && header.index <= upto)
        };
        if packages.last().is_some_and(|last| !is_begun(last.header())) {
            self.store(packages.to_vec());
        }
    }

    fn store(&self, packages: Vec<Package>) {
        if packages.is_empty() || !self.has_store {
            return;
        }
        let (bytes, count) = (bytes_of(&packages), packages.len() as u64);
        let waiting = self.shared.waiting_bytes.fetch_add(bytes, Ordering::Relaxed);
        let is_full = waiting + bytes > WAITING_BYTES_MAX;
        if is_full && !self.shared.is_slowness_logged.swap(true, Ordering::Relaxed) {
            self.shared.log.warn(
                "store: the disk does not keep up; packages are left out, and asked for after a restart",
            );
        }
        if is_full || !self.give(Job::Store(packages)) {
            self.shared.waiting_bytes.fetch_sub(bytes, Ordering::Relaxed);
            self.shared.left_out.fetch_add(count, Ordering::Relaxed);
        }
    }

    /// The robot has begun anew without a restart: keeps its epoch, and stores what it has published in this
    /// run so far. That may be more than it keeps events of. What is noted from here on is of this run.
    pub fn note_run(&mut self, robot: &Robot) {
        let run = robot.own_stream();
        // Without a thread nothing is kept, which was logged.
        let _ = self.give(Job::Epoch(run.epoch));
        let stored = robot.session().store().range(run, 1, u32::MAX);
        let packages: Vec<_> = stored.map(|(_, stored)| stored.package.clone()).collect();
        self.begun = packages.last().map(|last| (run, last.header().index));
        for packages in packages.chunks(PACKAGES_AT_ONCE) {
            self.store(packages.to_vec());
        }
    }

    /// Does a part of a compaction if one asks for it: copies one layer. To be called often, between two
    /// events, with no event left unread. Not while a run begun anew is not yet all that the one before was: the
    /// compaction would leave that one out.
    pub fn step(&self, robot: &Robot) {
        if robot.is_republishing() {
            return;
        }
        if let Some(Asked { after, answer }) = self.asked.as_ref().and_then(|asked| asked.try_recv().ok()) {
            // It waits for this.
            let _ = answer.send(StreamCopy::next(robot, after));
        }
    }

    /// Waits until all that was noted is safe on disk, or has failed.
    pub fn flush(&self) {
        let (done, is_done) = sync_channel(1);
        if self.give(Job::Flush(done)) {
            // An error means that the thread is gone, and with it what it could do.
            let _ = is_done.recv();
        }
    }

    /// What was done so far; all 0 without a store.
    pub fn counters(&self) -> StoreCounters {
        let mut counters = *self.shared.counters();
        counters.left_out += self.shared.left_out.load(Ordering::Relaxed);
        counters
    }

    /// Whether it is taken.
    fn give(&self, job: Job) -> bool {
        self.jobs.send(job).is_ok()
    }
}

/// Writes a compacted segment of the copies that it asks for. `None`: the node has ended before the first of
/// them.
fn compact(mut compaction: Compaction, asks: &Sender<Asked>) -> Option<Compacted> {
    let mut last = None;
    loop {
        let (answer, answered) = sync_channel(1);
        // Where nobody answers any more, the answer says so.
        let _ = asks.send(Asked { after: last, answer });
        match answered.recv() {
            Ok(Some(copy)) => {
                last = Some(copy.stream());
                if !compaction.add(copy) {
                    return Some(compaction.finish());
                }
            }
            Ok(None) => return Some(compaction.finish()),
            Err(_) => return last.map(|_| compaction.abandon("the node ended before")),
        }
    }
}

impl Drop for StoreWriter {
    fn drop(&mut self) {
        // A compaction that is not complete ends without its last step.
        self.asked = None;
        self.give(Job::End);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Shared {
    fn counters(&self) -> MutexGuard<'_, StoreCounters> {
        self.counters.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What the thread works on.
struct Writer {
    shared: Arc<Shared>,
    store: Option<StoreLog>,
    epochs: Option<EpochFile>,
    /// Time counts from here.
    began: Instant,
    /// For its compactions: where they report their end, and ask for copies.
    jobs: Sender<Job>,
    asks: Sender<Asked>,
    /// The thread of the last one.
    compaction: Option<JoinHandle<()>>,
}

impl Writer {
    fn run(mut self, jobs: &Receiver<Job>) {
        self.consider_compaction();
        loop {
            let due = self.store.as_ref().and_then(StoreLog::poll_timeout);
            let wait = due.map_or(Duration::MAX, |due| {
                Duration::from_micros(due.micros_since(self.now()).max(0).unsigned_abs())
            });
            match jobs.recv_timeout(wait) {
                Ok(Job::End) | Err(RecvTimeoutError::Disconnected) => break,
                Ok(job) => self.work(job),
                Err(RecvTimeoutError::Timeout) => {}
            }
            // While jobs keep coming, the time-out does not.
            let now = self.now();
            self.with_store(|store| store.handle_timeout(now));
            self.consider_compaction();
        }
        if let Some(compaction) = self.compaction.take() {
            let _ = compaction.join();
        }
        // It has reported its end.
        jobs.try_iter().for_each(|job| self.work(job));
        self.with_store(StoreLog::sync);
    }

    fn work(&mut self, job: Job) {
        let now = self.now();
        match job {
            Job::Store(packages) => {
                self.shared.waiting_bytes.fetch_sub(bytes_of(&packages), Ordering::Relaxed);
                self.with_store(|store| store.append(now, &packages));
            }
            Job::Contents(contents) => {
                self.with_store(|store| store.append_contents(now, contents));
            }
            Job::Epoch(epoch) => {
                if let Some(Err(fault)) = self.epochs.as_mut().map(|file| file.keep(epoch)) {
                    self.shared.log.warn(fault.to_string());
                }
                self.with_store(|store| store.note_epoch(epoch));
            }
            Job::Compacted(compacted) => {
                self.with_store(|store| store.end_compaction(compacted));
            }
            Job::Flush(done) => {
                self.with_store(StoreLog::sync);
                // Who asked may be gone.
                let _ = done.send(());
            }
            Job::End => {}
        }
    }

    fn now(&self) -> Stamp {
        Stamp(i64::try_from(self.began.elapsed().as_micros()).unwrap_or(i64::MAX))
    }

    fn consider_compaction(&mut self) {
        let Some(compaction) = self.with_store(StoreLog::begin_compaction).flatten() else { return };
        let (jobs, asks) = (self.jobs.clone(), self.asks.clone());
        let (hand_over, handed) = sync_channel(1);
        let work = move || {
            if let Some(compacted) = handed.recv().ok().and_then(|compaction| compact(compaction, &asks)) {
                // Without a writer there is nothing to report to.
                let _ = jobs.send(Job::Compacted(compacted));
            }
        };
        match std::thread::Builder::new().name("store compaction".into()).spawn(work) {
            Ok(thread) => {
                self.compaction = Some(thread);
                // It waits for this.
                let _ = hand_over.send(compaction);
            }
            Err(error) => {
                let compacted = compaction.abandon(&format!("cannot start a thread: {error}"));
                self.with_store(|store| store.end_compaction(compacted));
            }
        }
    }

    /// Does something with the store, if there is one, and reports what came of it.
    fn with_store<T>(&mut self, work: impl FnOnce(&mut StoreLog) -> T) -> Option<T> {
        let done = work(self.store.as_mut()?);
        self.report();
        Some(done)
    }

    fn report(&mut self) {
        let Some(store) = &mut self.store else { return };
        while let Some(notice) = store.poll_notice() {
            let level = match notice {
                Notice::Off(_) => Level::Error,
                _ => Level::Warning,
            };
            self.shared.log.say(level, notice.to_string());
        }
        *self.shared.counters() = store.counters();
    }
}

fn bytes_of(packages: &[Package]) -> usize {
    packages.iter().map(|package| package.bytes().len() + 100).sum()
}
