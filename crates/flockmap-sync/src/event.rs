//! The events of a session, for its driver.

use crate::IntervalSet;
use crate::path::Path;
use flockmap_codec::Package;
use flockmap_grid::{RobotId, Stamp, Stream};

/// Something for the driver to do or to know.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Event {
    /// A package or chunk that was not held before, and that can be decoded: what it builds on is merged; of
    /// chunks that build on one another it is the next one. Decode and merge it, then give the
    /// [`verdict`](crate::Session::verdict), before any other call.
    Received(Package),
    /// A peer misses so much of a stream that the state as it is costs less, or packages that are not stored
    /// any more. Encode the layer of the stream as it is now, or what of it is newer than a stamp, as chunks with
    /// `since` and index `upto` and call [`provide_snapshot`](crate::Session::provide_snapshot). That may take
    /// a while ([`snapshot_is_coming`](crate::Session::snapshot_is_coming)); further events for the same stream
    /// need no answer until then.
    SnapshotWanted {
        /// The stream whose layer is wanted.
        stream: Stream,
        /// What packages after this one made is wanted; 0: the whole layer.
        since: u32,
        /// Every voxel whose newest change is in a package after `since` has a newer stamp than this, on the
        /// clock of the stream's robot. `None`: the whole layer is wanted.
        newer_than: Option<Stamp>,
        /// All packages from 1 to this one are in the layer; or, where `since` is the one before it and there
        /// are gaps before that, this one.
        upto: u32,
        /// No chunk may have more bytes.
        bytes_max: usize,
        /// Where that is too much for one snapshot, the older part of it will do, up to an earlier package.
        in_pieces: bool,
        /// The peer that misses it.
        peer: RobotId,
    },
    /// All chunks of a snapshot are merged, and the packages before those that it contains: packages 1 to
    /// `upto` of the stream now count as held. What was read of a snapshot up to there can be dropped.
    CaughtUp {
        /// The stream.
        stream: Stream,
        /// The newest package that the state contains.
        upto: u32,
    },
    /// There is no place to read this snapshot any more: let go of what was read. Its chunks come again from
    /// the first one on.
    SnapshotDropped {
        /// The stream.
        stream: Stream,
        /// The snapshot, as its chunks say.
        snapshot_id: u32,
    },
    /// A package waited for those that it builds on, and there is no room for it any more. It is asked for
    /// again after 10 s.
    NoRoomToWait {
        /// The stream.
        stream: Stream,
        /// The package.
        index: u32,
        /// The newest package that it builds on.
        base: u32,
    },
    /// All chunks of a snapshot of a history with gaps are merged: these packages of the stream now count as
    /// held. A driver that stores its chunks stores this too
    /// ([`deliver_contents`](crate::Session::deliver_contents)). [`Self::CaughtUp`] follows.
    SnapshotContains {
        /// The stream.
        stream: Stream,
        /// The snapshot, as its chunks say.
        snapshot_id: u32,
        /// The packages that it contains; at most [`RECEIVED_INTERVALS_MAX`](crate::RECEIVED_INTERVALS_MAX)
        /// intervals.
        received: IntervalSet,
    },
    /// A robot was heard for the first time, or again after it was lost, or in a new run.
    PeerSeen(Stream),
    /// A peer has not been heard for `peer_timeout_ms`.
    PeerLost(Stream),
    /// Something is known of a stream for the first time.
    StreamSeen(Stream),
    /// An old run of an origin was forgotten to make room for a newer one. What the map has of it may stay.
    StreamForgotten(Stream),
    /// Another robot uses the own id, or this run has the epoch of an earlier one. Give every robot its own
    /// id and every run an epoch with random bits. Reported at most every 10 s.
    SameIdentity,
    /// The own id was used with a higher epoch, as others report: by an earlier run whose clock was ahead, or
    /// by another robot. Whoever knows that run takes this one for a former one. Call
    /// [`begin_run`](crate::Session::begin_run) with an epoch above this one. Reported at once, then after
    /// pauses from 10 s up to an hour.
    EpochTooLow {
        /// The epoch that was used.
        used: u64,
    },
    /// So many datagrams were sealed (2⁴⁷) that one more would repeat a nonce: this session sends nothing more.
    /// Start the robot again. Reported once.
    NoncesExhausted,
}

/// Whom a datagram goes to.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Destination {
    /// This peer: at [`Transmit::path`].
    Peer(RobotId),
    /// Everyone: the broadcast or multicast address, or each configured address and each of
    /// [`Session::paths`](crate::Session::paths), beginning with another one each time: where a queue is full, it takes
    /// the first only.
    Everyone,
}

impl Destination {
    pub(crate) fn includes(self, robot: RobotId) -> bool {
        match self {
            Self::Peer(peer) => peer == robot,
            Self::Everyone => true,
        }
    }
}

/// A datagram to send.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Transmit {
    /// Whom to.
    pub to: Destination,
    /// Where to, if it is for one robot and the driver knows on which path it hears each datagram
    /// ([`handle_datagram_from`](crate::Session::handle_datagram_from)).
    pub path: Option<Path>,
    /// The UDP payload, at most [`DATAGRAM_BYTES_MAX`](crate::wire::DATAGRAM_BYTES_MAX) bytes.
    pub bytes: Vec<u8>,
}

/// An own package that cannot be published. The caller is at fault.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
pub enum PublishError {
    /// Not the own stream.
    #[error("package of {got:?} published by {own:?}")]
    Stream {
        /// The stream of the package.
        got: Stream,
        /// The own stream.
        own: Stream,
    },
    /// Not the next index.
    #[error("package {got} published, {expected} is next")]
    Index {
        /// The index of the package.
        got: u32,
        /// The one that is next.
        expected: u32,
    },
    /// A chunk of a snapshot.
    #[error("a chunk of a snapshot cannot be published; it is given to provide_snapshot")]
    Content,
    /// Too long for one datagram.
    #[error("package of {got} bytes, a datagram takes {expected} at most")]
    Bytes {
        /// Bytes of the package.
        got: usize,
        /// The most that fits.
        expected: usize,
    },
}
