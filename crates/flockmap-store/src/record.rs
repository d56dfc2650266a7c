//! The records of a segment, and how they are found again behind a damaged place (`docs/store.md`).

use std::io::{self, Read};

use crc32fast::Hasher;
use flockmap::sync::RECEIVED_INTERVALS_MAX;
use flockmap::{Package, RobotId, Stream};

use crate::segment::{HEADERS_BYTES, NoHeader, SegmentHeader};

/// Begins each record: found again behind a damaged place.
const SYNC: [u8; 2] = [0xf1, 0x0c];
/// Sync, type, length, check.
pub(crate) const RECORD_OVERHEAD: usize = 9;
/// Content of a record: the longest list of packages. Packages are shorter than datagrams.
pub(crate) const CONTENT_MAX: usize = CONTENTS_BYTES + 8 * RECEIVED_INTERVALS_MAX;
/// Of a record of contents, without its intervals.
const CONTENTS_BYTES: usize = 14;

const PACKAGE: u8 = 1;
const CONTENTS: u8 = 2;

/// What a record says.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) enum Record {
    /// A package, or a chunk of a snapshot, was made or merged.
    Package(Package),
    /// Behind the chunks of a snapshot of a history with gaps.
    Contents(Contents),
}

/// Which packages a snapshot of a history with gaps contains.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Contents {
    /// The stream.
    pub stream: Stream,
    /// The snapshot, as its chunks say.
    pub snapshot_id: u32,
    /// Indices of packages, as closed intervals; at most 1,024 of them.
    pub intervals: Vec<(u32, u32)>,
}

impl Record {
    /// Appends the record to `out`.
    pub(crate) fn write(&self, seed: u32, out: &mut Vec<u8>) {
        match self {
            Self::Package(package) => write_package(package, seed, out),
            Self::Contents(contents) => frame(seed, CONTENTS, &contents.bytes(), out),
        }
    }

    /// Reads what a sound record says; `None` if it is of another version, or of a type that this one does
    /// not know.
    fn read(kind: u8, content: &[u8]) -> Option<Self> {
        match kind {
            PACKAGE => Package::parse(content).ok().map(Self::Package),
            CONTENTS => Contents::read(content).map(Self::Contents),
            _ => None,
        }
    }
}

impl Contents {
    /// The content of its record. Of too many intervals the highest are left out: then they count as missing.
    fn bytes(&self) -> Vec<u8> {
        let Self { stream, snapshot_id, intervals } = self;
        let mut bytes = Vec::with_capacity(CONTENTS_BYTES + 8 * intervals.len());
        bytes.extend_from_slice(&stream.origin.0.to_le_bytes());
        bytes.extend_from_slice(&stream.epoch.to_le_bytes());
        bytes.extend_from_slice(&snapshot_id.to_le_bytes());
        for (low, high) in intervals.iter().take(RECEIVED_INTERVALS_MAX) {
            bytes.extend_from_slice(&low.to_le_bytes());
            bytes.extend_from_slice(&high.to_le_bytes());
        }
        bytes
    }

    fn read(content: &[u8]) -> Option<Self> {
        let (origin, rest) = content.split_first_chunk()?;
        let (epoch, rest) = rest.split_first_chunk()?;
        let (snapshot_id, rest) = rest.split_first_chunk()?;
        let stream =
            Stream { origin: RobotId(u16::from_le_bytes(*origin)), epoch: u64::from_le_bytes(*epoch) };
        let (pairs, rest) = rest.as_chunks::<8>();
        let number = |bytes: &[u8]| bytes.iter().rev().fold(0, |n, byte| n << 8 | u32::from(*byte));
        let intervals = pairs.iter().map(|pair| (number(&pair[..4]), number(&pair[4..]))).collect();
        rest.is_empty().then_some(Self { stream, snapshot_id: u32::from_le_bytes(*snapshot_id), intervals })
    }
}

/// Appends the record of a package to `out`.
pub(crate) fn write_package(package: &Package, seed: u32, out: &mut Vec<u8>) {
    frame(seed, PACKAGE, package.bytes(), out);
}

fn frame(seed: u32, kind: u8, content: &[u8], out: &mut Vec<u8>) {
    debug_assert!(content.len() <= CONTENT_MAX, "a record of {} bytes", content.len());
    let length = (content.len() as u16).to_le_bytes();
    out.extend_from_slice(&SYNC);
    out.push(kind);
    out.extend_from_slice(&length);
    out.extend_from_slice(&check(seed, kind, length, content).to_le_bytes());
    out.extend_from_slice(content);
}

fn check(seed: u32, kind: u8, length: [u8; 2], content: &[u8]) -> u32 {
    let mut hasher = Hasher::new_with_initial(seed);
    hasher.update(&[kind, length[0], length[1]]);
    hasher.update(content);
    hasher.finalize()
}

/// Type and content of the record that `bytes` begin with, if there is a sound one.
fn unframe(seed: u32, bytes: &[u8]) -> Option<(u8, &[u8])> {
    let (head, rest) = bytes.split_first_chunk::<RECORD_OVERHEAD>()?;
    let [a, b, kind, low, high, stated @ ..] = *head;
    let length = usize::from(u16::from_le_bytes([low, high]));
    if [a, b] != SYNC || length > CONTENT_MAX {
        return None;
    }
    let content = rest.get(..length)?;
    (check(seed, kind, [low, high], content) == u32::from_le_bytes(stated)).then_some((kind, content))
}

/// Reads the records of a segment one after the other, and finds the next sound one behind a damaged place.
/// Holds at most 128 KiB.
pub(crate) struct Scan {
    source: Box<dyn Read>,
    seed: u32,
    buffer: Vec<u8>,
    /// Where in the buffer to go on.
    at: usize,
    is_at_end: bool,
    /// Where in the file to go on.
    offset: u64,
    /// End of the last sound record.
    sound_end: u64,
    /// Bytes between sound records that are none.
    pub(crate) skipped: u64,
    /// Why the file could not be read to its end.
    pub(crate) error: Option<io::Error>,
}

const BUFFER_BYTES: usize = 64 << 10;

impl Scan {
    /// The header of a segment, and its records.
    pub(crate) fn open(mut source: Box<dyn Read>) -> io::Result<(Result<SegmentHeader, NoHeader>, Self)> {
        let mut header = Vec::with_capacity(HEADERS_BYTES);
        source.by_ref().take(HEADERS_BYTES as u64).read_to_end(&mut header)?;
        let header = SegmentHeader::read(&header);
        let seed = header.map_or(0, |header| header.seed());
        let offset = HEADERS_BYTES as u64;
        let scan = Self {
            source,
            seed,
            buffer: Vec::new(),
            at: 0,
            is_at_end: false,
            offset,
            sound_end: offset,
            skipped: 0,
            error: None,
        };
        Ok((header, scan))
    }

    /// The next sound record, `Some(None)` if it cannot be used; `None` at the end of the file.
    pub(crate) fn next(&mut self) -> Option<Option<Record>> {
        loop {
            self.fill();
            let rest = self.buffer.get(self.at..).unwrap_or_default();
            if rest.is_empty() {
                return None;
            }
            if let Some((kind, content)) = unframe(self.seed, rest) {
                let length = RECORD_OVERHEAD + content.len();
                let record = Record::read(kind, content);
                self.skipped += self.offset - self.sound_end;
                self.at += length;
                self.offset += length as u64;
                self.sound_end = self.offset;
                return Some(record);
            }
            let next = rest.iter().skip(1).position(|byte| *byte == SYNC[0]);
            let step = next.map_or(rest.len(), |at| at + 1);
            self.at += step;
            self.offset += step as u64;
        }
    }

    /// Where the last sound record ends, and bytes behind it. After the last record.
    pub(crate) const fn tail(&self) -> (u64, u64) {
        (self.sound_end, self.offset - self.sound_end)
    }

    /// Makes sure that a whole record is in the buffer, if the file has so much.
    fn fill(&mut self) {
        if self.is_at_end || self.buffer.len() - self.at >= RECORD_OVERHEAD + CONTENT_MAX {
            return;
        }
        self.buffer.drain(..self.at);
        self.at = 0;
        let missing = BUFFER_BYTES - self.buffer.len();
        match self.source.by_ref().take(missing as u64).read_to_end(&mut self.buffer) {
            Ok(read) => self.is_at_end = read < missing,
            Err(error) => {
                // What was read before it counts.
                self.is_at_end = true;
                self.error = Some(error);
            }
        }
    }
}
