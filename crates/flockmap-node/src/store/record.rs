//! The bytes of a segment: its header, its records, and how they are found again (`docs/store.md`).

use std::io::{self, Read};

use crc32fast::Hasher;
use flockmap::codec::PackageError;
use flockmap::{Package, Resolution, RobotId, Stream};

use super::Identity;

const MAGIC: &[u8; 8] = b"FLKSTORE";
/// Goes up with every change of the layout.
pub const STORE_VERSION: u8 = 2;

const HEADER_BYTES: usize = 36;
/// The header stands there twice, so that one spoilt byte does not cost a whole segment.
pub(super) const HEADERS_BYTES: usize = 2 * HEADER_BYTES;
const IS_COMPACTED: u8 = 1;

/// Begins each record: found again behind a damaged place.
const SYNC: [u8; 2] = [0xf1, 0x0c];
/// Sync, type, length, check.
pub(super) const RECORD_OVERHEAD: usize = 9;
/// Content of a record; packages are shorter than datagrams.
pub(super) const CONTENT_MAX: usize = 1_536;
/// Intervals in one record.
pub(super) const INTERVALS_MAX: usize = 180;

const PACKAGE: u8 = 1;
const HELD: u8 = 2;

/// What a segment says about itself.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) struct SegmentHeader {
    pub(super) identity: Identity,
    /// The run that wrote it.
    pub(super) epoch: u64,
    /// Its place among the segments.
    pub(super) number: u32,
    /// It says all that the segments with lower numbers say.
    pub(super) is_compacted: bool,
}

/// Why a segment has no header that can be used.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum NoHeader {
    /// The file ends before it.
    Torn,
    /// Neither of its two copies is sound.
    Damaged,
    /// Sound, and of another version.
    Version(u8),
}

impl SegmentHeader {
    pub(super) fn name(&self) -> String {
        segment_name(self.number, self.epoch)
    }

    pub(super) fn write(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(HEADERS_BYTES);
        bytes.extend_from_slice(MAGIC);
        bytes.push(STORE_VERSION);
        bytes.push(if self.is_compacted { IS_COMPACTED } else { 0 });
        bytes.extend_from_slice(&self.identity.swarm.to_le_bytes());
        bytes.extend_from_slice(&self.identity.robot.0.to_le_bytes());
        bytes.extend_from_slice(&[0; 2]);
        bytes.extend_from_slice(&self.identity.resolution.micrometres().to_le_bytes());
        bytes.extend_from_slice(&self.epoch.to_le_bytes());
        bytes.extend_from_slice(&self.number.to_le_bytes());
        bytes.extend_from_slice(&crc32fast::hash(&bytes).to_le_bytes());
        bytes.repeat(2)
    }

    /// Reads the two copies that a segment begins with.
    pub(super) fn read(bytes: &[u8]) -> Result<Self, NoHeader> {
        let Some(copies) = bytes.get(..HEADERS_BYTES) else { return Err(NoHeader::Torn) };
        let mut why = NoHeader::Damaged;
        for copy in copies.chunks(HEADER_BYTES) {
            match Self::read_copy(copy) {
                Ok(header) => return Ok(header),
                Err(NoHeader::Damaged) => {}
                Err(version) => why = version,
            }
        }
        Err(why)
    }

    fn read_copy(copy: &[u8]) -> Result<Self, NoHeader> {
        let u16_at = |at: usize| u16::from_le_bytes([copy[at], copy[at + 1]]);
        let u32_at = |at: usize| u32::from_le_bytes([copy[at], copy[at + 1], copy[at + 2], copy[at + 3]]);
        if copy[..8] != *MAGIC || u32_at(32) != crc32fast::hash(&copy[..32]) {
            return Err(NoHeader::Damaged);
        }
        if copy[8] != STORE_VERSION {
            return Err(NoHeader::Version(copy[8]));
        }
        let resolution = Resolution::from_micrometres(u32_at(16)).ok_or(NoHeader::Damaged)?;
        Ok(Self {
            identity: Identity { swarm: u16_at(10), robot: RobotId(u16_at(12)), resolution },
            epoch: u64::from(u32_at(24)) << 32 | u64::from(u32_at(20)),
            number: u32_at(28),
            is_compacted: copy[9] & IS_COMPACTED != 0,
        })
    }

    /// Checks of records begin from here: those of another segment are none of this one.
    pub(super) fn seed(&self) -> u32 {
        // Without its own check, behind which every header would have the same one.
        crc32fast::hash(&self.write()[..HEADER_BYTES - 4])
    }
}

/// `NUMBER-EPOCH.log`: the epoch is safe even where the header is spoilt.
pub(super) fn segment_name(number: u32, epoch: u64) -> String {
    format!("{number:08}-{epoch:020}.log")
}

/// Number and epoch of a segment; `None` for all other files.
pub(super) fn parse_name(name: &str) -> Option<(u32, u64)> {
    let (number, epoch) = name.strip_suffix(".log")?.split_once('-')?;
    let (number, epoch) = (number.parse().ok()?, epoch.parse().ok()?);
    (segment_name(number, epoch) == name).then_some((number, epoch))
}

/// What a record says.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(super) enum Record {
    /// A package, or a tile of a present state, was made or merged.
    Package(Package),
    /// The present state just before, up to package `upto`, contains these packages too.
    Held { stream: Stream, upto: u32, intervals: Vec<(u32, u32)> },
}

impl Record {
    /// Appends the record to `out`.
    pub(super) fn write(&self, seed: u32, out: &mut Vec<u8>) {
        match self {
            Self::Package(package) => frame(seed, PACKAGE, package.bytes(), out),
            Self::Held { stream, upto, intervals } => {
                let mut content = Vec::with_capacity(10 + 8 * intervals.len());
                content.extend_from_slice(&stream.origin.0.to_le_bytes());
                content.extend_from_slice(&stream.epoch.to_le_bytes());
                content.extend_from_slice(&upto.to_le_bytes());
                for (low, high) in intervals.iter().take(INTERVALS_MAX) {
                    content.extend_from_slice(&low.to_le_bytes());
                    content.extend_from_slice(&high.to_le_bytes());
                }
                frame(seed, HELD, &content, out);
            }
        }
    }

    /// Reads what a sound record says.
    fn read(kind: u8, content: &[u8]) -> Result<Self, Unreadable> {
        match kind {
            PACKAGE => Package::parse(content).map(Self::Package).map_err(Unreadable::Package),
            HELD => Self::read_held(content).ok_or(Unreadable::Held),
            _ => Err(Unreadable::Kind(kind)),
        }
    }

    fn read_held(content: &[u8]) -> Option<Self> {
        let (origin, rest) = content.split_first_chunk()?;
        let (epoch, rest) = rest.split_first_chunk()?;
        let (upto, rest) = rest.split_first_chunk()?;
        let stream =
            Stream { origin: RobotId(u16::from_le_bytes(*origin)), epoch: u64::from_le_bytes(*epoch) };
        let (pairs, rest) = rest.as_chunks::<8>();
        let number = |bytes: &[u8]| bytes.iter().rev().fold(0, |n, byte| n << 8 | u32::from(*byte));
        let intervals = pairs.iter().map(|pair| (number(&pair[..4]), number(&pair[4..]))).collect();
        rest.is_empty().then_some(Self::Held { stream, upto: u32::from_le_bytes(*upto), intervals })
    }
}

/// A record that is whole and cannot be used.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
pub(super) enum Unreadable {
    #[error("a package of another version, or none: {0}")]
    Package(PackageError),
    #[error("a list of packages held that is none")]
    Held,
    #[error("a record of type {0}, which this version does not know")]
    Kind(u8),
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

/// Reads the records of a segment one after the other, and finds the next sound one behind a damaged place. Holds at most 128 KiB.
pub(super) struct Scan {
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
    pub(super) skipped: u64,
    /// Why the file could not be read to its end.
    pub(super) error: Option<io::Error>,
}

const BUFFER_BYTES: usize = 64 << 10;

impl Scan {
    /// The header of a segment, and its records.
    pub(super) fn open(mut source: Box<dyn Read>) -> io::Result<(Result<SegmentHeader, NoHeader>, Self)> {
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

    /// The next sound record; `None` at the end of the file.
    pub(super) fn next(&mut self) -> Option<Result<Record, Unreadable>> {
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
    pub(super) const fn tail(&self) -> (u64, u64) {
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
