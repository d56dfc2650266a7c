//! A segment that says in few bytes what all before it say: the snapshot of each stream. Made from copies
//! that the robot gives stream by stream, so that it can be coded and written on another thread.

use std::fmt;
use std::io::ErrorKind;
use std::sync::Arc;

use flockmap::codec::Encoder;
use flockmap::{Robot, Stream};

use crate::log::create;
use crate::record::Record;
use crate::segment::{HEADERS_BYTES, SegmentHeader};
use crate::stream_copy::{Coded, StreamCopy};
use crate::{Disk, DiskFile};

/// What the name of a compacted segment ends with until it is complete.
pub(crate) const UNFINISHED: &str = ".unfinished";

/// Records are handed to the system in portions of about so many bytes.
const PORTION_BYTES: usize = 64 << 10;

/// A compacted segment that is being written. Dropped before its end, it leaves a file behind that the next
/// start removes.
pub struct Compaction {
    disk: Arc<dyn Disk>,
    header: SegmentHeader,
    name: String,
    /// What is being written, or why it cannot be.
    file: Result<Box<dyn DiskFile>, String>,
    seed: u32,
    bytes: u64,
    bytes_max: u64,
    encoder: Encoder,
    last: Option<Stream>,
}

/// The end of a compaction, for [`StoreLog::end_compaction`](crate::StoreLog::end_compaction).
#[derive(Debug)]
pub struct Compacted {
    pub(crate) header: SegmentHeader,
    /// Its bytes, or why there is none.
    pub(crate) result: Result<u64, String>,
    /// Nothing of it is there but what counts.
    pub(crate) is_gone: bool,
}

impl Compaction {
    /// What goes wrong here and later is reported at its end.
    pub(crate) fn begin(disk: Arc<dyn Disk>, header: SegmentHeader, bytes_max: u64) -> Self {
        let name = header.name() + UNFINISHED;
        let file = create(&*disk, &header, &name)
            .map_err(|error| format!("cannot begin a compacted segment: {error}"));
        Self {
            disk,
            header,
            name,
            file,
            seed: header.seed(),
            bytes: HEADERS_BYTES as u64,
            bytes_max,
            encoder: Encoder::new(),
            last: None,
        }
    }

    /// Copies and writes the next stream of the robot, with no event of the robot left unread. `false`: there
    /// is none any more, or it has failed; then it is to be [finished](Self::finish).
    pub fn step(&mut self, robot: &Robot) -> bool {
        StreamCopy::next(robot, self.last).is_some_and(|copy| self.add(copy))
    }

    /// Writes one stream. `false`: it has failed.
    pub fn add(&mut self, copy: StreamCopy) -> bool {
        self.last = Some(copy.stream());
        if self.file.is_ok()
            && let Err(why) = self.write(copy)
        {
            self.file = Err(why);
        }
        self.file.is_ok()
    }

    fn write(&mut self, copy: StreamCopy) -> Result<(), String> {
        let file = self.file.as_mut().map_err(|why| why.clone())?;
        let mut buffer = Vec::new();
        let Coded { packages, contents } = copy.code(&mut self.encoder)?;
        let packages = packages.into_iter().map(Record::Package);
        let mut records = packages.chain(contents.map(Record::Contents)).peekable();
        while let Some(record) = records.next() {
            record.write(self.seed, &mut buffer);
            if records.peek().is_none() || buffer.len() >= PORTION_BYTES {
                self.bytes += buffer.len() as u64;
                if self.bytes > self.bytes_max {
                    return Err(format!(
                        "the map by itself takes more than {} bytes, and bytes_max leaves it no more (at most 7/16): raise it",
                        self.bytes_max
                    ));
                }
                file.write_all(&buffer).map_err(|error| format!("cannot write: {error}"))?;
                buffer.clear();
            }
        }
        Ok(())
    }

    /// Makes it safe, and gives it its name: from here on it counts, and all before it does not.
    pub fn finish(self) -> Compacted {
        let Self { disk, header, name, file, bytes, .. } = self;
        let finish = |mut file: Box<dyn DiskFile>| {
            file.sync()?;
            drop(file);
            disk.rename(&name, &header.name())?;
            disk.sync_folder()
        };
        let result = file.and_then(|file| {
            finish(file).map_err(|error| format!("cannot finish a compacted segment: {error}"))
        });
        // What is left is removed at the next start, or is whole and counts.
        let remove = |name: &str| {
            disk.remove(name).map_or_else(|error| error.kind() == ErrorKind::NotFound, |()| true)
        };
        let is_gone = result.is_ok() || (remove(&name) & remove(&header.name()));
        Compacted { header, result: result.map(|()| bytes), is_gone }
    }

    /// Takes the file away again.
    pub fn abandon(mut self, why: &str) -> Compacted {
        self.file = Err(why.to_owned());
        self.finish()
    }
}

impl fmt::Debug for Compaction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Compaction").field("name", &self.name).finish_non_exhaustive()
    }
}
