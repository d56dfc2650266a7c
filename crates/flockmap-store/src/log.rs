//! The log that grows: the segment of this run, and the bytes of those before.

use std::collections::BTreeMap;
use std::io;
use std::sync::Arc;

use crate::segment::{HEADERS_BYTES, Identity, SegmentHeader, segment_name};
use crate::{Disk, DiskFile};

#[derive(Debug)]
pub(crate) struct Log {
    disk: Arc<dyn Disk>,
    shares: Shares,
    /// While a compaction runs: bytes that it leaves to the segments.
    limit: Option<u64>,
    segments: BTreeMap<(u32, u64), u64>,
    /// The segment that is written.
    header: SegmentHeader,
    file: Box<dyn DiskFile>,
    buffer: Vec<u8>,
    is_synced: bool,
}

/// What there is of a log that has failed, for one that goes on behind it.
#[derive(Debug)]
pub(crate) struct Failed {
    disk: Arc<dyn Disk>,
    shares: Shares,
    segments: BTreeMap<(u32, u64), u64>,
    /// Of the last segment that there may be.
    header: SegmentHeader,
}

/// Why the log cannot go on.
#[derive(Debug, thiserror::Error)]
pub(crate) enum LogError {
    #[error("cannot {what}: {error}")]
    Disk { what: &'static str, error: io::Error },
    #[error("the log has taken its share of bytes_max ({0}): raise it, or empty the folder")]
    Full(u64),
}

/// How `bytes_max` is shared out, so that there is always room for the snapshots that replace the log.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Shares {
    /// All that there is.
    pub(crate) all: u64,
}

impl Shares {
    /// From here on the log is to be made shorter.
    pub(crate) const fn due(self) -> u64 {
        self.all / 2
    }

    /// What it has to grow by until that is tried again where it failed.
    pub(crate) const fn pause(self) -> u64 {
        self.all / 64
    }

    /// What the snapshots may take beside a log of so many bytes.
    pub(crate) fn snapshot(self, log: u64) -> u64 {
        (self.all / 16 * 7).min(self.all.saturating_sub(log.saturating_add(self.reserve())))
    }

    /// All segments.
    const fn log(self) -> u64 {
        self.all - self.all / 16 * 7
    }

    /// Of these, what packages leave free: for what comes during a compaction, and for the headers of runs
    /// that begin.
    const fn reserve(self) -> u64 {
        self.all / 32
    }
}

fn cannot(what: &'static str) -> impl FnOnce(io::Error) -> LogError {
    move |error| LogError::Disk { what, error }
}

/// A new segment with its header, safe on disk: its epoch will not be used again.
pub(crate) fn create(disk: &dyn Disk, header: &SegmentHeader, name: &str) -> io::Result<Box<dyn DiskFile>> {
    let mut file = disk.create(name)?;
    file.write_all(&header.write())?;
    file.sync()?;
    disk.sync_folder()?;
    Ok(file)
}

fn begin_segment(
    disk: &dyn Disk,
    header: &SegmentHeader,
    segments: &mut BTreeMap<(u32, u64), u64>,
) -> Result<Box<dyn DiskFile>, LogError> {
    let file = create(disk, header, &header.name()).map_err(cannot("begin a segment"))?;
    segments.insert((header.number, header.epoch), HEADERS_BYTES as u64);
    Ok(file)
}

impl Failed {
    /// Of a run that could not begin its first segment.
    pub(crate) fn at_start(
        disk: Arc<dyn Disk>,
        identity: Identity,
        epoch: u64,
        shares: Shares,
        segments: BTreeMap<(u32, u64), u64>,
    ) -> Self {
        let number = last_number(&segments).saturating_add(1);
        let header = SegmentHeader { identity, epoch, number, is_compacted: false };
        Self { disk, shares, segments, header }
    }

    /// Bytes of all segments.
    pub(crate) fn bytes(&self) -> u64 {
        self.segments.values().sum()
    }

    /// Another run has begun.
    pub(crate) fn note_epoch(&mut self, epoch: u64) {
        self.header.epoch = self.header.epoch.max(epoch);
    }

    /// A compacted segment is complete under its name, and no log was there to take note of it.
    pub(crate) fn note_compacted(&mut self, compacted: &SegmentHeader, bytes: u64) {
        self.segments.insert((compacted.number, compacted.epoch), bytes);
    }

    /// Goes on in a new segment, and leaves a number free before it: as [`Log::roll`], but what failed is not counted on.
    pub(crate) fn go_on(mut self, snapshot: u64) -> Result<(Log, SegmentHeader), (Self, LogError)> {
        let number = self.header.number.saturating_add(1);
        let compacted = SegmentHeader { number, is_compacted: true, ..self.header };
        self.header.number = number.saturating_add(1);
        match begin_segment(&*self.disk, &self.header, &mut self.segments) {
            Ok(file) => {
                let Self { disk, shares, segments, header } = self;
                let (limit, buffer, is_synced) = (Some(shares.all - snapshot), Vec::new(), true);
                Ok((Log { disk, shares, limit, segments, header, file, buffer, is_synced }, compacted))
            }
            Err(error) => {
                // What is left of it is seen at the next start.
                let _ = self.disk.remove(&self.header.name());
                Err((self, error))
            }
        }
    }
}

fn last_number(segments: &BTreeMap<(u32, u64), u64>) -> u32 {
    segments.keys().next_back().map_or(0, |(number, _)| *number)
}

impl Log {
    /// Begins the first segment of a run.
    pub(crate) fn begin(
        disk: Arc<dyn Disk>,
        identity: Identity,
        epoch: u64,
        shares: Shares,
        mut segments: BTreeMap<(u32, u64), u64>,
    ) -> Result<Self, LogError> {
        // It may go beyond the share of the log: where that was larger once, it can be made shorter now.
        if segments.values().sum::<u64>() + HEADERS_BYTES as u64 > shares.all {
            return Err(LogError::Full(shares.all));
        }
        let number = last_number(&segments).saturating_add(1);
        let header = SegmentHeader { identity, epoch, number, is_compacted: false };
        let file = begin_segment(&*disk, &header, &mut segments)?;
        let (limit, buffer, is_synced) = (None, Vec::new(), true);
        Ok(Self { disk, shares, limit, segments, header, file, buffer, is_synced })
    }

    /// It has failed.
    pub(crate) fn fail(self) -> Failed {
        let Self { disk, shares, segments, mut header, .. } = self;
        // One that it was about to begin, behind a compacted one, may be there.
        header.number = header.number.saturating_add(2);
        Failed { disk, shares, segments, header }
    }

    /// Bytes of all segments.
    pub(crate) fn bytes(&self) -> u64 {
        self.segments.values().sum()
    }

    pub(crate) fn segments(&self) -> usize {
        self.segments.len()
    }

    /// Hands records to the system, which are written behind each other with the seed that is given. Returns
    /// their bytes.
    pub(crate) fn append(&mut self, write: impl FnOnce(u32, &mut Vec<u8>)) -> Result<u64, LogError> {
        self.buffer.clear();
        write(self.header.seed(), &mut self.buffer);
        let bytes = self.buffer.len() as u64;
        let limit = self.limit.unwrap_or_else(|| self.shares.log() - self.shares.reserve());
        if self.bytes() + bytes > limit {
            return Err(LogError::Full(self.shares.all));
        }
        self.is_synced = false;
        self.file.write_all(&self.buffer).map_err(cannot("write"))?;
        *self.segments.entry((self.header.number, self.header.epoch)).or_default() += bytes;
        Ok(bytes)
    }

    /// Returns when all that was written is on the disk, and whether it was not before.
    pub(crate) fn sync(&mut self) -> Result<bool, LogError> {
        if !self.is_synced {
            self.file.sync().map_err(cannot("sync"))?;
        }
        Ok(!std::mem::replace(&mut self.is_synced, true))
    }

    /// Goes on in a new segment, and leaves a number free before it: for the segment that is to replace all
    /// before. That may take so many bytes, until [`Self::end_snapshot`].
    pub(crate) fn roll(&mut self, snapshot: u64) -> Result<SegmentHeader, LogError> {
        self.limit = Some(self.shares.all - snapshot);
        let number = self.header.number.saturating_add(1);
        let compacted = SegmentHeader { number, is_compacted: true, ..self.header };
        self.go_on_in(SegmentHeader { number: number.saturating_add(1), ..self.header })?;
        Ok(compacted)
    }

    /// Goes on in a new segment, under a higher epoch. One that is not higher changes nothing.
    pub(crate) fn begin_epoch(&mut self, epoch: u64) -> Result<(), LogError> {
        if epoch <= self.header.epoch {
            return Ok(());
        }
        let number = self.header.number.saturating_add(1);
        self.go_on_in(SegmentHeader { epoch, number, ..self.header })
    }

    fn go_on_in(&mut self, header: SegmentHeader) -> Result<(), LogError> {
        self.sync()?;
        if self.bytes() + HEADERS_BYTES as u64 > self.limit.unwrap_or_else(|| self.shares.log()) {
            return Err(LogError::Full(self.shares.all));
        }
        self.file = begin_segment(&*self.disk, &header, &mut self.segments)?;
        self.header = header;
        Ok(())
    }

    /// No compaction runs any more.
    pub(crate) const fn end_snapshot(&mut self) {
        self.limit = None;
    }

    /// A compacted segment is complete under its name: those before it go.
    pub(crate) fn replace(&mut self, compacted: &SegmentHeader, bytes: u64) -> Result<(), LogError> {
        while let Some(entry) = self.segments.first_entry().filter(|e| e.key().0 < compacted.number) {
            let (number, epoch) = *entry.key();
            self.disk.remove(&segment_name(number, epoch)).map_err(cannot("remove a segment"))?;
            entry.remove();
        }
        self.segments.insert((compacted.number, compacted.epoch), bytes);
        self.disk.sync_folder().map_err(cannot("sync the folder"))
    }
}
