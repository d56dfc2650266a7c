//! The frame of every datagram: header, records, check; and what can be wrong with one.

use flockmap_codec::PackageError;
use flockmap_codec::bytes::{Reader, put_varint, varint_len};
use flockmap_grid::{RobotId, Stamp, Stream};

/// No datagram is longer: UDP payload in bytes. Longer ones are refused unread.
pub const DATAGRAM_BYTES_MAX: usize = 1_200;

/// The version of the layout. Any change of the layout of what stands in `WIRE.md` is a change of this.
pub const WIRE_VERSION: u8 = 7;

/// Bytes of the header of a datagram that is not sealed.
pub const HEADER_BYTES: usize = 28;

pub(super) const MAGIC: [u8; 2] = *b"FM";
/// The check covers everything but itself.
pub(super) const CHECK: core::ops::Range<usize> = 24..28;

/// The layout that [`WIRE_VERSION`] stands for, in text. A test holds its hash: who changes a line here must
/// change the version too. (A new type of record, which older readers skip, is no change of a line.)
pub const LAYOUT: &str = "\
header: magic 2 'FM', version u8, kind u8, swarm u16, sender u16, epoch u64, stamp i64, crc32 u32 of all else
sealed: 128 more in the kind, 64 more where it is for one robot; magic, version, kind, swarm, sender, epoch as above, counter u48, \
in kinds 1 and 3 salt 16; sealed with the swarm key: stamp i64, what follows the header; tag 16. \
XChaCha20-Poly1305, nonce: salt, recipient u16 or 0, counter with its highest bit set for one robot; associated data: all before what is sealed
kind 1 request: flags u8 (1 all origins, 2 all echoes, 4 no new streams, 8 short), records
kind 2 packages: records
kind 3 path: records
record: type u8, length varint, content
type 1 echoes: (robot u16, epoch low u16, stamp low u32, age varint)*
type 2 received: origin varint, epoch varint, intervals
type 7 received, earlier runs not wanted: as type 2
type 3 transfer: source varint, origin varint, epoch varint, since varint, upto varint, snapshot id u32, chunks varint, intervals of accepted chunk + 1
type 4 origins: first origin varint, last origin varint
type 5 clocks: (robot varint, epoch low u16, offset zigzag)*
type 6 snapshot request: origin varint, epoch varint, since varint, intervals of undecodable indices
type 8 received, something is lacking: origin varint, epoch varint, flags u8 (1 as type 7, 2 independent packages wanted, 4 rest wanted, 8 some of it is there), \
holder varint and upto varint if the rest is wanted, since varint if some of it is there, intervals
type 10 received of newest runs: crc32 u32 of (origin u16, epoch u64)*, (origin - origin before - 1 zigzag, from 0 on, \
2 newest index varint or 2 intervals + 1 varint and as many of (gap varint, length - 1 varint))*
type 11 heard: crc32 u32 of (robot u16, epoch u64)*, (gap varint, robots - 1 varint)*
type 9 the sender will be heard again: within milliseconds varint
type 16 package: map package
type 17 package of the sender's own run: map package without origin and epoch
type 18 contents of a partial snapshot: origin varint, epoch varint, snapshot id u32, intervals
type 19 the sender may send no more before it knows what has arrived: nothing
type 20 repair symbols: origin varint, epoch varint, first index varint, packages u8, \
u8 (symbol bytes / 16 - 1, 16 for each bit b of a number), fewest source symbols of a package u8, \
source symbols of each package - fewest (b bits each, lowest first, zeros to a whole byte), crc32 u32 of the source symbols, \
number of the first varint (below 2^21), symbols
type 21 repair symbols of the sender's own run: as type 20 without origin and epoch
source symbols: for each package bytes of padding u8, map package without origin and epoch, zeros; \
repair symbol r: encoding symbol K + r of RFC 6330, of one source block with K source symbols
type 32 challenge: number u64
type 33 answer: number u64
intervals: from varint, (gap - to from, then to end + 2 - varint, length - 1 varint)*
integers little-endian, varints shortest LEB128";

/// What a datagram carries.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Kind {
    /// What the sender holds and whom it hears: the paper's request.
    Request,
    /// Map packages: the paper's response, or a push of new ones.
    Packages,
    /// Whether a robot is to be reached at an address: a challenge, or the answer to one.
    Path,
}

impl Kind {
    pub(super) const fn id(self) -> u8 {
        match self {
            Self::Request => 1,
            Self::Packages => 2,
            Self::Path => 3,
        }
    }

    pub(super) const fn from_id(id: u8) -> Option<Self> {
        match id {
            1 => Some(Self::Request),
            2 => Some(Self::Packages),
            3 => Some(Self::Path),
            _ => None,
        }
    }
}

/// The header of every datagram.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct DatagramHeader {
    /// What follows.
    pub kind: Kind,
    /// Robots of different swarms ignore each other.
    pub swarm: u16,
    /// The robot that sent this datagram, and its run.
    pub sender: Stream,
    /// When it was sent, on the sender's clock.
    pub stamp: Stamp,
}

impl DatagramHeader {
    /// Writes the header, with the check still zero. [`seal`] completes it.
    pub(super) fn emit(&self) -> Vec<u8> {
        let mut out = Vec::with_capacity(DATAGRAM_BYTES_MAX);
        out.extend(MAGIC);
        out.push(WIRE_VERSION);
        out.push(self.kind.id());
        out.extend(self.swarm.to_le_bytes());
        out.extend(self.sender.origin.0.to_le_bytes());
        out.extend(self.sender.epoch.to_le_bytes());
        out.extend(self.stamp.0.to_le_bytes());
        out.extend([0; 4]);
        out
    }
}

/// Why a received datagram was refused. It is the sender's or the radio's fault, never the user's.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum DatagramError {
    /// Shorter than a header, or longer than any datagram may be.
    #[error("a datagram of {got} bytes; {HEADER_BYTES} to {DATAGRAM_BYTES_MAX} expected")]
    Length {
        /// Bytes received.
        got: usize,
    },
    /// Not from Flockmap at all.
    #[error("not a Flockmap datagram: it starts with {got:02x?}, `FM` expected")]
    Magic {
        /// The first two bytes.
        got: [u8; 2],
    },
    /// From another version of Flockmap.
    #[error("datagram of wire version {got}, {WIRE_VERSION} expected: run the same version on all robots")]
    Version {
        /// The version it states.
        got: u8,
    },
    /// Damaged in flight.
    #[error("damaged datagram: its check is {got:#010x}, its bytes give {expected:#010x}")]
    Check {
        /// The check it states.
        got: u32,
        /// The check of its bytes.
        expected: u32,
    },
    /// Sealed with another key than the own one, or damaged, or made up: nothing of it can be believed.
    #[error(
        "sealed datagram of {sender:?} that the own key does not open: damaged, forged, or of a robot with another key; \
         give all robots of the swarm the same swarm_key"
    )]
    Forged {
        /// Who sent it, as it states.
        sender: RobotId,
    },
    /// A genuine datagram that was there already, or one that so many later ones overtook that nobody can know.
    #[error(
        "datagram {counter} of {sender:?} came again, or thousands late: the radio doubles, or somebody replays it"
    )]
    Replayed {
        /// Who sent it.
        sender: RobotId,
        /// Its number.
        counter: u64,
    },
    /// Sealed by a run of which no request was heard yet: only these have the salt with which it seals.
    #[error(
        "sealed datagram of {sender:?} before a request of its run: its next request says how to open it"
    )]
    UnknownRun {
        /// Who sent it, as it states.
        sender: RobotId,
    },
    /// Not sealed, and this robot has a key.
    #[error(
        "datagram that is not sealed, stating to be of {sender:?}: this robot has a swarm_key; give it to that robot too, or to none"
    )]
    Unsealed {
        /// Who sent it, as it states.
        sender: RobotId,
    },
    /// Sealed, and this robot has no key.
    #[error(
        "sealed datagram of {sender:?}: that robot has a swarm_key; give it to this robot too, or to none"
    )]
    SealedWithoutKey {
        /// Who sent it, as it states.
        sender: RobotId,
    },
    /// Of a kind that this version does not know.
    #[error("unknown kind of datagram {got}, 1 to 3, sealed with 128 or 192 more, expected")]
    Kind {
        /// The kind it states.
        got: u8,
    },
    /// From another swarm in reach.
    #[error("datagram of swarm {got}, {expected} expected")]
    Swarm {
        /// The swarm it states.
        got: u16,
        /// The own swarm.
        expected: u16,
    },
    /// Its check is right but its content is not: the sender is faulty.
    #[error("malformed {what} in a datagram of {sender:?}")]
    Malformed {
        /// Who sent it.
        sender: RobotId,
        /// The part that is wrong.
        what: &'static str,
    },
    /// A map package in it cannot be read.
    #[error("unreadable map package in a datagram of {sender:?}: {error}")]
    Package {
        /// Who sent it.
        sender: RobotId,
        /// What is wrong with the package.
        error: PackageError,
    },
    /// From a former run of the sender, superseded by its present one.
    #[error("datagram of epoch {got} of {sender:?}, which now runs epoch {current}")]
    StaleEpoch {
        /// Who sent it.
        sender: RobotId,
        /// The epoch it states.
        got: u64,
        /// The epoch heard since.
        current: u64,
    },
    /// From a robot that bears the own id but is another run: two robots have the same id.
    #[error("another robot uses the own id {id}: give every robot of a swarm its own id")]
    SameIdentity {
        /// The id used twice.
        id: RobotId,
    },
    /// There are already as many peers as may be.
    #[error("{sender:?} is one peer more than the {peers_max} that fit")]
    TooManyPeers {
        /// Who sent it.
        sender: RobotId,
        /// The bound.
        peers_max: usize,
    },
}

/// A received datagram whose length, magic, version, kind and check are right and whose records fill its body.
#[derive(Clone, Copy, Debug)]
pub struct Datagram<'a> {
    header: DatagramHeader,
    pub(super) flags: u8,
    records: &'a [u8],
}

impl<'a> Datagram<'a> {
    /// Checks the bytes. Allocates nothing.
    pub fn new_checked(bytes: &'a [u8]) -> Result<Self, DatagramError> {
        if !(HEADER_BYTES..=DATAGRAM_BYTES_MAX).contains(&bytes.len()) {
            return Err(DatagramError::Length { got: bytes.len() });
        }
        let too_short = DatagramError::Length { got: bytes.len() };
        let kind = check_version(bytes)?;
        let mut reader = Reader::new(&bytes[4..]);
        let ((swarm, sender), stamp, got) =
            (|| Some((head(&mut reader)?, reader.i64()?, reader.u32()?)))().ok_or(too_short)?;
        let expected = check_of(bytes);
        if got != expected {
            return Err(DatagramError::Check { got, expected });
        }
        let kind = Kind::from_id(kind).ok_or(DatagramError::Kind { got: kind })?;
        Self::with_body(kind, swarm, sender, stamp, &bytes[HEADER_BYTES..])
    }

    /// A datagram of which everything but what follows the header is checked.
    pub(super) fn with_body(
        kind: Kind,
        swarm: u16,
        sender: Stream,
        stamp: i64,
        body: &'a [u8],
    ) -> Result<Self, DatagramError> {
        let malformed = |what| DatagramError::Malformed { sender: sender.origin, what };
        let flags = match kind {
            Kind::Request => *body.first().ok_or_else(|| malformed("flags"))?,
            Kind::Packages | Kind::Path => 0,
        };
        let records = &body[usize::from(kind == Kind::Request)..];
        let mut rest = Reader::new(records);
        while !rest.is_empty() {
            next_record(&mut rest).ok_or_else(|| malformed("record"))?;
        }
        Ok(Self { header: DatagramHeader { kind, swarm, sender, stamp: Stamp(stamp) }, flags, records })
    }

    /// The header.
    pub const fn header(&self) -> &DatagramHeader {
        &self.header
    }

    /// Type and content of each record.
    pub(super) fn records(&self) -> impl Iterator<Item = (u8, &'a [u8])> + use<'a> {
        let mut rest = Reader::new(self.records);
        core::iter::from_fn(move || next_record(&mut rest))
    }

    pub(super) fn malformed(&self, what: &'static str) -> DatagramError {
        DatagramError::Malformed { sender: self.header.sender.origin, what }
    }
}

/// Checks magic and version of a datagram; its kind.
pub(super) fn check_version(bytes: &[u8]) -> Result<u8, DatagramError> {
    let [m, n, version, kind, ..] = *bytes else {
        return Err(DatagramError::Length { got: bytes.len() });
    };
    if [m, n] != MAGIC {
        return Err(DatagramError::Magic { got: [m, n] });
    }
    if version != WIRE_VERSION {
        return Err(DatagramError::Version { got: version });
    }
    Ok(kind)
}

/// Swarm and sender, which follow the kind.
pub(super) fn head(reader: &mut Reader<'_>) -> Option<(u16, Stream)> {
    Some((reader.u16()?, Stream { origin: RobotId(reader.u16()?), epoch: reader.u64()? }))
}

pub(super) fn next_record<'a>(reader: &mut Reader<'a>) -> Option<(u8, &'a [u8])> {
    let id = reader.u8()?;
    let length = reader.varint()?.try_into().ok()?;
    Some((id, reader.bytes(length)?))
}

/// Bytes that a record with this much content takes.
pub(super) const fn record_len(content: usize) -> usize {
    1 + varint_len(content as u64) + content
}

pub(super) fn put_record(out: &mut Vec<u8>, id: u8, content: &[u8]) {
    out.push(id);
    put_varint(out, content.len() as u64);
    out.extend(content);
}

pub(super) fn check_of(bytes: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(&bytes[..CHECK.start]);
    hasher.update(&bytes[CHECK.end..]);
    hasher.finalize()
}

/// Writes the check into a complete datagram.
pub(super) fn seal(mut bytes: Vec<u8>) -> Vec<u8> {
    let check = check_of(&bytes);
    bytes[CHECK].copy_from_slice(&check.to_le_bytes());
    bytes
}
