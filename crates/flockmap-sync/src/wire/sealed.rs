//! Sealed datagrams: what a swarm with a key sends. XChaCha20-Poly1305 over everything but the few bytes by
//! which a receiver finds the nonce; those are authenticated too.

use super::datagram::{
    DATAGRAM_BYTES_MAX, Datagram, DatagramError, HEADER_BYTES, Kind, MAGIC, WIRE_VERSION, check_version, head,
};
use crate::SwarmKey;
use chacha20poly1305::aead::AeadInOut;
use chacha20poly1305::{KeyInit, Tag, XChaCha20Poly1305, XNonce};
use flockmap_codec::bytes::Reader;
use flockmap_grid::{RobotId, Stream};

/// Set in the kind of a datagram that is sealed.
pub(super) const SEALED: u8 = 0x80;
/// Set beside it where only one robot can open the datagram.
const FOR_ONE: u8 = 0x40;
/// The kind itself.
const KIND: u8 = 0x3f;

/// Magic, version, kind, swarm, sender, epoch: the same in every datagram.
const HEAD_BYTES: usize = 16;
const COUNTER_BYTES: usize = 6;
const TAG_BYTES: usize = 16;
/// What is sealed begins with the send stamp.
const STAMP_BYTES: usize = 8;

/// Bytes of the salt of a run.
pub const SALT_BYTES: usize = 16;

/// Bytes by which a sealed datagram is longer than the same one unsealed; requests and challenges are longer
/// by [`SALT_BYTES`] more.
pub const SEAL_BYTES: usize = HEAD_BYTES + COUNTER_BYTES + STAMP_BYTES + TAG_BYTES - HEADER_BYTES;

/// The highest counter of a sealed datagram. The bit above it separates datagrams for one robot from those
/// for all.
pub const COUNTER_MAX: u64 = (1 << (8 * COUNTER_BYTES - 1)) - 1;

/// Random bytes that a driver draws for each run. With them every run seals with a key of its own, whatever
/// its clock and its epoch are, so that no nonce comes twice.
pub type Salt = [u8; SALT_BYTES];

/// Bytes that sealing adds to a datagram of this kind.
pub const fn seal_bytes(kind: Kind) -> usize {
    SEAL_BYTES + if has_salt(kind) { SALT_BYTES } else { 0 }
}

/// Requests and challenges have the salt of the sender's run: each of them may be the first that a robot
/// hears of it.
const fn has_salt(kind: Kind) -> bool {
    match kind {
        Kind::Request | Kind::Path => true,
        Kind::Packages => false,
    }
}

/// Whether a received datagram states to be sealed. Nothing is checked.
pub fn is_sealed(bytes: &[u8]) -> bool {
    bytes.get(3).is_some_and(|kind| kind & SEALED != 0)
}

/// Seals a complete datagram for all robots of the swarm, or for one alone. A counter above [`COUNTER_MAX`],
/// or bytes that are no datagram, give `None`.
///
/// **Never use a counter twice** for one salt and recipient: two datagrams with one nonce give away what both
/// say, and let others forge.
pub fn seal_datagram(
    key: &SwarmKey,
    salt: &Salt,
    datagram: &[u8],
    recipient: Option<RobotId>,
    counter: u64,
) -> Option<Vec<u8>> {
    if counter > COUNTER_MAX || datagram.len() < HEADER_BYTES {
        return None;
    }
    let kind = Kind::from_id(datagram[3])?;
    let mut out = Vec::with_capacity(datagram.len() + SEAL_BYTES + SALT_BYTES);
    out.extend(&datagram[..HEAD_BYTES]);
    out[3] |= SEALED | if recipient.is_some() { FOR_ONE } else { 0 };
    out.extend(&counter.to_le_bytes()[..COUNTER_BYTES]);
    if has_salt(kind) {
        out.extend(salt);
    }
    let clear_bytes = out.len();
    out.extend(&datagram[HEAD_BYTES..HEAD_BYTES + STAMP_BYTES]);
    out.extend(&datagram[HEADER_BYTES..]);
    let (clear, inner) = out.split_at_mut(clear_bytes);
    let nonce = nonce(salt, recipient, counter);
    let tag = cipher(key).encrypt_inout_detached(&nonce, clear, inner.into()).ok()?;
    out.extend(tag);
    Some(out)
}

/// A received datagram that is sealed, of this version and of a length that can be. Nothing of it is
/// authenticated.
#[derive(Clone, Copy, Debug)]
pub struct SealedDatagram<'a> {
    kind: Kind,
    is_for_one: bool,
    swarm: u16,
    sender: Stream,
    counter: u64,
    salt: Option<Salt>,
    clear: &'a [u8],
    inner: &'a [u8],
    tag: &'a [u8],
}

impl<'a> SealedDatagram<'a> {
    /// Looks at the clear part. Allocates nothing.
    pub fn new_checked(bytes: &'a [u8]) -> Result<Self, DatagramError> {
        let got = bytes.len();
        let length = DatagramError::Length { got };
        if got > DATAGRAM_BYTES_MAX {
            return Err(length);
        }
        let stated = check_version(bytes)?;
        let unknown = DatagramError::Kind { got: stated };
        let kind =
            Kind::from_id(stated & KIND).filter(|_| stated & SEALED != 0).ok_or_else(|| unknown.clone())?;
        let mut reader = Reader::new(bytes.get(4..).unwrap_or_default());
        let (swarm, sender) = head(&mut reader).ok_or_else(|| length.clone())?;
        let mut counter = [0; 8];
        counter[..COUNTER_BYTES].copy_from_slice(reader.bytes(COUNTER_BYTES).ok_or_else(|| length.clone())?);
        let counter = u64::from_le_bytes(counter);
        if counter > COUNTER_MAX {
            return Err(DatagramError::Malformed { sender: sender.origin, what: "counter" });
        }
        let salt = match has_salt(kind) {
            true => Some(reader.array().ok_or_else(|| length.clone())?),
            false => None,
        };
        let (clear, rest) = bytes.split_at(HEAD_BYTES + COUNTER_BYTES + salt.map_or(0, |_| SALT_BYTES));
        if rest.len() < STAMP_BYTES + TAG_BYTES {
            return Err(length);
        }
        let (inner, tag) = rest.split_at(rest.len() - TAG_BYTES);
        let is_for_one = stated & FOR_ONE != 0;
        Ok(Self { kind, is_for_one, swarm, sender, counter, salt, clear, inner, tag })
    }

    /// The swarm that it states.
    pub const fn swarm(&self) -> u16 {
        self.swarm
    }

    /// The sender and run that it states.
    pub const fn sender(&self) -> Stream {
        self.sender
    }

    /// The number of the datagram that it states, among those for all or among those for one.
    pub const fn counter(&self) -> u64 {
        self.counter
    }

    /// Whether it is for one robot alone. Which one it does not say: no other can open it.
    pub const fn is_for_one(&self) -> bool {
        self.is_for_one
    }

    /// The salt of the sender's run, if the datagram has it: requests and challenges have.
    pub const fn salt(&self) -> Option<Salt> {
        self.salt
    }

    /// Proves the datagram with the key and the salt of the sender's run, and deciphers it for `own`.
    /// Allocates as many bytes as the datagram has.
    pub fn open(&self, key: &SwarmKey, salt: &Salt, own: RobotId) -> Result<OpenedDatagram, DatagramError> {
        let forged = DatagramError::Forged { sender: self.sender.origin };
        let mut inner = self.inner.to_vec();
        let tag = Tag::try_from(self.tag).map_err(|_| forged.clone())?;
        let nonce = nonce(salt, self.is_for_one.then_some(own), self.counter);
        cipher(key)
            .decrypt_inout_detached(&nonce, self.clear, inner.as_mut_slice().into(), &tag)
            .map_err(|_| forged)?;
        Ok(OpenedDatagram { kind: self.kind, swarm: self.swarm, sender: self.sender, inner })
    }
}

/// The content of a sealed datagram that was authenticated as from a holder of the key.
#[derive(Clone, Debug)]
pub struct OpenedDatagram {
    kind: Kind,
    swarm: u16,
    sender: Stream,
    inner: Vec<u8>,
}

impl OpenedDatagram {
    /// Checks what the sender wrote: the records.
    pub fn datagram(&self) -> Result<Datagram<'_>, DatagramError> {
        let malformed = || DatagramError::Malformed { sender: self.sender.origin, what: "send stamp" };
        let stamp = Reader::new(&self.inner).i64().ok_or_else(malformed)?;
        Datagram::with_body(self.kind, self.swarm, self.sender, stamp, &self.inner[STAMP_BYTES..])
    }
}

fn cipher(key: &SwarmKey) -> XChaCha20Poly1305 {
    XChaCha20Poly1305::new(key.bytes().into())
}

/// The salt, then the recipient, then the counter with its highest bit set where there is a recipient: no two
/// datagrams under a swarm's key have the same, as long as no two runs have the same salt.
fn nonce(salt: &Salt, recipient: Option<RobotId>, counter: u64) -> XNonce {
    let recipient_bits = recipient.map_or(0, |_| COUNTER_MAX + 1);
    let mut bytes = [0; SALT_BYTES + 2 + COUNTER_BYTES];
    bytes[..SALT_BYTES].copy_from_slice(salt);
    bytes[SALT_BYTES..][..2].copy_from_slice(&recipient.map_or(0, |robot| robot.0).to_le_bytes());
    bytes[SALT_BYTES + 2..].copy_from_slice(&(counter | recipient_bits).to_le_bytes()[..COUNTER_BYTES]);
    bytes.into()
}

const _: () = assert!(MAGIC.len() == 2 && WIRE_VERSION == 7 && HEAD_BYTES + STAMP_BYTES + 4 == HEADER_BYTES);
