//! How much of the own map the budget takes at the moment: what a driver needs to know to merge changes
//! before they become packages.

use super::Session;
use super::plan::BACKLOG_MIN;
use crate::Cast;
use crate::peer::{Peer, PeerStream};
use crate::report::Pace;
use flockmap_grid::Stamp;

impl Session {
    /// What the budget leaves for own packages.
    ///
    /// Only peers count that hear this robot and are not silent. One that catches up, since it lacks more
    /// than 64 stored packages, counts only if there is no other. O(peers).
    pub fn pace(&self, now: Stamp) -> Pace {
        let newest = self.store.newest_known(self.identity.own);
        let listens = |peer: &&Peer| {
            peer.hears(self.identity.own.origin) && !peer.is_silent(now) && peer.wants(self.identity.own)
        };
        let (mut in_step, mut catching_up, mut waits) = (0, 0, false);
        for peer in self.peers.values().filter(listens) {
            // What is not stored any more cannot be sent as a package, and waits for nothing here.
            let stored = |(low, high)| self.store.range(self.identity.own, low, high);
            let missing = match peer.streams.get(&self.identity.own) {
                Some(PeerStream { sending: Some(_), .. }) => usize::MAX,
                Some(theirs) => {
                    let gaps = theirs.received_or_in_flight.missing(theirs.from.max(1), newest);
                    gaps.flat_map(stored).take(BACKLOG_MIN as usize + 1).count()
                }
                None if peer.takes_unnamed(self.identity.own) => {
                    stored((1, newest)).take(BACKLOG_MIN as usize + 1).count()
                }
                None => continue,
            };
            if missing > BACKLOG_MIN as usize {
                catching_up += 1;
            } else {
                in_step += 1;
                waits |= missing > 0;
            }
        }
        let copies = match self.config.cast {
            Cast::Unicast => in_step + catching_up,
            Cast::Broadcast => 1,
        };
        let radio = self.radio_bytes_per_s().map(|rate| rate / copies.max(1));
        match radio.into_iter().chain(self.config.link_bytes_per_s).min() {
            Some(bytes_per_s) if waits || (in_step == 0 && catching_up > 0) => Pace::Waiting { bytes_per_s },
            Some(bytes_per_s) if in_step > 0 => Pace::AllSent { bytes_per_s },
            _ => Pace::Free,
        }
    }
}
