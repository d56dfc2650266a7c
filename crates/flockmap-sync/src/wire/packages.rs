//! PACKAGES datagrams: one or several whole map packages.

use super::datagram::{
    DATAGRAM_BYTES_MAX, Datagram, DatagramError, DatagramHeader, Kind, put_record, record_len, seal,
};
use super::received::{put_list, put_stream, read_intervals, read_stream};
use crate::IntervalSet;
use flockmap_codec::Package;
use flockmap_codec::bytes::{Reader, put_varint};
use flockmap_grid::Stream;

const PACKAGE: u8 = 16;
/// Of the sender's own run: its stream is that of the header.
const OWN_PACKAGE: u8 = 17;

/// What a snapshot of a history with gaps contains.
const CONTENTS: u8 = 18;
/// The sender may send no more before it knows what has arrived.
const WINDOW_FULL: u8 = 19;
/// Bytes of a record of contents at the most: of more intervals the lowest are left out, and come by another
/// state.
pub const CONTENTS_BYTES_MAX: usize = 190;

/// Whether the sender waits for a report of what has arrived.
pub fn asks_for_request(datagram: &Datagram<'_>) -> bool {
    datagram.records().any(|(id, _)| id == WINDOW_FULL)
}

/// What a snapshot contains, where that is not all from the first package on: who has accepted all of them
/// holds these.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Contents {
    /// The stream.
    pub stream: Stream,
    /// Which snapshot of the sender's.
    pub snapshot_id: u32,
    /// The packages.
    pub received: IntervalSet,
}

/// All contents that a datagram states. Lists of more than `intervals_max` intervals keep their newest ones.
pub fn parse_contents(datagram: &Datagram<'_>, intervals_max: usize) -> Result<Vec<Contents>, DatagramError> {
    let read = |bytes| {
        let mut reader = Reader::new(bytes);
        let (stream, snapshot_id) = (read_stream(&mut reader)?, reader.u32()?);
        let (_, received) = read_intervals(&mut reader, intervals_max)?;
        Some(Contents { stream, snapshot_id, received })
    };
    let records = datagram.records().filter(|(id, _)| *id == CONTENTS);
    records.map(|(_, bytes)| read(bytes).ok_or_else(|| datagram.malformed("contents of a state"))).collect()
}

/// All packages of a datagram; records of unknown types are skipped. Holds at most as many bytes as the
/// datagram has.
pub fn parse_packages(datagram: &Datagram<'_>) -> Result<Vec<Package>, DatagramError> {
    let sender = datagram.header().sender.origin;
    datagram
        .records()
        .filter_map(|(id, bytes)| match id {
            PACKAGE => Some(Package::parse(bytes)),
            OWN_PACKAGE => Some(Package::parse_without_stream(datagram.header().sender, bytes)),
            _ => None,
        })
        .map(|package| package.map_err(|error| DatagramError::Package { sender, error }))
        .collect()
}

/// Collects packages into one datagram for as long as they fit.
#[derive(Clone, Debug)]
pub struct PackagesWriter {
    pub(super) sender: Stream,
    pub(super) bytes: Vec<u8>,
    pub(super) bytes_max: usize,
}

impl PackagesWriter {
    /// An empty datagram that never grows beyond `bytes_max` (at most [`DATAGRAM_BYTES_MAX`]).
    pub fn new(header: DatagramHeader, bytes_max: usize) -> Self {
        let header = DatagramHeader { kind: Kind::Packages, ..header };
        Self { sender: header.sender, bytes: header.emit(), bytes_max: bytes_max.min(DATAGRAM_BYTES_MAX) }
    }

    /// Adds a package; `false`, with nothing changed, if it does not fit any more.
    pub fn push(&mut self, package: &Package) -> bool {
        let is_own = package.header().stream == self.sender;
        let [front, back] = if is_own { package.without_stream() } else { [package.bytes(), &[]] };
        let length = front.len() + back.len();
        let fits = self.bytes.len() + record_len(length) <= self.bytes_max;
        if fits {
            self.bytes.push(if is_own { OWN_PACKAGE } else { PACKAGE });
            put_varint(&mut self.bytes, length as u64);
            self.bytes.extend_from_slice(front);
            self.bytes.extend_from_slice(back);
        }
        fits
    }

    /// Asks for a report of what has arrived, if there is room for that.
    pub fn ask_for_request(&mut self) {
        if self.bytes.len() + record_len(0) <= self.bytes_max {
            put_record(&mut self.bytes, WINDOW_FULL, &[]);
        }
    }

    /// Adds what a snapshot contains; `false`, with nothing changed, if it does not fit any more.
    pub fn push_contents(&mut self, contents: &Contents) -> bool {
        let end = self.bytes.len() + CONTENTS_BYTES_MAX;
        let mut content = Vec::new();
        put_stream(&mut content, contents.stream);
        content.extend(contents.snapshot_id.to_le_bytes());
        end <= self.bytes_max && put_list(&mut self.bytes, CONTENTS, &mut content, 1, &contents.received, end)
    }

    /// Bytes of the datagram so far.
    pub fn bytes(&self) -> usize {
        self.bytes.len()
    }

    /// The complete datagram.
    pub fn finish(self) -> Vec<u8> {
        seal(self.bytes)
    }
}
