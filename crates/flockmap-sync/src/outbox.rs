//! What is going out.

use crate::IntervalSet;
use crate::broadcasts::Broadcasts;
use crate::coded::BlockEncoder;
use crate::item::Item;
use crate::pacer::{Pacer, burst_bytes};
use crate::path::{PathsWaiting, PeerPath};
use crate::peer::{PEER_INTERVALS_MAX, Peer, Sending};
use crate::rate::Rate;
use crate::wire::Contents;
use crate::{SessionConfig, Store};
use flockmap_codec::Package;
use flockmap_grid::{RobotId, Stamp, Stream};
use std::collections::{BTreeMap, BTreeSet};

/// What waits to be sent, and the budgets that let it go.
#[derive(Debug)]
pub(crate) struct Outbox {
    /// Snapshots that can be sent.
    pub(crate) snapshots: Vec<Outgoing>,
    /// When the driver is asked again for a snapshot of a stream.
    pub(crate) asked: BTreeMap<Stream, Stamp>,
    /// Of histories with gaps: what was held of them when a snapshot was asked for that is not there yet. More may
    /// come while it is made, which it does not contain.
    pub(crate) held_when_asked: BTreeMap<Stream, IntervalSet>,
    /// Snapshots that were asked for and are not there yet.
    pub(crate) coming: BTreeMap<Stream, Coming>,
    pub(crate) path_waiting: PathsWaiting,
    /// The peer that was served last.
    pub(crate) served: RobotId,
    pub(crate) radio: Option<Pacer>,
    /// What the radio is found to carry; `None`: that is not asked.
    pub(crate) rate: Option<Rate>,
    /// Until then the radio takes no datagram of packages.
    pub(crate) blocked_until: Option<Stamp>,
    /// As [`Peer::superseded`](crate::peer::Peer::superseded), for a datagram that waits for the radio's budget.
    pub(crate) superseded: Option<u8>,
    /// By broadcast.
    pub(crate) broadcasts: Broadcasts,
    /// Of the block that is being repaired; and how many repair symbols were made, of all blocks.
    pub(crate) encoder: Option<BlockEncoder>,
    pub(crate) symbols_made: u32,
    /// What is kept of peers that fell silent. At most `peers_max`, 2 KiB each.
    pub(crate) silent: BTreeMap<RobotId, SilentPeer>,
}

/// What is kept of a peer that fell silent: on a slow radio it is heard again before an answer of it is there.
#[derive(Debug)]
pub(crate) struct SilentPeer {
    /// The budget of the link to it.
    pub(crate) pacer: Option<Pacer>,
    pub(crate) path: PeerPath,
}

impl SilentPeer {
    pub(crate) fn of(peer: Peer) -> Self {
        Self { pacer: peer.pacer, path: peer.path }
    }
}

/// A snapshot that can be sent, to several peers if they need it.
#[derive(Debug)]
pub(crate) struct Outgoing {
    pub(crate) stream: Stream,
    pub(crate) snapshot_id: u32,
    pub(crate) since: u32,
    pub(crate) upto: u32,
    /// What it contains, where that has gaps.
    pub(crate) contents: Option<IntervalSet>,
    /// It lacks something that was dropped.
    pub(crate) is_in_part: bool,
    /// It is a piece of the state: what it lacks was changed by packages up to this one.
    pub(crate) changed_upto: Option<u32>,
    /// Of all packages up to this one, nothing newer is known of what it says.
    pub(crate) newest_of: u32,
    pub(crate) chunks: Vec<Package>,
    pub(crate) bytes: usize,
    pub(crate) used_at: Stamp,
}

/// A snapshot that was asked for and is not there yet.
#[derive(Debug)]
pub(crate) struct Coming {
    pub(crate) since: u32,
    pub(crate) upto: u32,
    /// It counts on its coming until then; `None`: the driver has not said that it makes it.
    pub(crate) until: Option<Stamp>,
    /// Who will be sent it.
    pub(crate) peers: BTreeSet<RobotId>,
}

impl Outgoing {
    /// About what the part of it since a package would cost now, when `upto` is the newest one.
    pub(crate) fn cost(&self, since: u32, upto: u32) -> u64 {
        let part = u64::from(upto.saturating_sub(since.max(self.since)));
        self.bytes as u64 * part / u64::from(self.upto - self.since).max(1)
    }

    /// Whether somebody who holds this of the stream knows more with it.
    pub(crate) fn helps(&self, received: &IntervalSet) -> bool {
        match &self.contents {
            Some(contents) => !contents.difference(received).is_empty(),
            None => self.since <= received.prefix() && !received.contains_range(1, self.upto),
        }
    }

    /// Begins to send it to a peer.
    pub(crate) fn sending(&self, now: Stamp) -> Sending {
        let nothing = IntervalSet::new(PEER_INTERVALS_MAX);
        let (snapshot_id, since, upto) = (self.snapshot_id, self.since, self.upto);
        Sending {
            snapshot_id,
            since,
            upto,
            pieces_upto: self.changed_upto.unwrap_or(upto).max(upto),
            newest_of: self.newest_of,
            named_at: now,
            unheeded: 1,
            lost_at: now,
            accepted: nothing.clone(),
            received_or_in_flight: nothing,
        }
    }

    /// Whether at most an eighth of it says what who knows packages 1 to `since` knows already.
    pub(crate) const fn is_near(&self, since: u32) -> bool {
        since.saturating_sub(self.since) <= (self.upto - self.since) / 8
    }
}

impl Outbox {
    pub(crate) fn new(config: &SessionConfig) -> Self {
        Self {
            snapshots: Vec::new(),
            asked: BTreeMap::new(),
            held_when_asked: BTreeMap::new(),
            coming: BTreeMap::new(),
            path_waiting: PathsWaiting::new(),
            served: RobotId(0),
            radio: config.radio_bytes_per_s.map(|rate| Pacer::new(rate, burst_bytes(rate, config.burst_ms))),
            rate: config.congestion_control.then(Rate::new),
            blocked_until: None,
            superseded: None,
            broadcasts: Broadcasts::new(),
            encoder: None,
            symbols_made: 0,
            silent: BTreeMap::new(),
        }
    }

    /// Which packages a snapshot brings to a peer that is being made for it: those after the first, up to the second.
    pub(crate) fn coming_to(&self, now: Stamp, stream: Stream, peer: RobotId) -> Option<(u32, u32)> {
        let coming = self.coming.get(&stream)?;
        let is_coming = coming.until.is_some_and(|until| until > now) && coming.peers.contains(&peer);
        is_coming.then_some((coming.since, coming.upto))
    }

    /// A snapshot that can be sent.
    pub(crate) fn snapshot(&self, stream: Stream, snapshot_id: u32) -> Option<&Outgoing> {
        self.snapshots
            .iter()
            .find(|outgoing| outgoing.stream == stream && outgoing.snapshot_id == snapshot_id)
    }

    /// `None` if `bytes` may go out now, else the earliest time at which they may.
    pub(crate) fn wait(&mut self, now: Stamp, bytes: usize) -> Option<Stamp> {
        let budget = self.radio.as_mut().and_then(|radio| radio.wait(now, bytes));
        budget.max(self.rate.as_mut().and_then(|rate| rate.wait(now, bytes)))
    }

    /// As [`Self::wait`], for packages.
    pub(crate) fn wait_with_packages(&mut self, now: Stamp, bytes: usize, peers: usize) -> Option<Stamp> {
        let echo = self.rate.as_ref().and_then(|rate| rate.wait_for_echo(now, bytes, peers));
        self.wait(now, bytes).max(echo)
    }

    /// Counts bytes as sent.
    pub(crate) fn spend(&mut self, now: Stamp, bytes: usize) {
        self.radio.iter_mut().for_each(|radio| radio.spend(now, bytes));
        self.rate.iter_mut().for_each(|rate| rate.spend(now, bytes));
    }

    /// What is sent for an item, if it is there.
    pub(crate) fn package<'a>(&'a self, item: Item, store: &'a Store) -> Option<&'a Package> {
        match item {
            Item::Package { stream, index } => store.get(stream, index).map(|stored| &stored.package),
            Item::Chunk { stream, snapshot_id, chunk } => {
                self.snapshot(stream, snapshot_id)?.chunks.get(chunk as usize)
            }
        }
    }

    /// What a chunk's snapshot contains, where that has to be said.
    pub(crate) fn contents(&self, item: Item) -> Option<Contents> {
        let Item::Chunk { stream, snapshot_id, .. } = item else { return None };
        Some(Contents {
            stream,
            snapshot_id,
            received: self.snapshot(stream, snapshot_id)?.contents.clone()?,
        })
    }

    /// The newest state at hand for a peer that has or gets packages 1 to `since_max` otherwise; none that lacks
    /// something unless one that is made now would (`is_in_part`), and no piece that says nothing more.
    pub(crate) fn at_hand(&self, stream: Stream, since_max: u32, is_in_part: bool) -> Option<usize> {
        self.snapshots.iter().rposition(|outgoing| {
            outgoing.stream == stream
                && outgoing.contents.is_none()
                && outgoing.since <= since_max
                && (is_in_part || !outgoing.is_in_part)
                && (outgoing.changed_upto.is_none() || outgoing.upto > since_max)
        })
    }
}
