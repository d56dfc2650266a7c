//! What a run stores: when it is made safe, when the log is made shorter, and what follows a failure.

use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use flockmap::{Event, Package, Stamp};

use crate::compaction::{Compacted, Compaction};
use crate::log::{Failed, Log, LogError, Shares};
use crate::record::{CONTENT_MAX, Contents, Record, write_package};
use crate::{Disk, Identity, Restored, StoreCounters};

/// What a store may take.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct StoreOptions {
    /// Bytes on disk, never more. From half of it on, the log is replaced by the snapshots of its streams,
    /// which may take 7/16; for these there is always room: of the log itself packages take at most 17/32. At
    /// least 64 KiB; default 256 MiB.
    pub bytes_max: u64,
    /// What was written is made safe (fsync) after so long at the latest: what a power failure can cost. What
    /// only the death of the process can cost is less: the records that were not handed to the system yet.
    /// Default 1 s.
    pub sync_period: Duration,
}

impl Default for StoreOptions {
    fn default() -> Self {
        Self { bytes_max: 256 << 20, sync_period: Duration::from_secs(1) }
    }
}

/// Least cap: room for a few batches and their snapshot.
pub const BYTES_MAX_MIN: u64 = 64 << 10;
/// Longer periods than this count as this.
const SYNC_PERIOD_MAX: Duration = Duration::from_secs(3_600);
/// After a failure it is tried to go on after so long, then twice as long each time, up to 64 times as long.
const GO_ON_AFTER: Duration = Duration::from_secs(10);
/// When there are more segments than this, and since the last time so many more, they are made one.
const SEGMENTS_MAX: usize = 64;

/// Something that whoever looks after the robot should know.
#[derive(Clone, PartialEq, Eq, Debug)]
#[non_exhaustive]
pub enum Notice {
    /// Nothing is stored from now on, until it is said that it goes on.
    Off(String),
    /// Something is wrong, and the store goes on.
    Warning(String),
}

impl Notice {
    /// `is_retried`: it is tried to go on in this run.
    pub(crate) fn off(why: &str, is_retried: bool) -> Self {
        let until = if is_retried { "that is mended" } else { "it is started again" };
        Self::Off(format!("store: {why}. The robot flies on in memory; nothing more is stored until {until}"))
    }
}

impl fmt::Display for Notice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (Self::Off(text) | Self::Warning(text)) = self;
        f.write_str(text)
    }
}

/// Takes what a run makes and merges. Each call that stores waits for the disk.
#[derive(Debug)]
pub struct StoreLog {
    disk: Option<Arc<dyn Disk>>,
    shares: Shares,
    sync_period: Duration,
    /// `None` after a failure.
    log: Option<Log>,
    /// What is on the disk then; `None` as well if the folder cannot be used at all.
    failed: Option<Failed>,
    /// When it is tried to go on, how often that was tried since the failure, and whether the time has come.
    go_on_at: Option<Stamp>,
    go_on_tries: u32,
    is_go_on_due: bool,
    /// The compaction that runs has what was not written since the failure.
    is_going_on: bool,
    /// When what was written has to be made safe.
    sync_due: Option<Stamp>,
    is_compacting: bool,
    /// What the disk could not read must not be replaced by what the robot knows; or there is no room, since
    /// it does not remove what it should.
    keeps_all: bool,
    /// After a compaction that failed: bytes from which on it is tried again.
    retry_at: u64,
    /// Segments after the last compaction of this run.
    segments_then: usize,
    counters: StoreCounters,
    notices: VecDeque<Notice>,
}

impl StoreLog {
    /// Without a disk it has failed already, which a notice says.
    pub(crate) fn begin(
        disk: Option<Arc<dyn Disk>>,
        identity: Identity,
        options: StoreOptions,
        (segments, unremoved, restored): (BTreeMap<(u32, u64), u64>, u64, Restored),
        epoch: u64,
        notices: Vec<Notice>,
    ) -> Self {
        let disk_bytes = segments.values().sum();
        let shares = Shares { all: options.bytes_max.saturating_sub(unremoved) };
        let mut store = Self {
            disk,
            shares,
            sync_period: options.sync_period.min(SYNC_PERIOD_MAX),
            log: None,
            failed: None,
            go_on_at: None,
            go_on_tries: 0,
            is_go_on_due: false,
            is_going_on: false,
            sync_due: None,
            is_compacting: false,
            keeps_all: false,
            retry_at: 0,
            segments_then: 0,
            counters: StoreCounters { disk_bytes, restored, ..StoreCounters::default() },
            notices: notices.into(),
        };
        match &store.disk {
            None => (store.counters.failures, store.counters.is_off) = (1, true),
            Some(disk) => match Log::begin(Arc::clone(disk), identity, epoch, shares, segments.clone()) {
                Ok(log) => store.log = Some(log),
                Err(error) => {
                    store.failed =
                        Some(Failed::at_start(Arc::clone(disk), identity, epoch, shares, segments));
                    store.fail(&error);
                }
            },
        }
        store
    }

    /// Replaces nothing in this run: there is more on the disk than it gave at the start, and it may give
    /// that another time.
    pub(crate) fn keep_all(&mut self) {
        self.keeps_all = true;
        let text = "store: the disk could not read all of it; that is asked for, and nothing of the store is removed in this run";
        self.notices.push_back(Notice::Warning(text.into()));
    }

    /// Stores what an event says is to be stored. `now` never steps back within a run; what it counts from
    /// does not matter.
    pub fn note(&mut self, now: Stamp, event: &Event) {
        self.append(now, packages_of(event));
        if let Some(contents) = contents_of(event) {
            self.append_contents(now, contents);
        }
    }

    /// Stores packages.
    pub fn append(&mut self, now: Stamp, packages: &[Package]) {
        let fitting = || packages.iter().filter(|package| package.bytes().len() <= CONTENT_MAX);
        let count = fitting().count() as u64;
        if count == 0 {
            return;
        }
        let write = |seed, out: &mut Vec<u8>| fitting().for_each(|package| write_package(package, seed, out));
        match self.write(now, write) {
            Some(bytes) => {
                self.counters.written += count;
                self.counters.written_bytes += bytes;
            }
            None => self.counters.left_out += count,
        }
    }

    /// Stores which packages a snapshot contains, behind its chunks.
    pub fn append_contents(&mut self, now: Stamp, contents: Contents) {
        self.write(now, |seed, out| Record::Contents(contents).write(seed, out));
    }

    /// Returns the bytes written.
    fn write(&mut self, now: Stamp, write: impl FnOnce(u32, &mut Vec<u8>)) -> Option<u64> {
        let bytes = self.attempt(|log| log.append(write))?;
        let period = self.sync_period.as_micros() as i64;
        self.sync_due.get_or_insert_with(|| now.plus_micros(period));
        self.handle_timeout(now);
        Some(bytes)
    }

    /// Another run of this robot has begun without a restart, under a higher epoch: a new segment begins, and
    /// when this returns the epoch is safe on disk. What comes next is of that run. An epoch that is not
    /// higher changes nothing.
    pub fn note_epoch(&mut self, epoch: u64) {
        if self.attempt(|log| log.begin_epoch(epoch)).is_some() {
            self.sync_due = None;
        }
        if let Some(failed) = &mut self.failed {
            failed.note_epoch(epoch);
        }
    }

    /// When [`Self::handle_timeout`] has something to do.
    pub fn poll_timeout(&self) -> Option<Stamp> {
        let is_to_go_on = self.failed.is_some() && !self.is_go_on_due && !self.keeps_all;
        let go_on_at = is_to_go_on.then(|| self.go_on_at.unwrap_or(Stamp(i64::MIN)));
        self.sync_due.into_iter().chain(go_on_at).min()
    }

    /// Makes safe what was written, if that is due. After a failure: [`Self::begin_compaction`] tries to go on when its
    /// time has come.
    pub fn handle_timeout(&mut self, now: Stamp) {
        if self.sync_due.is_some_and(|due| due <= now) {
            self.sync();
        }
        if self.failed.is_some() {
            let pause = GO_ON_AFTER * (1 << self.go_on_tries.min(6));
            let at = *self.go_on_at.get_or_insert_with(|| now.plus(pause));
            self.is_go_on_due = at <= now;
        }
    }

    /// Makes safe what was written.
    pub fn sync(&mut self) {
        self.sync_due = None;
        self.counters.syncs += u64::from(self.attempt(Log::sync).unwrap_or(false));
    }

    /// The compaction that is due, if one is; to be asked after each package, at the start, and after
    /// [`Self::end_compaction`] and [`Self::handle_timeout`]. It must be brought to its end ([`Compaction::finish`] or
    /// [`Compaction::abandon`]), on any thread, while this goes on storing. After a failure it has all that the robot has,
    /// so that the log goes on behind it.
    pub fn begin_compaction(&mut self) -> Option<Compaction> {
        if self.is_go_on_due && !self.is_compacting && !self.keeps_all {
            return self.go_on();
        }
        let (log, disk) = (self.log.as_ref()?, self.disk.clone()?);
        let is_due = log.bytes() > self.shares.due().max(self.retry_at)
            || log.segments() > self.segments_then + SEGMENTS_MAX;
        // So that with it, the log that it replaces and what is written meanwhile stay within the cap.
        let room = self.shares.snapshot(log.bytes());
        if !is_due || self.is_compacting || self.keeps_all || room < self.shares.pause() {
            return None;
        }
        let header = self.attempt(|log| log.roll(room))?;
        self.sync_due = None;
        self.is_compacting = true;
        Some(Compaction::begin(disk, header, room))
    }

    fn go_on(&mut self) -> Option<Compaction> {
        let (failed, disk) = (self.failed.take()?, self.disk.clone()?);
        self.go_on_at = None;
        self.is_go_on_due = false;
        self.go_on_tries += 1;
        let room = self.shares.snapshot(failed.bytes());
        if room < self.shares.pause() {
            self.failed = Some(failed);
            return None;
        }
        match failed.go_on(room) {
            Ok((log, header)) => {
                self.log = Some(log);
                (self.is_compacting, self.is_going_on) = (true, true);
                Some(Compaction::begin(disk, header, room))
            }
            Err((failed, _)) => {
                self.failed = Some(failed);
                None
            }
        }
    }

    /// Takes the end of a compaction: if it is complete, the log before it goes.
    pub fn end_compaction(&mut self, compacted: Compacted) {
        let Compacted { header, result, is_gone } = compacted;
        self.is_compacting = false;
        let was_going_on = std::mem::take(&mut self.is_going_on);
        if let (Some(failed), Ok(bytes)) = (&mut self.failed, &result) {
            failed.note_compacted(&header, *bytes);
        }
        if was_going_on && result.is_err() {
            // Without it there is a hole in the log.
            self.end_log();
            self.counters.compactions_failed += 1;
            self.keeps_all |= !is_gone;
            return;
        }
        // What of it is left still takes its room.
        self.keeps_all |= !is_gone;
        if let Some(log) = self.log.as_mut().filter(|_| is_gone) {
            log.end_snapshot();
        }
        match result {
            Ok(bytes) => {
                self.retry_at = 0;
                if self.attempt(|log| log.replace(&header, bytes)).is_some() {
                    self.counters.compactions += 1;
                    if was_going_on {
                        (self.counters.is_off, self.go_on_tries) = (false, 0);
                        let text = "store: the disk works again: all that the robot has is on it";
                        self.notices.push_back(Notice::Warning(text.into()));
                    }
                }
            }
            Err(why) => {
                let bytes = self.log.as_ref().map_or(0, Log::bytes);
                self.retry_at = bytes.saturating_add(self.shares.pause());
                self.counters.compactions_failed += 1;
                let text = format!("store: the log could not be made shorter, and grows on: {why}");
                self.notices.push_back(Notice::Warning(text));
            }
        }
        if let Some(log) = &self.log {
            self.segments_then = log.segments();
        }
    }

    /// What is to be said, in its order.
    pub fn poll_notice(&mut self) -> Option<Notice> {
        self.notices.pop_front()
    }

    /// What was done so far.
    pub fn counters(&self) -> StoreCounters {
        let disk_bytes = self.log.as_ref().map_or(self.counters.disk_bytes, Log::bytes);
        StoreCounters { disk_bytes, ..self.counters }
    }

    /// Does something with the log; after a failure there is none any more.
    fn attempt<T>(&mut self, work: impl FnOnce(&mut Log) -> Result<T, LogError>) -> Option<T> {
        match work(self.log.as_mut()?) {
            Ok(done) => Some(done),
            Err(error) => {
                self.fail(&error);
                None
            }
        }
    }

    /// Nothing is written any more; what there is stays for one that goes on behind it.
    fn end_log(&mut self) {
        self.counters = self.counters();
        self.sync_due = None;
        if let Some(log) = self.log.take() {
            self.failed = Some(log.fail());
        }
    }

    /// Said once: nothing is written after it until it goes on.
    fn fail(&mut self, error: &LogError) {
        self.end_log();
        if !std::mem::replace(&mut self.counters.is_off, true) {
            self.counters.failures += 1;
            self.notices.push_back(Notice::off(&error.to_string(), !self.keeps_all));
        }
    }
}

/// The packages that an event says are to be stored.
pub fn packages_of(event: &Event) -> &[Package] {
    match event {
        Event::BatchClosed { packages, .. } => packages,
        Event::Merged { package, .. } => std::slice::from_ref(package),
        _ => &[],
    }
}

/// What an event says that a snapshot contains, which is to be stored behind its chunks.
pub fn contents_of(event: &Event) -> Option<Contents> {
    let Event::SnapshotContains { stream, snapshot_id, received } = event else { return None };
    Some(Contents { stream: *stream, snapshot_id: *snapshot_id, intervals: received.intervals().to_vec() })
}
