//! Sealed datagrams: what a swarm with a key sends. ChaCha20-Poly1305 (RFC 8439) over everything but the few bytes by
//! which a receiver finds the nonce; those are authenticated too.

use super::{
    DATAGRAM_BYTES_MAX, Datagram, DatagramError, HEADER_BYTES, MAGIC, WIRE_VERSION, check_version, head,
};
use crate::SwarmKey;
use crate::bytes::Reader;
use chacha20poly1305::aead::AeadInOut;
use chacha20poly1305::{ChaCha20Poly1305, KeyInit, Nonce, Tag};
use flockmap_grid::{RobotId, Stream};

/// In place of the kind, which is inside.
pub(super) const SEALED: u8 = 0x80;

/// Magic, version, kind, swarm, sender, epoch, counter.
const CLEAR_BYTES: usize = 12 + COUNTER_BYTES;
const COUNTER_BYTES: usize = 6;
const TAG_BYTES: usize = 16;
/// What is sealed begins with these: kind, send stamp.
const INNER_BYTES: usize = 9;

/// Bytes by which a sealed datagram is longer than the same one unsealed.
pub const SEAL_BYTES: usize = CLEAR_BYTES + INNER_BYTES + TAG_BYTES - HEADER_BYTES;

/// The highest counter of a sealed datagram.
pub const COUNTER_MAX: u64 = (1 << (8 * COUNTER_BYTES)) - 1;

/// Whether a received datagram states to be sealed. Nothing is checked.
pub fn is_sealed(bytes: &[u8]) -> bool {
    bytes.get(3) == Some(&SEALED)
}

/// The robot that a datagram states to be from, sealed or not. Nothing is checked.
pub fn stated_sender(bytes: &[u8]) -> Option<RobotId> {
    let sender = bytes.get(6..8)?.try_into().ok()?;
    Some(RobotId(u16::from_le_bytes(sender)))
}

/// Seals a complete datagram. A counter above [`COUNTER_MAX`], or bytes that are no datagram, give `None`.
///
/// **Never use a counter twice** for one sender and epoch: two datagrams with one nonce give away what both say, and let
/// others forge.
pub fn seal_datagram(key: &SwarmKey, datagram: &[u8], counter: u64) -> Option<Vec<u8>> {
    if counter > COUNTER_MAX || datagram.len() < HEADER_BYTES {
        return None;
    }
    let mut out = Vec::with_capacity(datagram.len() + SEAL_BYTES);
    out.extend(&datagram[..12]);
    out[3] = SEALED;
    out.extend(&counter.to_le_bytes()[..COUNTER_BYTES]);
    out.push(datagram[3]);
    out.extend(&datagram[12..20]);
    out.extend(&datagram[HEADER_BYTES..]);
    let (clear, inner) = out.split_at_mut(CLEAR_BYTES);
    let tag = cipher(key).encrypt_inout_detached(&nonce(clear), clear, inner.into()).ok()?;
    out.extend(tag);
    Some(out)
}

/// A received datagram that is sealed, of this version and of a length that can be. Nothing of it is proved.
#[derive(Clone, Copy, Debug)]
pub struct SealedDatagram<'a> {
    swarm: u16,
    sender: Stream,
    counter: u64,
    clear: &'a [u8],
    inner: &'a [u8],
    tag: &'a [u8],
}

impl<'a> SealedDatagram<'a> {
    /// Looks at the clear part. Allocates nothing.
    pub fn new_checked(bytes: &'a [u8]) -> Result<Self, DatagramError> {
        let got = bytes.len();
        let length = DatagramError::Length { got };
        if !(HEADER_BYTES + SEAL_BYTES..=DATAGRAM_BYTES_MAX).contains(&got) {
            return Err(length);
        }
        let (clear, rest) = bytes.split_at(CLEAR_BYTES);
        let (inner, tag) = rest.split_at(rest.len() - TAG_BYTES);
        let kind = check_version(bytes)?;
        if kind != SEALED {
            return Err(DatagramError::Kind { got: kind });
        }
        let mut reader = Reader::new(&clear[4..]);
        let (swarm, sender) = head(&mut reader).ok_or_else(|| length.clone())?;
        let mut counter = [0; 8];
        counter[..COUNTER_BYTES].copy_from_slice(reader.bytes(COUNTER_BYTES).ok_or(length)?);
        Ok(Self { swarm, sender, counter: u64::from_le_bytes(counter), clear, inner, tag })
    }

    /// The swarm that it states.
    pub const fn swarm(&self) -> u16 {
        self.swarm
    }

    /// The sender and run that it states.
    pub const fn sender(&self) -> Stream {
        self.sender
    }

    /// The number of the datagram that it states.
    pub const fn counter(&self) -> u64 {
        self.counter
    }

    /// Proves the datagram with the key and deciphers it. Allocates as many bytes as the datagram has.
    pub fn open(&self, key: &SwarmKey) -> Result<OpenedDatagram, DatagramError> {
        let forged = DatagramError::Forged { sender: self.sender.origin };
        let mut inner = self.inner.to_vec();
        let tag = Tag::try_from(self.tag).map_err(|_| forged.clone())?;
        cipher(key)
            .decrypt_inout_detached(&nonce(self.clear), self.clear, inner.as_mut_slice().into(), &tag)
            .map_err(|_| forged)?;
        Ok(OpenedDatagram { swarm: self.swarm, sender: self.sender, inner })
    }
}

/// The content of a sealed datagram that was proved to be from a holder of the key.
#[derive(Clone, Debug)]
pub struct OpenedDatagram {
    swarm: u16,
    sender: Stream,
    inner: Vec<u8>,
}

impl OpenedDatagram {
    /// Checks what the sender wrote: kind and records.
    pub fn datagram(&self) -> Result<Datagram<'_>, DatagramError> {
        let mut reader = Reader::new(&self.inner);
        let start = (|| Some((reader.u8()?, reader.i64()?)))();
        let (kind, stamp) = start.ok_or(DatagramError::Malformed {
            sender: self.sender.origin,
            what: "start of what is sealed",
        })?;
        Datagram::with_body(kind, self.swarm, self.sender, stamp, &self.inner[INNER_BYTES..])
    }
}

fn cipher(key: &SwarmKey) -> ChaCha20Poly1305 {
    ChaCha20Poly1305::new(key.bytes().into())
}

/// Sender, epoch and counter as they stand in the clear part: no two datagrams of a swarm have the same three.
fn nonce(clear: &[u8]) -> Nonce {
    core::array::from_fn(|at| clear[6 + at]).into()
}

const _: () = assert!(MAGIC.len() == 2 && WIRE_VERSION == 2 && CLEAR_BYTES == 6 + 12);
