//! Losses of own datagrams, as far as they show that a queue overflows: a radio loses some whatever is sent.

use super::queueing::Least;
use crate::link::LOSS_ONE;
use core::time::Duration;
use flockmap_grid::Stamp;

/// Losses are smoothed over so many datagrams …
const SMOOTHED_OVER: u32 = 32;
/// … and judged by so many of those sent since the rate went down last.
const JUDGED_BY: u32 = 16;
/// What is usual is known after so many.
const KNOWN_AFTER: u32 = 64;
const SPAN: Duration = Duration::from_secs(60);

#[derive(Clone, Debug)]
pub(super) struct Losses {
    /// Smoothed, in parts of [`LOSS_ONE`].
    share: u32,
    /// Datagrams since the rate went down last, and in all.
    count: u32,
    all: u32,
    /// The least share of one to two minutes.
    usual: Least,
}

impl Losses {
    pub(super) const fn new() -> Self {
        Self { share: 0, count: 0, all: 0, usual: Least::new(SPAN) }
    }

    pub(super) fn note(&mut self, now: Stamp, is_lost: bool) {
        self.count = self.count.saturating_add(1);
        self.share =
            self.share - self.share / SMOOTHED_OVER + if is_lost { LOSS_ONE / SMOOTHED_OVER } else { 0 };
        self.all = self.all.saturating_add(1);
        if self.all >= KNOWN_AFTER {
            self.usual.note(now, self.share.into());
        }
    }

    /// The rate went down: what gets lost of what is sent from now on is to be seen.
    pub(super) fn begin_anew(&mut self) {
        (self.share, self.count) = (self.usual.get().map_or(0, |usual| self.share.min(usual as u32)), 0);
    }

    /// Of so many bytes so many arrive.
    pub(super) fn arriving(&self, bytes: i64) -> i64 {
        bytes * i64::from(LOSS_ONE.saturating_sub(self.share)) / i64::from(LOSS_ONE)
    }

    /// More than usual, by more than chance explains: the least of many smoothed shares lies below their mean by some two
    /// of their deviations.
    pub(super) fn is_unusual(&self) -> bool {
        let Some(usual) = self.usual.get().map(|usual| usual as u32) else { return false };
        let chance = (u64::from(usual) * u64::from(LOSS_ONE)).isqrt() as u32;
        self.count >= JUDGED_BY && self.share > usual + LOSS_ONE / 16 + chance * 12 / 10
    }
}
