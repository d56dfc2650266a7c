//! When requests go out.

use crate::timers::{Timer, Timers};
use core::time::Duration;
use flockmap_grid::{RobotId, Stamp, Stream};

/// When requests are due, and where they begin.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Schedule {
    pub(crate) timers: Timers,
    random: u64,
    /// Requests for gaps since one was filled last, or a new one was seen.
    pub(crate) gap_tries: u32,
    /// Where many lack the same, one after the other asks: how much later than it could this robot does, in parts of
    /// [`GAP_SLOTS`](Self::GAP_SLOTS) of the pause between two requests.
    pub(crate) gap_slot: u64,
    /// Requests for gaps that others' took the place of, since one went out.
    pub(crate) gaps_asked_by_others: u32,
    pub(crate) probes_left: u8,
    /// Bytes of own obstacles since the last probe; and the earliest time of the next one.
    pub(crate) unprobed: usize,
    pub(crate) probe_from: Stamp,
    /// The newest own package that was sent.
    pub(crate) newest_sent: u32,
    /// When a probe last showed a gap here.
    pub(crate) probed: Stamp,
    /// Greetings that followed each other.
    pub(crate) greetings: u32,
    pub(crate) last: Stamp,
    /// Bytes of the last whole request and of the last short one, and how many copies went out: what follows leaves most of
    /// a small budget to packages.
    pub(crate) whole_bytes: (usize, usize),
    pub(crate) short_bytes: (usize, usize),
    /// Until then the budget takes no request.
    pub(crate) blocked_until: Option<Stamp>,
    /// When the last whole one went out.
    pub(crate) last_whole: Stamp,
    pub(crate) last_activity: Stamp,
    /// Requests made: lists that do not fit begin at another place each time.
    pub(crate) count: usize,
    /// Whole ones that went out to everyone.
    pub(crate) wholes: u32,
    /// The first origin that the next request covers; and how often all were.
    pub(crate) cursor: RobotId,
    pub(crate) rounds: u32,
    /// A run of a robot that was heard in an earlier one: it should learn of it soon.
    pub(crate) superseded: Option<Stream>,
    pub(crate) superseded_sent: Option<Stamp>,
}

impl Schedule {
    pub(crate) const GAP_SLOTS: u64 = 64;

    /// The first request is due at once.
    pub(crate) fn new(seed: u64) -> Self {
        let never = Stamp(i64::MIN);
        let mut timers = Timers::default();
        timers.set(Timer::Request, never);
        Self {
            timers,
            random: seed,
            gap_tries: 0,
            gap_slot: seed % Self::GAP_SLOTS,
            gaps_asked_by_others: 0,
            probes_left: 0,
            unprobed: 0,
            probe_from: never,
            newest_sent: 0,
            probed: never,
            greetings: 0,
            last: never,
            whole_bytes: (0, 0),
            short_bytes: (0, 0),
            blocked_until: None,
            last_whole: never,
            last_activity: never,
            count: 0,
            wholes: 0,
            cursor: RobotId(0),
            rounds: 0,
            superseded: None,
            superseded_sent: None,
        }
    }

    /// Another place among those who lack the same.
    pub(crate) fn draw_gap_slot(&mut self) {
        self.gap_slot = self.random(Self::GAP_SLOTS);
    }

    /// A span below this one.
    pub(crate) fn jitter(&mut self, below: Duration) -> Duration {
        Duration::from_micros(self.random(below.as_micros() as u64))
    }

    /// A number from 0 to `below` − 1 (SplitMix64).
    pub(crate) fn random(&mut self, below: u64) -> u64 {
        self.random = self.random.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.random;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) % below.max(1)
    }
}
