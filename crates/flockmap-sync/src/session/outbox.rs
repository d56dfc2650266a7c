//! What is on its way out.

use super::path;
use super::present::Outgoing;
use crate::item::Item;
use crate::pacer::Pacer;
use crate::wire::Contents;
use crate::{SessionConfig, Store};
use flockmap_codec::Package;
use flockmap_grid::{RobotId, Stamp, Stream};
use std::collections::BTreeMap;

/// What waits to be sent, and the budgets that let it go.
#[derive(Debug)]
pub(super) struct Outbox {
    /// Present states that can be sent.
    pub(super) snapshots: Vec<Outgoing>,
    /// When the driver is asked again for a present state of a stream.
    pub(super) asked: BTreeMap<Stream, Stamp>,
    pub(super) path_waiting: path::Waiting,
    /// The peer that was served last.
    pub(super) served: RobotId,
    pub(super) radio: Option<Pacer>,
    /// As [`Peer::overtaken`](super::Peer::overtaken), for a datagram that waits for the radio's budget.
    pub(super) overtaken: Option<u8>,
    /// Budgets of the links to peers that fell silent. At most `peers_max`, 2 KiB each.
    pub(super) silent_links: BTreeMap<RobotId, Pacer>,
}

impl Outbox {
    pub(super) fn new(config: &SessionConfig) -> Self {
        Self {
            snapshots: Vec::new(),
            asked: BTreeMap::new(),
            path_waiting: path::Waiting::new(),
            served: RobotId(0),
            radio: config.radio_bytes_per_s.map(|rate| Pacer::new(rate, burst_bytes(rate, config.burst_ms))),
            overtaken: None,
            silent_links: BTreeMap::new(),
        }
    }

    /// A present state that can be sent.
    pub(super) fn snapshot(&self, stream: Stream, set: u32) -> Option<&Outgoing> {
        self.snapshots.iter().find(|outgoing| outgoing.stream == stream && outgoing.set == set)
    }

    /// What is sent for an item, if it is there.
    pub(super) fn package<'a>(&'a self, item: Item, store: &'a Store) -> Option<&'a Package> {
        match item {
            Item::Package { stream, index } => store.get(stream, index).map(|stored| &stored.package),
            Item::Tile { stream, set, tile } => self.snapshot(stream, set)?.tiles.get(tile as usize),
        }
    }

    /// What a tile's set contains, where that has to be told.
    pub(super) fn contents(&self, item: Item) -> Option<Contents> {
        let Item::Tile { stream, set, .. } = item else { return None };
        Some(Contents { stream, set, held: self.snapshot(stream, set)?.contents.clone()? })
    }

    /// The newest state at hand for a peer that has or gets packages 1 to `since_max` otherwise.
    pub(super) fn at_hand(&self, stream: Stream, since_max: u32) -> Option<usize> {
        self.snapshots.iter().rposition(|outgoing| {
            outgoing.stream == stream && outgoing.contents.is_none() && outgoing.since <= since_max
        })
    }
}

/// What of a budget may go out at once: a share of the second, but always a full datagram.
pub(super) fn burst_bytes(bytes_per_s: u32, burst_ms: u32) -> u32 {
    let share = u64::from(bytes_per_s) * u64::from(burst_ms) / 1_000;
    (share as u32).clamp(1_300, bytes_per_s.max(1_300))
}
