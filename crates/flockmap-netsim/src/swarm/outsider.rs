//! Somebody without the key in reach of the radio: hears everything, and sends it again, changes it, takes
//! the seal off, or seals with a key of its own.

use super::broken::write_check;
use flockmap::Path;
use flockmap::sync::SwarmKey;
use flockmap::sync::wire::{HEADER_BYTES, seal_datagram};
use flockmap_worlds::random::Random;
use std::collections::VecDeque;

/// Datagrams that it remembers.
const HEARD_MAX: usize = 64;
/// The path on which it is heard.
pub(super) const PATH: Path = Path(1 << 32);

pub(super) struct Outsider {
    random: Random,
    /// With the time at which each reaches it: what it sends again is never ahead of the datagram itself.
    heard: VecDeque<(i64, Vec<u8>)>,
    /// When it sends next.
    pub(super) next: i64,
}

/// What the outsider sends to one robot.
pub(super) struct Attack {
    pub(super) bytes: Vec<u8>,
    /// It is a datagram as a robot sent it, and may not have come to this robot before.
    pub(super) is_genuine: bool,
}

impl Outsider {
    pub(super) fn new(mut random: Random) -> Self {
        let next = random.below(1_000_000) as i64;
        Self { random, heard: VecDeque::new(), next }
    }

    /// A datagram goes out, and is heard at `at`.
    pub(super) fn hear(&mut self, at: i64, bytes: &[u8]) {
        if self.heard.len() >= HEARD_MAX {
            self.heard.pop_front();
        }
        self.heard.push_back((at, bytes.to_vec()));
    }

    /// What it sends now, and to which of so many robots.
    pub(super) fn attack(&mut self, now: i64, robots: usize) -> Option<(usize, Attack)> {
        self.next = now + 10_000 + self.random.below(250_000) as i64;
        let number = self.random.below(self.heard.len().max(1) as u64) as usize;
        let (heard_at, mut bytes) = self.heard.get(number)?.clone();
        let kind = self.random.below(4);
        match kind {
            0 => {}
            1 => {
                let bit = self.random.below(bytes.len() as u64 * 8) as usize;
                bytes[bit / 8] ^= 1 << (bit % 8);
            }
            2 => bytes = self.without_seal(&bytes)?,
            _ => {
                let plain = self.without_seal(&bytes)?;
                let key = SwarmKey::from_bytes([0x5a; SwarmKey::BYTES]);
                bytes = seal_datagram(&key, &[0x5a; 16], &plain, None, 1 << 20)?;
            }
        }
        let to = self.random.below(robots as u64) as usize;
        (heard_at <= now).then_some((to, Attack { bytes, is_genuine: kind == 0 }))
    }

    /// A request in the name of the sender, as a robot without a key would send it.
    fn without_seal(&mut self, sealed: &[u8]) -> Option<Vec<u8>> {
        let mut bytes = sealed.get(..HEADER_BYTES)?.to_vec();
        bytes[3] = 1;
        // All streams, all echoes, and none of either: the sender has lost everything.
        bytes.push(3);
        bytes[16..24].copy_from_slice(&self.random.next_u64().to_le_bytes());
        write_check(&mut bytes);
        Some(bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_outsider_sends_again_is_never_ahead_of_the_datagram_itself() {
        let mut outsider = Outsider::new(Random::new(1, 2));
        outsider.hear(5_000, &[0; 60]);
        let mut attacks = |from: i64| (from..from + 100).filter_map(|now| outsider.attack(now, 3)).count();
        assert_eq!(attacks(4_900), 0);
        assert!(attacks(5_000) > 0);
    }
}
