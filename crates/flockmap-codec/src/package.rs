//! An encoded package: bytes that know their header.

use core::fmt;
use core::ops::Range;
use std::sync::Arc;

use crc32fast::Hasher;
use flockmap_grid::{Changes, Snapshot, Stream};

use crate::bytes::{put_varint, varint_len};
use crate::check;
use crate::error::PackageError;
use crate::header::{CHECK_BYTES, Header, STREAM_AT, Tail};

/// An encoded package with its header. Cloning shares the bytes.
#[derive(Clone)]
pub struct Package {
    bytes: Arc<[u8]>,
    header: Header,
    tail: Tail,
}

/// What a package says.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Content {
    /// What changed in one batch; every voxel gets the stamp `batch_end` of the header.
    Changes(Changes),
    /// A chunk of the snapshot, each voxel with its own stamp.
    Snapshot(Snapshot),
}

impl Package {
    /// Takes the bytes of exactly one package, no more and no less: what carries it says where it ends.
    /// Reads its header; the payload is not looked at, and only [`Self::decode`] finds whether the package is
    /// whole. Holds a copy of `bytes` and about 150 bytes more.
    pub fn parse(bytes: &[u8]) -> Result<Self, PackageError> {
        let (header, tail, _) = Header::read(bytes)?;
        Ok(Self { bytes: bytes.into(), header, tail })
    }

    /// The same bytes in two parts without the stream between them, for who knows the stream:
    /// [`Self::parse_without_stream`].
    pub fn without_stream(&self) -> [&[u8]; 2] {
        let Stream { origin, epoch } = self.header.stream;
        let stream_end = STREAM_AT + varint_len(origin.0.into()) + varint_len(epoch);
        let part = |range: Range<usize>| self.bytes.get(range).unwrap_or_default();
        [part(0..STREAM_AT), part(stream_end..self.bytes.len())]
    }

    /// Takes the bytes of exactly one package of this stream, which stands in them no more. Otherwise as
    /// [`Self::parse`].
    pub fn parse_without_stream(stream: Stream, bytes: &[u8]) -> Result<Self, PackageError> {
        let (front, back) = bytes.split_at(bytes.len().min(STREAM_AT));
        let mut whole = Vec::with_capacity(bytes.len() + 13);
        whole.extend_from_slice(front);
        put_varint(&mut whole, stream.origin.0.into());
        put_varint(&mut whole, stream.epoch);
        whole.extend_from_slice(back);
        Self::parse(&whole)
    }

    /// A package of this header and payload, with the check of what the payload decodes to.
    pub(crate) fn seal(header: &Header, payload: &[u8], content: &Hasher) -> Self {
        Self::assemble(header, payload, |header| check::of_package(header, payload, content))
    }

    /// A package of these parts, whatever they are: for tests of what a hostile peer may send.
    pub fn from_parts(header: &Header, payload: &[u8], check: u32) -> Self {
        Self::assemble(header, payload, |_| check)
    }

    fn assemble(header: &Header, payload: &[u8], check: impl FnOnce(&[u8]) -> u32) -> Self {
        let mut bytes = Vec::with_capacity(64 + payload.len());
        header.write(&mut bytes);
        let tail = Tail { checked: bytes.len(), check: check(&bytes) };
        bytes.extend_from_slice(&tail.check.to_le_bytes());
        bytes.extend_from_slice(payload);
        Self { bytes: bytes.into(), header: *header, tail }
    }

    /// What the package says about itself.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// The package as it goes over the wire.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Whether header and decoded content match the check.
    pub(crate) fn verify(&self, content: &Hasher) -> Result<(), PackageError> {
        let header = self.bytes.get(..self.tail.checked).unwrap_or_default();
        let (stated, found) = (self.tail.check, check::of_package(header, self.payload(), content));
        if found == stated { Ok(()) } else { Err(PackageError::Check { stated, found }) }
    }

    pub(crate) fn payload(&self) -> &[u8] {
        self.bytes.get(self.tail.checked + CHECK_BYTES..).unwrap_or_default()
    }
}

impl PartialEq for Package {
    fn eq(&self, other: &Self) -> bool {
        self.bytes == other.bytes
    }
}

impl Eq for Package {}

impl fmt::Debug for Package {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let header = &self.header;
        write!(f, "package {} of {:?}, ", header.index, header.stream)?;
        write!(f, "{:?}, {} B {}, {:?}", header.content, self.bytes.len(), header.codec, header.region)
    }
}
