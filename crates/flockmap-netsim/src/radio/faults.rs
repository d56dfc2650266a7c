//! What a bad link does to datagrams beside plain loss: it fades for a while, and flips bits.

use super::link::Link;
use flockmap_grid::{RobotId, Stamp};
use flockmap_worlds::random::{Random, mix};
use std::sync::Arc;

/// Bursts and damage of one link as time goes by. Its random numbers are its own: without either none is
/// drawn, and nothing else changes.
#[derive(Clone, Debug)]
pub(super) struct Weather {
    random: Random,
    is_bad: bool,
    until: Stamp,
}

/// Bits to flip: random numbers, of which the receiver of `applied_to` takes as many as it has bits.
#[derive(Clone, Copy, Debug)]
pub(super) struct Flips {
    count: u64,
    seed: u64,
}

impl Weather {
    pub(super) fn new(seed: u64, from: RobotId, to: RobotId) -> Self {
        let purpose = mix(u64::from(from.0) << 16 | u64::from(to.0) | 1 << 40);
        let random = Random::new(seed, purpose);
        Self { random, is_bad: true, until: Stamp(i64::MIN) }
    }

    /// What becomes of a datagram: whether a burst takes it, and the bits that flip.
    pub(super) fn draw(&mut self, link: &Link, at: Stamp) -> (bool, Option<Flips>) {
        let faded = link.burst.is_some_and(|burst| {
            if self.until == Stamp(i64::MIN) {
                self.until = at;
            }
            while self.until <= at {
                self.is_bad = !self.is_bad;
                let mean_ms = if self.is_bad { burst.bad_ms } else { burst.good_ms };
                let micros = 1 + self.random.below(u64::from(mean_ms.max(1)) * 2_000);
                self.until = self.until.plus_micros(micros as i64);
            }
            self.is_bad && self.random.happens(burst.loss)
        });
        let flips = (link.damage > 0.0 && self.random.happens(link.damage))
            .then(|| Flips { count: 1 + self.random.below(3), seed: self.random.next_u64() });
        (faded, flips)
    }
}

impl Flips {
    pub(super) fn applied_to(self, bytes: &[u8]) -> Arc<[u8]> {
        let mut bytes = bytes.to_vec();
        let mut random = Random::new(self.seed, 0);
        for _ in 0..self.count {
            let bit = random.below((bytes.len() as u64 * 8).max(1)) as usize;
            if let Some(byte) = bytes.get_mut(bit / 8) {
                *byte ^= 1 << (bit % 8);
            }
        }
        bytes.into()
    }
}
