//! What is in a store, without a robot: for `flockmap info`. Changes nothing, and needs no lock.

use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::path::Path;

use flockmap::Stream;
use flockmap::codec::ContentKind;
use flockmap::sync::IntervalSet;

use crate::folder::names;
use crate::record::{Contents, Record, Scan};
use crate::segment::{Identity, NoHeader, is_of_version_1, parse_name};

/// Intervals reported of one stream; of more, the rest is left out.
const INTERVALS_MAX: usize = 1_024;
/// Streams reported.
const STREAMS_MAX: usize = 4_096;

/// What is in a store.
#[derive(Clone, Debug, Default)]
#[non_exhaustive]
pub struct Inspection {
    /// Whose it is, as the newest sound segment says.
    pub identity: Option<Identity>,
    /// Its segments, oldest first.
    pub segments: Vec<SegmentFacts>,
    /// Its streams; of more than 4,096 the rest is left out.
    pub streams: BTreeMap<Stream, StreamFacts>,
}

/// A segment of a store.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
#[non_exhaustive]
pub struct SegmentFacts {
    /// Its file.
    pub name: String,
    /// Bytes of it.
    pub bytes: u64,
    /// What is wrong with its header, if something is: then nothing of it is used.
    pub fault: Option<String>,
    /// It replaces all segments before it.
    pub is_compacted: bool,
    /// Sound records.
    pub records: u64,
    /// Of these: records that this version cannot use.
    pub unreadable: u64,
    /// Bytes between sound records that are none.
    pub skipped_bytes: u64,
    /// Bytes behind the last sound record: cut off when a robot opens the store.
    pub torn_bytes: u64,
}

/// A stream in a store.
#[derive(Clone, PartialEq, Eq, Debug)]
#[non_exhaustive]
pub struct StreamFacts {
    /// Indices of packages that are in the store, or in one of its snapshots.
    pub received: IntervalSet,
    /// Packages of changes.
    pub packages: u64,
    /// Bytes of these.
    pub package_bytes: u64,
    /// Chunks of snapshots.
    pub chunks: u64,
    /// Bytes of these.
    pub chunk_bytes: u64,
}

/// Snapshots of which chunks were seen.
#[derive(Default)]
struct Snapshots(BTreeMap<(Stream, u32), (IntervalSet, u32)>);

/// Of more snapshots than that, those seen before are taken for incomplete.
const SNAPSHOTS_MAX: usize = 256;

impl Snapshots {
    /// Notes a chunk; whether there are all of its snapshot now.
    fn add(&mut self, stream: Stream, id: u32, chunk: u32, chunks: u32) -> bool {
        if self.0.len() >= SNAPSHOTS_MAX && !self.0.contains_key(&(stream, id)) {
            self.0.clear();
        }
        let nothing = || (IntervalSet::new(INTERVALS_MAX), chunks);
        let (seen, _) = self.0.entry((stream, id)).or_insert_with(nothing);
        // What does not fit into the list is left out.
        let _ = seen.insert(chunk);
        self.is_complete(stream, id)
    }

    fn is_complete(&self, stream: Stream, id: u32) -> bool {
        let chunks_of = self.0.get(&(stream, id));
        chunks_of.is_some_and(|(seen, chunks)| *chunks > 0 && seen.contains_range(0, *chunks - 1))
    }
}

/// Whether a folder holds segments of a store.
pub fn is_store(folder: &Path) -> bool {
    names(folder)
        .is_ok_and(|names| names.iter().any(|name| parse_name(name).is_some() || is_of_version_1(name)))
}

/// Reads all of a store.
///
/// # Errors
/// The folder cannot be listed, or a file in it not be opened.
pub fn inspect(folder: &Path) -> io::Result<Inspection> {
    let mut inspection = Inspection::default();
    let (mut segments, mut old) = (Vec::new(), Vec::new());
    for name in names(folder)? {
        match parse_name(&name) {
            Some(key) => segments.push((key, name)),
            None if is_of_version_1(&name) => old.push(name),
            None => {}
        }
    }
    old.sort();
    segments.sort();
    for name in old {
        let bytes = std::fs::metadata(folder.join(&name))?.len();
        let fault = Some(NoHeader::Version(1).to_string());
        inspection.segments.push(SegmentFacts { name, bytes, fault, ..SegmentFacts::default() });
    }
    let mut snapshots = Snapshots::default();
    for (_, name) in segments {
        inspection.add_segment(&folder.join(&name), name, &mut snapshots)?;
    }
    Ok(inspection)
}

impl Inspection {
    fn add_segment(&mut self, path: &Path, name: String, snapshots: &mut Snapshots) -> io::Result<()> {
        let bytes = std::fs::metadata(path)?.len();
        let (header, mut scan) = Scan::open(Box::new(File::open(path)?))?;
        let mut facts = SegmentFacts { name, bytes, ..SegmentFacts::default() };
        match header {
            Ok(header) => {
                self.identity = Some(header.identity);
                facts.is_compacted = header.is_compacted;
                if header.is_compacted {
                    self.streams.clear();
                    *snapshots = Snapshots::default();
                }
                while let Some(record) = scan.next() {
                    facts.records += 1;
                    match record {
                        Some(record) => self.add_record(&record, snapshots),
                        None => facts.unreadable += 1,
                    }
                }
                facts.skipped_bytes = scan.skipped;
                facts.torn_bytes = scan.tail().1;
                facts.fault = scan.error.map(|error| format!("cannot be read to its end: {error}"));
            }
            Err(fault) => {
                facts.torn_bytes = if fault == NoHeader::Torn { bytes } else { 0 };
                facts.fault = Some(fault.to_string());
            }
        }
        self.segments.push(facts);
        Ok(())
    }

    fn add_record(&mut self, record: &Record, snapshots: &mut Snapshots) {
        let stream = match record {
            Record::Package(package) => package.header().stream,
            Record::Contents(contents) => contents.stream,
        };
        if self.streams.len() >= STREAMS_MAX && !self.streams.contains_key(&stream) {
            return;
        }
        let facts = self.streams.entry(stream).or_insert_with(|| StreamFacts {
            received: IntervalSet::new(INTERVALS_MAX),
            packages: 0,
            package_bytes: 0,
            chunks: 0,
            chunk_bytes: 0,
        });
        // What does not fit into the list is left out.
        match record {
            Record::Package(package) => {
                let (header, bytes) = (package.header(), package.bytes().len() as u64);
                match header.content {
                    ContentKind::Changes => {
                        facts.packages += 1;
                        facts.package_bytes += bytes;
                        let _ = facts.received.insert(header.index);
                    }
                    ContentKind::Snapshot { id, chunk, chunks, since } => {
                        facts.chunks += 1;
                        facts.chunk_bytes += bytes;
                        let is_known = since == 0 || facts.received.contains_range(1, since);
                        if snapshots.add(stream, id, chunk, chunks) && is_known {
                            let _ = facts.received.insert_range(1, header.index);
                        }
                    }
                }
            }
            Record::Contents(Contents { snapshot_id, intervals, .. }) => {
                if snapshots.is_complete(stream, *snapshot_id) {
                    for &(low, high) in intervals {
                        let _ = facts.received.insert_range(low, high);
                    }
                }
            }
        }
    }
}
