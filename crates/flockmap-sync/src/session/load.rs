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
    /// Packages and tiles that wait for the driver's verdict: at most 4,096.
    pub undecided: usize,
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
        Load {
            peers: self.peers.len(),
            streams: self.store.streams().count().saturating_sub(1),
            undecided: self.undecided.len(),
            refused: self.refused.len(),
            transfers: self.incoming.len(),
            in_flight_most: self.peers.values().map(|peer| peer.in_flight.len()).max().unwrap_or(0),
        }
    }
}
