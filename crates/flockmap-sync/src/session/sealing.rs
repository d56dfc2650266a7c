//! What a swarm key changes in a session: datagrams are sealed as they go out, and proved before anything of them counts.

use super::{Event, Session, Transmit};
use crate::replay::NotFresh;
use crate::wire::{DatagramError, OpenedDatagram, SEAL_BYTES, SealedDatagram, seal_datagram};
use flockmap_grid::Stamp;
use flockmap_grid::mutation::{self, Mutation};

/// The counter of a datagram is the number of the start, 12 bits, then the number of the datagram in it, so many bits.
const START_BITS: u32 = 36;
/// Most that a run can be started again.
pub(crate) const RESTARTS_MAX: u16 = (1 << 12) - 1;

/// The counter before the first of a start.
pub(super) const fn counter_before(restarts: u16) -> u64 {
    (restarts as u64) << START_BITS
}

impl Session {
    /// Whether no datagram can be sealed any more: one more would need a nonce that belongs to a later start. Tells the
    /// driver, once.
    pub(super) fn check_spent(&mut self) -> bool {
        if self.is_spent() && !self.spent_told {
            self.spent_told = true;
            self.push_event(Event::CountersSpent);
        }
        self.is_spent()
    }

    pub(super) const fn is_spent(&self) -> bool {
        self.config.swarm_key.is_some() && (self.sealed + 1) >> START_BITS > self.config.restarts as u64
    }

    /// Seals a datagram that is about to go out, if there is a key.
    pub(super) fn seal(&mut self, transmit: Transmit) -> Option<Transmit> {
        let Some(key) = &self.config.swarm_key else { return Some(transmit) };
        let bytes = seal_datagram(key, &transmit.bytes, self.sealed + 1)?;
        debug_assert!(bytes.len() <= self.config.datagram_bytes_max, "{} bytes sealed", bytes.len());
        self.sealed += u64::from(!mutation::is(Mutation::NonceRepeated));
        Some(Transmit { to: transmit.to, bytes })
    }

    /// Proves and opens a received datagram. Changes nothing if it is not genuine.
    pub(super) fn open(&mut self, now: Stamp, bytes: &[u8]) -> Result<OpenedDatagram, DatagramError> {
        let datagram = SealedDatagram::new_checked(bytes)?;
        self.check_swarm(datagram.swarm())?;
        let (sender, counter) = (datagram.sender(), datagram.counter());
        let Some(key) = &self.config.swarm_key else {
            return Err(DatagramError::SealedWithoutKey { sender: sender.origin });
        };
        let opened = datagram.open(key)?;
        if sender.origin == self.own.origin {
            self.check_own(now, sender.epoch, counter)?;
            return Ok(opened);
        }
        let fresh = self.replays.check(sender, counter);
        let fresh = if mutation::is(Mutation::ReplayAccepted) { Ok(()) } else { fresh };
        fresh.map_err(|not_fresh| match not_fresh {
            NotFresh::Replayed => DatagramError::Replayed { sender: sender.origin, counter },
            NotFresh::Stale(current) => {
                DatagramError::StaleEpoch { sender: sender.origin, got: sender.epoch, current }
            }
        })?;
        self.replays.note(sender, counter, self.peers.contains_key(&sender.origin));
        Ok(opened)
    }

    /// A genuine datagram in the own name: of a former run, if somebody replays it; of another robot, if its number was never
    /// given here; else an own one heard back.
    fn check_own(&mut self, now: Stamp, epoch: u32, counter: u64) -> Result<(), DatagramError> {
        let (id, current) = (self.own.origin, self.own.epoch);
        if epoch < current {
            return Err(DatagramError::StaleEpoch { sender: id, got: epoch, current });
        }
        if epoch == current && counter > self.sealed {
            self.tell_same_identity(now);
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

    /// Bytes that sealing adds to each datagram.
    pub(super) const fn seal_bytes(&self) -> usize {
        if self.config.swarm_key.is_some() { SEAL_BYTES } else { 0 }
    }

    /// Longest datagram before it is sealed.
    pub(super) const fn plain_bytes_max(&self) -> usize {
        self.config.datagram_bytes_max - self.seal_bytes()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Session, SessionConfig, SwarmKey};
    use flockmap_grid::{RobotId, Stream};

    fn session(id: u16, restarts: u16) -> Session {
        let swarm_key = Some(SwarmKey::from_bytes([9; 32]));
        let config = SessionConfig { swarm_key, restarts, ..SessionConfig::default() };
        Session::new(Stream { origin: RobotId(id), epoch: 1 }, config, 1).unwrap()
    }

    #[test]
    fn at_the_end_of_its_counters_a_session_falls_silent_and_says_so_once() {
        for restarts in [0, 1, RESTARTS_MAX] {
            let mut session = session(1, restarts);
            let last = counter_before(restarts) + (1 << START_BITS) - 1;
            session.sealed = last - 1;
            let bytes = session.poll_transmit(Stamp(0)).unwrap().bytes;
            assert_eq!(SealedDatagram::new_checked(&bytes).unwrap().counter(), last);
            assert!(last < counter_before(restarts + 1) && last <= crate::wire::COUNTER_MAX);
            for second in 1..100 {
                let now = Stamp(second * 1_000_000);
                assert_eq!(session.poll_transmit(now), None);
                assert_eq!(session.poll_timeout(), None, "nothing to wait for");
            }
            assert!(matches!(session.poll_event(), Some(Event::CountersSpent)));
            assert!(session.poll_event().is_none());
        }
    }

    #[test]
    fn a_run_that_goes_on_after_a_restart_is_heard_and_repeats_no_counter() {
        let (mut first, mut again, mut other) = (session(1, 0), session(1, 1), session(2, 0));
        let mut counters = std::collections::BTreeSet::new();
        for (session, start) in [(&mut first, 0), (&mut again, 10)] {
            for second in start..start + 10 {
                let now = Stamp(second * 1_000_000);
                while let Some(transmit) = session.poll_transmit(now) {
                    let counter = SealedDatagram::new_checked(&transmit.bytes).unwrap().counter();
                    assert!(counters.insert(counter), "counter {counter} came twice");
                    other.handle_datagram(now, &transmit.bytes).unwrap();
                }
            }
        }
        assert!(counters.len() > 4 && other.counters().replayed == 0);
        // The start before it is heard no more.
        let late = first.poll_transmit(Stamp(30_000_000)).unwrap().bytes;
        assert!(matches!(
            other.handle_datagram(Stamp(30_000_000), &late),
            Err(DatagramError::Replayed { .. })
        ));
    }

    #[test]
    fn windows_are_kept_for_peers_only() {
        let config = SessionConfig { peers_max: 4, ..session(1, 0).config };
        let mut receiver = Session::new(Stream { origin: RobotId(1), epoch: 1 }, config, 1).unwrap();
        for second in 0..9 {
            for id in 2..40 {
                let mut sender = session(id, 0);
                sender.sealed = second as u64;
                let bytes = sender.poll_transmit(Stamp(0)).unwrap().bytes;
                let _ = receiver.handle_datagram(Stamp(second * 1_000_000), &bytes);
            }
        }
        assert_eq!((receiver.peers().count(), receiver.replays.windows()), (4, 4));
        assert!(receiver.counters().too_many_peers > 100);
        receiver.handle_timeout(Stamp(60_000_000));
        assert_eq!((receiver.peers().count(), receiver.replays.windows()), (0, 0));
    }
}
