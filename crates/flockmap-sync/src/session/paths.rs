//! Where peers are reached: an address is used only after a round trip through it, as QUIC validates paths
//! (RFC 9000, section 8.2). Else who copies a robot's datagrams from an address of its own would draw the
//! traffic for that robot there.

use super::Session;
use crate::Cast;
use crate::event::{Destination, Transmit};
use crate::path::{Path, PeerPath};
use crate::wire::{Kind, PathMessage};
use core::time::Duration;
use flockmap_grid::{RobotId, Stamp};
use flockmap_mutation::{self as mutation, Mutation};

/// Challenges and answers that wait to be sent; more are dropped, and come again.
const WAITING_MAX: usize = 64;
/// Least pause between two challenges to a peer: each is an answer to a datagram, and not longer than the
/// shortest of these.
const CHALLENGE_PAUSE: Duration = Duration::from_millis(200);

fn challenge_pause() -> Duration {
    if mutation::is(Mutation::PathAskedAtOnce) { Duration::ZERO } else { CHALLENGE_PAUSE }
}

impl Session {
    /// The paths on which peers are reached: where what is for everyone goes, beside the addresses that the
    /// driver knows.
    pub fn paths(&self) -> impl Iterator<Item = (RobotId, Path)> + '_ {
        self.peers.iter().filter_map(|(id, peer)| Some((*id, peer.path.valid()?)))
    }

    /// A sound datagram of a peer came on this path.
    pub(super) fn note_path(&mut self, now: Stamp, id: RobotId, path: Path) {
        if self.config.cast == Cast::Broadcast {
            return;
        }
        let number = self.schedule.random(u64::MAX);
        let Some(peer) = self.peers.get_mut(&id) else { return };
        if mutation::is(Mutation::PathUnasked) {
            peer.path.valid = Some(path);
        }
        if peer.path.valid == Some(path) {
            // It is where it was.
            peer.path.tried = None;
            return self.drop_challenge(id);
        }
        let number = match peer.path.tried {
            Some((.., at)) if now.since(at) < challenge_pause() => return,
            Some((tried, number, _)) if tried == path => number,
            _ => number,
        };
        peer.path.tried = Some((path, number, now));
        self.say_on_path(id, path, PathMessage { challenge: Some(number), answer: None });
    }

    /// What a peer says of paths.
    pub(super) fn handle_path(&mut self, now: Stamp, id: RobotId, path: Option<Path>, message: PathMessage) {
        if let (Some(path), Some(number)) = (path, message.challenge) {
            // Back to where it came from, whatever is known of that: it is as long as what came.
            self.say_on_path(id, path, PathMessage { challenge: None, answer: Some(number) });
        }
        let Some(peer) = self.peers.get_mut(&id) else { return };
        if let Some((tried, number, _)) = peer.path.tried
            && message.answer == Some(number)
        {
            peer.path = PeerPath { valid: Some(tried), tried: None };
            peer.queue_stale = true;
            self.report.counters.paths_validated += 1;
            self.drop_challenge(id);
            self.greet(now);
        }
    }

    /// The address of a peer is known: a challenge to it that still waits is not sent.
    fn drop_challenge(&mut self, id: RobotId) {
        self.outbox.path_waiting.retain(|(to, _, message)| *to != id || message.challenge.is_none());
    }

    /// While the budget is exhausted, one challenge waits for each peer and one answer for each of its paths. A newer one
    /// replaces it.
    fn say_on_path(&mut self, id: RobotId, path: Path, message: PathMessage) {
        let is_challenge = message.challenge.is_some();
        let takes_place_of = |(to, on, before): &&mut (RobotId, Path, PathMessage)| {
            *to == id && before.challenge.is_some() == is_challenge && (is_challenge || *on == path)
        };
        let waiting = &mut self.outbox.path_waiting;
        if let Some(before) = waiting.iter_mut().find(takes_place_of) {
            *before = (id, path, message);
        } else if waiting.len() < WAITING_MAX {
            waiting.push_back((id, path, message));
        }
    }

    /// The next challenge or answer.
    pub(super) fn transmit_path(&mut self, now: Stamp) -> Option<Transmit> {
        let &(id, path, message) = self.outbox.path_waiting.front()?;
        let bytes = message.emit(self.header(now, Kind::Path));
        let cost = bytes.len() + self.overhead(Kind::Path);
        if !self.spend(now, Destination::Peer(id), cost, 1) {
            return None;
        }
        self.outbox.path_waiting.pop_front();
        self.report.counters.paths_out.add(1, cost);
        Some(Transmit { to: Destination::Peer(id), path: Some(path), bytes })
    }
}
