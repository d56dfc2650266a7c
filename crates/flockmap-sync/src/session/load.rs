//! What a session holds at the moment, to hold against its limits.

use super::Session;

/// Sizes of what a [`Session`] keeps because of others.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
#[non_exhaustive]
pub struct Load {
    /// Peers known: at most `peers_max`.
    pub peers: usize,
    /// Streams known beside the own one: at most `streams_max`.
    pub streams: usize,
    /// Packages and tiles that wait for what they build on, or for the driver's verdict: at most 4,096.
    pub undecided: usize,
    /// Of these: packages that wait for those that they build on: at most 1,024.
    pub waiting: usize,
    /// Bytes that these take, with 400 bytes of bookkeeping for each: at most 1 MiB.
    pub waiting_bytes: usize,
    /// Packages and tiles that were rejected a moment ago: at most 1,024.
    pub refused: usize,
    /// Present states being received: at most `transfers_max`.
    pub transfers: usize,
    /// Packages sent to one peer and not yet confirmed, of the peer with the most: at most `in_flight_max`, by broadcast twice as many.
    pub in_flight_most: usize,
}

impl Session {
    /// What it holds at the moment. O(peers).
    pub fn load(&self) -> Load {
        let ((undecided, refused), (waiting, waiting_bytes)) = (self.inbox.load(), self.inbox.waiting());
        Load {
            peers: self.peers.len(),
            streams: self.store.streams().count().saturating_sub(1),
            undecided,
            refused,
            waiting,
            waiting_bytes,
            transfers: self.inbox.transfers.len(),
            in_flight_most: self.peers.values().map(|peer| peer.in_flight.len()).max().unwrap_or(0),
        }
    }
}
