//! The store on disk: what a robot made and merged, so that it has its map again after a reboot. `docs/store.md` has the bytes.
//!
//! A store is a folder of segments, each a header and records that only ever grows. Every run begins a segment of its own, and never writes to one of a
//! former run. A store is opened ([`Store::open`]), gives the robot what it has ([`Store::restore`]), and then takes what comes
//! ([`Store::start`]) on a thread of its own, so that the robot never waits for the disk.

mod compaction;
mod counters;
mod disk;
mod inspect;
mod log;
mod record;
mod writer;

use std::collections::BTreeMap;
use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use flockmap::{Event, Resolution, Robot, RobotId, Stamp};

pub use counters::StoreCounters;
pub use disk::{Disk, DiskFile, Folder};
pub use inspect::{Inspection, SegmentFacts, StreamFacts, inspect, is_store};
pub use record::STORE_VERSION;
pub use writer::StoreWriter;

use record::{NoHeader, Record, Scan, parse_name};

/// What a store may take.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct StoreOptions {
    /// Bytes on disk, never more. From half of it on, the log is replaced by the present states of its streams. At least 64 KiB; default 256 MiB.
    pub bytes_max: u64,
    /// What was written is made safe (fsync) after so long at the latest: what a power failure can cost. What only the death of the process
    /// can cost is less: the records that were not handed to the system yet. Default 1 s.
    pub sync_period: Duration,
}

impl Default for StoreOptions {
    fn default() -> Self {
        Self { bytes_max: 256 << 20, sync_period: Duration::from_secs(1) }
    }
}

/// Least cap: room for a few cycles and their present state.
const BYTES_MAX_MIN: u64 = 64 << 10;

/// Whose store it is. One of another robot is not opened.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Identity {
    /// The swarm.
    pub swarm: u16,
    /// The robot.
    pub robot: RobotId,
    /// The side of its voxels.
    pub resolution: Resolution,
}

/// Why a store cannot be opened. The text says what to do.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StoreError {
    /// The system refused something.
    #[error("store: cannot {what}: {source}")]
    Disk {
        /// What was asked of it.
        what: String,
        /// Its answer.
        source: io::Error,
    },
    /// Another node has the folder.
    #[error("store: {path} is in use by another node: give each node a folder of its own")]
    InUse {
        /// The folder.
        path: PathBuf,
    },
    /// It belongs to another robot.
    #[error("store: {name} is of {got:?}, this robot is {own:?}: give it another folder, or empty this one")]
    Foreign {
        /// The segment that says so.
        name: String,
        /// Whose it is.
        got: Identity,
        /// Who wants it.
        own: Identity,
    },
    /// It was written by another version.
    #[error(
        "store: {name} has version {got}, this program knows version {STORE_VERSION}: give the robot another folder, or empty this one"
    )]
    Version {
        /// The segment that says so.
        name: String,
        /// Its version.
        got: u8,
    },
    /// An option cannot work.
    #[error("store: bytes_max is {got}, expected at least {BYTES_MAX_MIN}")]
    BytesMax {
        /// Its value.
        got: u64,
    },
    /// The epoch of the robot was used before.
    #[error("store: epoch {got} was used before: the last one was {last}, give a higher one or none")]
    Epoch {
        /// The epoch of this run.
        got: u64,
        /// The highest in the store.
        last: u64,
    },
}

fn disk_error(what: impl Into<String>) -> impl FnOnce(io::Error) -> StoreError {
    let what = what.into();
    move |source| StoreError::Disk { what, source }
}

/// A store that was opened and not written to yet.
#[derive(Debug)]
pub struct Store {
    disk: Arc<dyn Disk>,
    identity: Identity,
    options: StoreOptions,
    /// Names and bytes of the segments, by number and epoch.
    segments: BTreeMap<(u32, u64), u64>,
    last_epoch: Option<u64>,
    restored: Restored,
}

/// What came back from a store.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
#[non_exhaustive]
pub struct Restored {
    /// Packages, and tiles of present states, that were read.
    pub packages: u64,
    /// Of these: merged. The others wait for packages that are gone, say what is known already, or have no room; the robot's counters tell.
    pub merged: u64,
    /// Records that are whole and cannot be used: of another version of the packages.
    pub unreadable: u64,
    /// Bytes between sound records that are none: damage on the disk.
    pub skipped_bytes: u64,
    /// Bytes behind the last sound record of a segment, cut off: what was being written when a run ended.
    pub torn_bytes: u64,
    /// Segments whose header is damaged, or that could not be read to their end.
    pub damaged_segments: u64,
}

impl Store {
    /// Looks at what is in a folder. Nothing of it is given out yet.
    ///
    /// # Errors
    /// [`StoreError`]: the folder cannot be read, or is not one of this robot.
    pub fn open(disk: Arc<dyn Disk>, identity: Identity, options: StoreOptions) -> Result<Self, StoreError> {
        if options.bytes_max < BYTES_MAX_MIN {
            return Err(StoreError::BytesMax { got: options.bytes_max });
        }
        let mut store = Self {
            disk,
            identity,
            options,
            segments: BTreeMap::new(),
            last_epoch: None,
            restored: Restored::default(),
        };
        for name in store.disk.names().map_err(disk_error("list the folder"))? {
            let fail = |what: &str| disk_error(format!("{what} {name}"));
            if name.ends_with(compaction::UNFINISHED) {
                store.disk.remove(&name).map_err(fail("remove"))?;
            } else if let Some((number, epoch)) = parse_name(&name) {
                store.last_epoch = store.last_epoch.max(Some(epoch));
                store.segments.insert((number, epoch), store.disk.length(&name).map_err(fail("look at"))?);
            }
        }
        store.check_headers()?;
        Ok(store)
    }

    /// Sees that all segments are of this robot, and forgets those that a later one replaces.
    fn check_headers(&mut self) -> Result<(), StoreError> {
        let mut replaced = 0;
        for &(number, epoch) in self.segments.keys() {
            let name = record::segment_name(number, epoch);
            let Ok((header, _)) = self.disk.read(&name).and_then(Scan::open) else { continue };
            match header {
                Ok(header) if header.identity != self.identity => {
                    return Err(StoreError::Foreign { name, got: header.identity, own: self.identity });
                }
                Ok(header) => {
                    self.last_epoch = self.last_epoch.max(Some(header.epoch));
                    if header.is_compacted {
                        replaced = replaced.max(number);
                    }
                }
                Err(NoHeader::Version(got)) => return Err(StoreError::Version { name, got }),
                // Counted when it is read.
                Err(NoHeader::Torn | NoHeader::Damaged) => {}
            }
        }
        // A crash came between the compaction and this.
        while let Some(entry) = self.segments.first_entry().filter(|entry| entry.key().0 < replaced) {
            let name = record::segment_name(entry.key().0, entry.key().1);
            self.disk.remove(&name).map_err(disk_error(format!("remove {name}")))?;
            entry.remove();
        }
        Ok(())
    }

    /// The highest epoch of this robot that is known to have been used.
    pub const fn last_epoch(&self) -> Option<u64> {
        self.last_epoch
    }

    /// The epoch for this run: `wanted`, or more if need be, so that it is higher than all before. (The last of 2³² would be used again.)
    pub fn next_epoch(&self, wanted: u64) -> u64 {
        self.last_epoch.map_or(wanted, |last| wanted.max(last.saturating_add(1)))
    }

    /// Gives the robot, which must be new, what the store has, in its order, and cuts off what a crash left half written. What is damaged or gone is
    /// left out: the robot asks the others for it, and what builds on it waits. The events of the robot up to now are taken from it.
    pub fn restore(&mut self, robot: &mut Robot, now: Stamp) -> Restored {
        let names: Vec<(u32, u64)> = self.segments.keys().copied().collect();
        for (number, epoch) in names {
            let name = record::segment_name(number, epoch);
            let Some(length) = self.restore_segment(&name, robot, now) else {
                self.restored.damaged_segments += 1;
                continue;
            };
            if let Some(bytes) = self.segments.get_mut(&(number, epoch)) {
                *bytes = length;
            }
        }
        self.segments.retain(|_, bytes| *bytes > 0);
        self.restored
    }

    /// The bytes that the segment has from now on; 0: it is gone; `None` if it is damaged so that not all of it could be read.
    fn restore_segment(&mut self, name: &str, robot: &mut Robot, now: Stamp) -> Option<u64> {
        let (header, mut scan) = self.disk.read(name).and_then(Scan::open).ok()?;
        match header {
            Ok(_) => {}
            Err(NoHeader::Torn) => {
                self.restored.torn_bytes += self.disk.length(name).unwrap_or(0);
                // If it stays, it is found again next time.
                return self.disk.remove(name).is_ok().then_some(0);
            }
            Err(_) => return None,
        }
        while let Some(record) = scan.next() {
            match record {
                Ok(Record::Package(package)) => {
                    self.restored.packages += 1;
                    // What has no room is counted by the session.
                    let _ = robot.restore(now, package);
                }
                Ok(Record::Held { stream, upto, intervals }) => {
                    robot.restore_held(stream, upto, &intervals);
                }
                Err(_) => self.restored.unreadable += 1,
            }
            while let Some(event) = robot.poll_event() {
                self.restored.merged += u64::from(matches!(event, Event::Merged { .. }));
            }
        }
        self.restored.skipped_bytes += scan.skipped;
        if scan.error.is_some() {
            return None;
        }
        let (end, torn) = scan.tail();
        self.restored.torn_bytes += torn;
        // Nothing is ever written behind it, so that it may stay if it must.
        let is_cut = torn > 0 && self.disk.cut(name, end).is_ok();
        Some(if is_cut { end } else { end + torn })
    }
}
