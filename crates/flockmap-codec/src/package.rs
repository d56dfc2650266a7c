//! An encoded package: bytes that know their header.

use core::fmt;
use core::ops::Range;
use std::sync::Arc;

use flockmap_grid::{Changes, PresentState, Stream};

use crate::header::{STREAM_AT, Tail};
use crate::{Codec, ContentKind, Decoder, Header, PackageError, flock, varint};

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
    /// What changed in one cycle; every voxel gets the stamp `cycle_end` of the header.
    Changes(Changes),
    /// A tile of the present state, each voxel with its own stamp.
    Present(PresentState),
}

impl Package {
    /// Takes the bytes of exactly one package, no more and no less: where it ends is told by what carries it. Reads its header; the
    /// payload is not looked at, and only [`Self::decode`] tells whether the package is whole. Holds a copy of `bytes` and about 150
    /// bytes more.
    pub fn parse(bytes: &[u8]) -> Result<Self, PackageError> {
        let (header, tail, _) = Header::read(bytes)?;
        Ok(Self { bytes: bytes.into(), header, tail })
    }

    /// The same bytes in two parts without the stream between them, for who knows the stream: [`Self::parse_without_stream`].
    pub fn without_stream(&self) -> [&[u8]; 2] {
        let Stream { origin, epoch } = self.header.stream;
        let stream_end = STREAM_AT + varint::length(origin.0.into()) + varint::length(epoch);
        let part = |range: Range<usize>| self.bytes.get(range).unwrap_or_default();
        [part(0..STREAM_AT), part(stream_end..self.bytes.len())]
    }

    /// Takes the bytes of exactly one package of this stream, which stands in them no more. Otherwise as [`Self::parse`].
    pub fn parse_without_stream(stream: Stream, bytes: &[u8]) -> Result<Self, PackageError> {
        let (front, back) = bytes.split_at(bytes.len().min(STREAM_AT));
        let mut whole = Vec::with_capacity(bytes.len() + 13);
        whole.extend_from_slice(front);
        varint::write(&mut whole, stream.origin.0.into());
        varint::write(&mut whole, stream.epoch);
        whole.extend_from_slice(back);
        Self::parse(&whole)
    }

    /// Header, tail and payload as the encoder made them.
    pub(crate) fn seal(header: &Header, payload: &[u8], check: impl FnOnce(&[u8]) -> u32) -> Self {
        let mut bytes = Vec::with_capacity(64 + payload.len());
        header.write(&mut bytes);
        let tail = Tail { checked: bytes.len(), check: check(&with_length(&bytes, payload)) };
        bytes.extend_from_slice(&tail.check.to_le_bytes());
        bytes.extend_from_slice(payload);
        Self { bytes: bytes.into(), header: *header, tail }
    }

    /// A package of these parts, whatever they are: for tests of what a hostile peer may send.
    pub fn from_parts(header: &Header, payload: &[u8], check: u32) -> Self {
        Self::seal(header, payload, |_| check)
    }

    /// What the package says about itself.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// The package as it goes over the wire.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// The content. An error means that the package is damaged, or is not of this version: none of it may be used.
    ///
    /// Takes at most 2.5 bytes of memory for each voxel of the box while it works, and the box is refused before
    /// that if the payload could not fill it: 12 MB for a package of 1,150 bytes, twice that for a present state. To
    /// decode many packages use a [`Decoder`], which keeps its memory.
    pub fn decode(&self) -> Result<Content, PackageError> {
        Decoder::new().decode(self)
    }

    /// From where the changes were seen, in sixteenths of a voxel, if the package says so: packages of changes in
    /// [`Codec::Flock`](crate::Codec::Flock) do. What [`flockmap_grid::Layer::note_sensor`] wants to know.
    pub fn sensor(&self) -> Option<[i32; 3]> {
        let is_told = self.header.codec == Codec::Flock && self.header.content == ContentKind::Changes;
        if is_told { flock::sensor(self.payload(), &self.header.region) } else { None }
    }

    /// What the check covers beside the decoded content: the bytes of the header and the length of the payload, so that a package
    /// that lost its end, or got another, is damaged for every codec.
    pub(crate) fn checked(&self) -> Vec<u8> {
        with_length(self.bytes.get(..self.tail.checked).unwrap_or_default(), self.payload())
    }

    /// The check that the package carries.
    pub(crate) fn check(&self) -> u32 {
        self.tail.check
    }

    pub(crate) fn payload(&self) -> &[u8] {
        self.bytes.get(self.tail.checked + 4..).unwrap_or_default()
    }
}

fn with_length(header: &[u8], payload: &[u8]) -> Vec<u8> {
    // No payload comes near the end of a `u32`: the box of the largest is told in 2²⁷ times a few bytes.
    [header, &(payload.len() as u32).to_le_bytes()].concat()
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
