//! A store as a run finds it: whose it is, what is in it, and how the robot gets that back.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use flockmap::{Event, Robot, Stamp};

use crate::compaction::UNFINISHED;
use crate::record::{Contents, Record, Scan};
use crate::segment::{NoHeader, is_of_version_1, parse_name, segment_name};
use crate::store_log::BYTES_MAX_MIN;
use crate::{Disk, Folder, Identity, Notice, Restored, StoreError, StoreLog, StoreOptions};

/// A store that was opened and not written to yet.
#[derive(Debug)]
pub struct Store {
    /// `None`: it has failed already.
    disk: Option<Arc<dyn Disk>>,
    identity: Identity,
    options: StoreOptions,
    /// Bytes of the segments, by number and epoch.
    segments: BTreeMap<(u32, u64), u64>,
    /// Bytes of unfinished segments that the disk does not remove.
    unremoved: u64,
    last_epoch: Option<u64>,
    restored: Restored,
    /// The disk did not give all that it has.
    is_unread: bool,
    notices: Vec<Notice>,
}

impl Store {
    /// Opens the store in a folder, which is made if need be. A disk that fails makes it one that is
    /// [`off`](Self::off).
    ///
    /// # Errors
    /// [`StoreError`], but not [`StoreError::Disk`]: the folder is in use, or is not one of this robot, or an
    /// option cannot work.
    pub fn open_folder(
        path: impl Into<PathBuf>,
        identity: Identity,
        options: StoreOptions,
    ) -> Result<Self, StoreError> {
        match Folder::open(path) {
            Ok(folder) => {
                let warning = folder.warning().map(|text| Notice::Warning(format!("store: {text}")));
                let mut store = Self::open(Arc::new(folder), identity, options)?;
                store.notices.extend(warning);
                Ok(store)
            }
            Err(StoreError::Disk { what, error }) => {
                Ok(Self::off(identity, options, &format!("cannot {what}: {error}")))
            }
            Err(error) => Err(error),
        }
    }

    /// Looks at what is on a disk. Nothing of it is given out yet. A disk that fails makes it one that is
    /// [`off`](Self::off).
    ///
    /// # Errors
    /// [`StoreError`], but not [`StoreError::Disk`]: it is not one of this robot, or an option cannot work.
    pub fn open(disk: Arc<dyn Disk>, identity: Identity, options: StoreOptions) -> Result<Self, StoreError> {
        if options.bytes_max < BYTES_MAX_MIN {
            return Err(StoreError::BytesMax(options.bytes_max));
        }
        let names = match disk.names() {
            Ok(names) => names,
            Err(error) => {
                return Ok(Self::off(identity, options, &format!("cannot list the folder: {error}")));
            }
        };
        let mut store = Self { disk: Some(Arc::clone(&disk)), ..Self::empty(identity, options) };
        for name in names {
            if is_of_version_1(&name) {
                return Err(StoreError::Version { name, got: 1 });
            } else if name.ends_with(UNFINISHED) {
                // If it stays, it is found again next time.
                let bytes = disk.length(&name).unwrap_or(0);
                store.unremoved += if disk.remove(&name).is_ok() { 0 } else { bytes };
            } else if let Some((number, epoch)) = parse_name(&name) {
                store.last_epoch = store.last_epoch.max(Some(epoch));
                // What the disk does not say is known when it is read.
                store.segments.insert((number, epoch), disk.length(&name).unwrap_or(0));
            }
        }
        store.check_headers(&*disk)?;
        Ok(store)
    }

    /// A store without a disk, which gives nothing and takes nothing: the robot flies on in memory, `why` is
    /// said, and it counts as a failure.
    pub fn off(identity: Identity, options: StoreOptions, why: &str) -> Self {
        let notices = vec![Notice::off(why, false)];
        Self { notices, ..Self::empty(identity, options) }
    }

    fn empty(identity: Identity, options: StoreOptions) -> Self {
        Self {
            disk: None,
            identity,
            options,
            segments: BTreeMap::new(),
            unremoved: 0,
            last_epoch: None,
            restored: Restored::default(),
            is_unread: false,
            notices: Vec::new(),
        }
    }

    /// Sees that all segments are of this robot, and forgets those that a later one replaces.
    fn check_headers(&mut self, disk: &dyn Disk) -> Result<(), StoreError> {
        let mut replaced = 0;
        for &(number, epoch) in self.segments.keys() {
            let name = segment_name(number, epoch);
            // What cannot be read is counted when it is tried again.
            let Ok((header, _)) = disk.read(&name).and_then(Scan::open) else { continue };
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
        // A crash came between the compaction and this. One that stays is read, which does no harm.
        self.segments.retain(|&(number, epoch), _| {
            number >= replaced || disk.remove(&segment_name(number, epoch)).is_err()
        });
        Ok(())
    }

    /// The highest epoch of this robot that is known to have been used.
    pub const fn last_epoch(&self) -> Option<u64> {
        self.last_epoch
    }

    /// Gives the robot, which must be new, what the store has, in its order, and cuts off what a crash left
    /// half written. What is damaged or gone is left out: the robot asks the others for it, and what builds
    /// on it waits. The events of the robot up to now are taken from it.
    pub fn restore(&mut self, robot: &mut Robot, now: Stamp) -> Restored {
        let Some(disk) = self.disk.clone() else { return self.restored };
        let keys: Vec<(u32, u64)> = self.segments.keys().copied().collect();
        for key in keys {
            match self.restore_segment(&*disk, &segment_name(key.0, key.1), robot, now) {
                Some(0) => drop(self.segments.remove(&key)),
                Some(length) => drop(self.segments.insert(key, length)),
                None => self.restored.damaged_segments += 1,
            }
        }
        self.restored
    }

    /// The bytes that the segment has from now on; 0: it is gone; `None` if it is damaged so that not all of
    /// it could be read.
    fn restore_segment(&mut self, disk: &dyn Disk, name: &str, robot: &mut Robot, now: Stamp) -> Option<u64> {
        let Ok((header, mut scan)) = disk.read(name).and_then(Scan::open) else {
            self.is_unread = true;
            return None;
        };
        match header {
            Ok(_) => {}
            Err(NoHeader::Torn) => {
                self.restored.torn_bytes += disk.length(name).unwrap_or(0);
                // If it stays, it is found again next time.
                return disk.remove(name).is_ok().then_some(0);
            }
            Err(_) => return None,
        }
        while let Some(record) = scan.next() {
            match record {
                Some(Record::Package(package)) => {
                    self.restored.packages += 1;
                    // What has no room is counted by the session.
                    let _ = robot.restore(now, package);
                }
                Some(Record::Contents(Contents { stream, snapshot_id, intervals })) => {
                    robot.restore_contents(now, stream, snapshot_id, &intervals);
                }
                None => self.restored.unreadable += 1,
            }
            while let Some(event) = robot.poll_event() {
                self.restored.merged += u64::from(matches!(event, Event::Merged { .. }));
            }
        }
        self.restored.skipped_bytes += scan.skipped;
        if scan.error.is_some() {
            self.is_unread = true;
            return None;
        }
        let (end, torn) = scan.tail();
        self.restored.torn_bytes += torn;
        // Nothing is ever written behind it, so that it may stay if it must.
        let is_cut = torn > 0 && disk.cut(name, end).is_ok();
        Some(if is_cut { end } else { end + torn })
    }

    /// Begins the segment of this run, after [`Self::restore`]. When this returns, the epoch is safe on disk:
    /// a later run will not use it. Where the disk refuses, that is reported and counted, and the robot works from
    /// memory until the disk works again.
    ///
    /// # Errors
    /// [`StoreError::Epoch`] if the epoch is not higher than all before.
    pub fn start(self, epoch: u64) -> Result<StoreLog, StoreError> {
        if let Some(last) = self.last_epoch.filter(|last| *last >= epoch) {
            return Err(StoreError::Epoch { got: epoch, last });
        }
        let Self { disk, identity, options, segments, unremoved, restored, is_unread, notices, .. } = self;
        let found = (segments, unremoved, restored);
        let mut store = StoreLog::begin(disk, identity, options, found, epoch, notices);
        if is_unread {
            store.keep_all();
        }
        Ok(store)
    }
}
