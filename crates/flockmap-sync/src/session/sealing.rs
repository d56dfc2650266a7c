//! What a swarm key changes in a session: datagrams are sealed as they go out, and authenticated before
//! anything of them counts.

use super::Session;
use crate::event::{Destination, Event, Transmit};
use crate::replay::NotFresh;
use crate::wire::{
    COUNTER_MAX, DatagramError, Kind, OpenedDatagram, Request, SealedDatagram, seal_bytes, seal_datagram,
};
use flockmap_grid::{Stamp, Stream};
use flockmap_mutation::{self as mutation, Mutation};

impl Session {
    /// Whether some datagram cannot be sealed any more: one more would need a nonce that was used. Reports it
    /// to the driver, once.
    pub(super) fn check_exhausted(&mut self) -> bool {
        if self.is_exhausted() && !self.identity.exhausted_sent {
            self.identity.exhausted_sent = true;
            self.push_event(Event::NoncesExhausted);
        }
        self.is_exhausted()
    }

    pub(super) fn is_exhausted(&self) -> bool {
        self.config.swarm_key.is_some() && self.identity.sealed.is_exhausted
    }

    /// Seals a datagram that is about to go out, if there is a key.
    pub(super) fn seal(&mut self, transmit: Transmit) -> Option<Transmit> {
        let Some(key) = &self.config.swarm_key else { return Some(transmit) };
        let recipient = match transmit.to {
            Destination::Peer(robot) => Some(robot),
            Destination::Everyone => None,
        };
        let last = self.identity.sealed.last_mut(recipient);
        let bytes = seal_datagram(key, &self.config.salt, &transmit.bytes, recipient, *last + 1)?;
        debug_assert!(bytes.len() <= self.config.datagram_bytes_max, "{} bytes sealed", bytes.len());
        *last += u64::from(!mutation::is(Mutation::NonceRepeated));
        self.identity.sealed.is_exhausted |= *last >= COUNTER_MAX;
        Some(Transmit { bytes, ..transmit })
    }

    /// Proves and opens a received datagram. Changes nothing if it is not genuine.
    pub(super) fn open(&mut self, now: Stamp, bytes: &[u8]) -> Result<OpenedDatagram, DatagramError> {
        let datagram = SealedDatagram::new_checked(bytes)?;
        self.check_swarm(datagram.swarm())?;
        let (sender, counter, is_for_one) = (datagram.sender(), datagram.counter(), datagram.is_for_one());
        let Some(key) = &self.config.swarm_key else {
            return Err(DatagramError::SealedWithoutKey { sender: sender.origin });
        };
        let known = if sender == self.identity.own {
            Some(self.config.salt)
        } else {
            self.identity.replays.salt(sender)
        };
        let salt = datagram.salt().or(known).ok_or(DatagramError::UnknownRun { sender: sender.origin })?;
        let opened = datagram.open(key, &salt, self.identity.own.origin)?;
        if sender.origin == self.identity.own.origin {
            self.check_own(now, sender, salt)?;
            return Ok(opened);
        }
        if known.is_some_and(|known| known != salt) {
            // Two runs of one robot with the same epoch: with probability 1 in in 2³², else a driver that
            // does not draw its epochs.
            return Err(DatagramError::Replayed { sender: sender.origin, counter });
        }
        let fresh = self.identity.replays.check(sender, is_for_one, counter);
        let fresh = if mutation::is(Mutation::ReplayAccepted) { Ok(()) } else { fresh };
        fresh.map_err(|not_fresh| match not_fresh {
            NotFresh::Replayed => DatagramError::Replayed { sender: sender.origin, counter },
            NotFresh::Stale(current) => {
                if let Ok(request) = opened.datagram().and_then(|datagram| Request::parse(&datagram, 1)) {
                    self.note_own_runs(now, &request);
                }
                self.send_superseded(now, Stream { epoch: current, ..sender });
                DatagramError::StaleEpoch { sender: sender.origin, got: sender.epoch, current }
            }
        })?;
        let is_peer = self.peers.contains_key(&sender.origin);
        self.identity.replays.note(sender, salt, is_for_one, counter, is_peer);
        Ok(opened)
    }

    /// A genuine datagram in the own name: of a former run, if somebody replays it; of another robot, if it
    /// is sealed by another run; else an own one heard back.
    fn check_own(&mut self, now: Stamp, sender: Stream, salt: [u8; 16]) -> Result<(), DatagramError> {
        let (id, current) = (self.identity.own.origin, self.identity.own.epoch);
        if sender.epoch < current {
            return Err(DatagramError::StaleEpoch { sender: id, got: sender.epoch, current });
        }
        if sender.epoch == current && salt != self.config.salt {
            self.send_same_identity(now);
            return Err(DatagramError::SameIdentity { id });
        }
        Ok(())
    }

    pub(super) const fn check_swarm(&self, got: u16) -> Result<(), DatagramError> {
        if got == self.config.swarm {
            Ok(())
        } else {
            Err(DatagramError::Swarm { got, expected: self.config.swarm })
        }
    }

    /// Bytes that sealing adds to a datagram of this kind.
    pub(super) const fn seal_bytes(&self, kind: Kind) -> usize {
        if self.config.swarm_key.is_some() { seal_bytes(kind) } else { 0 }
    }

    /// Longest datagram of this kind before it is sealed.
    pub(super) const fn plain_bytes_max(&self, kind: Kind) -> usize {
        self.config.datagram_bytes_max - self.seal_bytes(kind)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::path::Path;
    use crate::{SessionConfig, SwarmKey};
    use flockmap_grid::RobotId;

    fn session(id: u16, epoch: u64) -> Session {
        let swarm_key = Some(SwarmKey::from_bytes([9; 32]));
        let config = SessionConfig { swarm_key, salt: [id as u8 + 1; 16], ..SessionConfig::default() };
        Session::new(Stream { origin: RobotId(id), epoch }, config, 1).unwrap()
    }

    #[test]
    fn at_the_end_of_its_counters_a_session_falls_silent_and_says_so_once() {
        let mut session = session(1, 1);
        session.identity.sealed.for_all = COUNTER_MAX - 1;
        let bytes = session.poll_transmit(Stamp(0)).unwrap().bytes;
        assert_eq!(SealedDatagram::new_checked(&bytes).unwrap().counter(), COUNTER_MAX);
        for second in 1..100 {
            let now = Stamp(second * 1_000_000);
            assert_eq!(session.poll_transmit(now), None);
            assert_eq!(session.poll_timeout(), None, "nothing to wait for");
        }
        assert!(matches!(session.poll_event(), Some(Event::NoncesExhausted)));
        assert!(session.poll_event().is_none());
    }

    #[test]
    fn what_is_for_one_robot_no_other_can_open() {
        let (mut one, mut two, mut three) = (session(1, 1), session(2, 1), session(3, 1));
        let request = one.poll_transmit(Stamp(0)).unwrap().bytes;
        two.handle_datagram(Stamp(0), &request).unwrap();
        three.handle_datagram(Stamp(0), &request).unwrap();
        let header = one.header(Stamp(1), Kind::Packages);
        let plain = crate::wire::PackagesWriter::new(header, 1_000).finish();
        let to = Destination::Peer(RobotId(2));
        let sealed = one.seal(Transmit { to, path: None, bytes: plain }).unwrap().bytes;
        assert!(matches!(three.handle_datagram(Stamp(1), &sealed), Err(DatagramError::Forged { .. })));
        two.handle_datagram(Stamp(1), &sealed).unwrap();
        assert!(matches!(two.handle_datagram(Stamp(1), &sealed), Err(DatagramError::Replayed { .. })));
    }

    #[test]
    fn a_datagram_before_the_first_request_of_its_run_is_counted_and_not_believed() {
        let (mut one, mut two) = (session(1, 1), session(2, 1));
        let header = one.header(Stamp(1), Kind::Packages);
        let plain = crate::wire::PackagesWriter::new(header, 1_000).finish();
        let sealed =
            one.seal(Transmit { to: Destination::Everyone, path: None, bytes: plain }).unwrap().bytes;
        let unknown = DatagramError::UnknownRun { sender: RobotId(1) };
        assert_eq!(two.handle_datagram(Stamp(1), &sealed), Err(unknown));
        assert_eq!((two.counters().unknown_run, two.peers().count()), (1, 0));
        let request = one.poll_transmit(Stamp(2)).unwrap().bytes;
        two.handle_datagram(Stamp(2), &request).unwrap();
        two.handle_datagram(Stamp(3), &sealed).unwrap_err();
    }

    #[test]
    fn robots_of_which_one_knows_an_address_meet_though_challenges_come_before_requests() {
        let (mut one, mut two) = (session(1, 1), session(2, 1));
        let (at_one, at_two) = (Path(1), Path(2));
        // Two knows no address: of what it sends only that on a path arrives.
        for step in 0..40 {
            let now = Stamp(step * 100_000);
            while let Some(transmit) = one.poll_transmit(now) {
                two.handle_datagram_from(now, at_one, &transmit.bytes).unwrap();
            }
            while let Some(transmit) = two.poll_transmit(now) {
                if transmit.path == Some(at_one) {
                    one.handle_datagram_from(now, at_two, &transmit.bytes).unwrap();
                }
            }
        }
        assert_eq!(two.paths().collect::<Vec<_>>(), [(RobotId(1), at_one)]);
        assert_eq!(one.paths().collect::<Vec<_>>(), [(RobotId(2), at_two)]);
        assert_eq!((one.counters().unknown_run, two.counters().unknown_run), (0, 0));
    }

    #[test]
    fn windows_are_kept_for_peers_only() {
        let config = SessionConfig { peers_max: 4, ..session(1, 1).config };
        let mut receiver = Session::new(Stream { origin: RobotId(1), epoch: 1 }, config, 1).unwrap();
        for second in 0..9 {
            for id in 2..40 {
                let mut sender = session(id, 1);
                sender.identity.sealed.for_all = second as u64;
                let bytes = sender.poll_transmit(Stamp(0)).unwrap().bytes;
                let _ = receiver.handle_datagram(Stamp(second * 1_000_000), &bytes);
            }
        }
        assert_eq!((receiver.peers().count(), receiver.identity.replays.windows()), (4, 4));
        assert!(receiver.counters().too_many_peers > 100);
        receiver.handle_timeout(Stamp(60_000_000));
        assert_eq!((receiver.peers().count(), receiver.identity.replays.windows()), (0, 0));
    }
}
