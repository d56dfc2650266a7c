//! A byte budget: a token bucket that spreads, and a sliding second that is never exceeded.
//!
//! Of a budget below [`THIN_BYTES_PER_S`] a full datagram takes more than half a second, so that a limit on every
//! single second would waste up to half of it. There the bucket alone rules: it holds one full datagram, so that
//! in any T seconds at most one full datagram and the budget times T go out.

use flockmap_grid::Stamp;
use flockmap_mutation::{self as mutation, Mutation};
use std::collections::VecDeque;

const SECOND_MICROS: i64 = 1_000_000;
/// Bytes sent within one such slot are counted as sent at its end, so the second is kept to the safe side.
const SLOT_MICROS: i64 = 10_000;
/// Budgets of at least so much hold in every second.
const THIN_BYTES_PER_S: i64 = 2_000;

/// What may go out at once, refilled at a rate.
#[derive(Clone, Debug)]
pub(crate) struct TokenBucket {
    bytes_per_s: i64,
    /// Bytes · 10⁶: what may be sent at once.
    burst: i64,
    tokens: i64,
    filled_at: Stamp,
}

impl TokenBucket {
    pub(crate) fn new(bytes_per_s: u32, burst_bytes: u32) -> Self {
        let burst = i64::from(burst_bytes) * SECOND_MICROS;
        Self { bytes_per_s: i64::from(bytes_per_s), burst, tokens: burst, filled_at: Stamp(i64::MIN) }
    }

    /// Another rate from now on.
    pub(crate) fn set(&mut self, now: Stamp, bytes_per_s: u32, burst_bytes: u32) {
        self.advance(now);
        (self.bytes_per_s, self.burst) = (bytes_per_s.into(), i64::from(burst_bytes) * SECOND_MICROS);
        self.tokens = self.tokens.min(self.burst);
    }

    /// `None` if `bytes` may be sent now, else the earliest time at which they may.
    pub(crate) fn wait(&mut self, now: Stamp, bytes: usize) -> Option<Stamp> {
        self.advance(now);
        // A debt is allowed for one datagram longer than the burst: it is paid before the next.
        let lacking = (bytes as i64 * SECOND_MICROS).min(self.burst) - self.tokens;
        (lacking > 0).then(|| now.plus_micros(ceil_div(lacking, self.bytes_per_s)))
    }

    /// Counts bytes as sent.
    pub(crate) fn spend(&mut self, now: Stamp, bytes: usize) {
        self.advance(now);
        self.tokens -= bytes as i64 * SECOND_MICROS;
    }

    fn advance(&mut self, now: Stamp) {
        let elapsed = now.micros_since(self.filled_at).clamp(0, SECOND_MICROS * 3_600);
        self.tokens = self.tokens.saturating_add(elapsed.saturating_mul(self.bytes_per_s)).min(self.burst);
        self.filled_at = self.filled_at.max(now);
    }
}

/// Says when so many bytes may be sent. Memory: at most 102 slots of 16 bytes.
#[derive(Clone, Debug)]
pub(crate) struct Pacer {
    bytes_per_s: i64,
    bucket: TokenBucket,
    /// Number of the slot and bytes sent in it, over the last second.
    sent: VecDeque<(i64, i64)>,
    sent_sum: i64,
}

impl Pacer {
    /// At most `bytes_per_s` in any second, and at most `burst_bytes` at once; a burst is at least one datagram.
    /// Of less than 2,000 bytes a second: at most `burst_bytes` + `bytes_per_s` · T in any T seconds.
    pub(crate) fn new(bytes_per_s: u32, burst_bytes: u32) -> Self {
        let is_thin = i64::from(bytes_per_s) < THIN_BYTES_PER_S;
        let burst = if is_thin { burst_bytes } else { burst_bytes.min(bytes_per_s) };
        Self {
            bytes_per_s: i64::from(bytes_per_s),
            bucket: TokenBucket::new(bytes_per_s, burst),
            sent: VecDeque::new(),
            sent_sum: 0,
        }
    }

    /// `None` if `bytes` may be sent now, else the earliest time at which they may.
    pub(crate) fn wait(&mut self, now: Stamp, bytes: usize) -> Option<Stamp> {
        if mutation::is(Mutation::BudgetIgnored) {
            return None;
        }
        self.advance(now);
        let bucket = self.bucket.wait(now, bytes);
        if self.bytes_per_s < THIN_BYTES_PER_S {
            return bucket;
        }
        let bytes = (bytes as i64).min(self.bytes_per_s);
        let mut over = self.sent_sum + bytes - self.bytes_per_s;
        let window = (over > 0).then(|| {
            let mut ready = now.plus_micros(1);
            for &(slot, sent) in &self.sent {
                over -= sent;
                ready = Stamp((slot + 1) * SLOT_MICROS + SECOND_MICROS);
                if over <= 0 {
                    break;
                }
            }
            ready.max(now.plus_micros(1))
        });
        bucket.max(window)
    }

    /// Counts bytes as sent.
    pub(crate) fn spend(&mut self, now: Stamp, bytes: usize) {
        self.advance(now);
        self.bucket.spend(now, bytes);
        if self.bytes_per_s < THIN_BYTES_PER_S {
            return;
        }
        self.sent_sum += bytes as i64;
        let slot = now.0.div_euclid(SLOT_MICROS);
        match self.sent.back_mut() {
            Some(last) if last.0 == slot => last.1 += bytes as i64,
            _ => self.sent.push_back((slot, bytes as i64)),
        }
    }

    fn advance(&mut self, now: Stamp) {
        while let Some(&(slot, sent)) = self.sent.front()
            && (slot + 1) * SLOT_MICROS + SECOND_MICROS <= now.0
        {
            self.sent_sum -= sent;
            self.sent.pop_front();
        }
    }
}

/// What of a budget may go out at once: a share of the second, but always a full datagram.
pub(crate) fn burst_bytes(bytes_per_s: u32, burst_ms: u32) -> u32 {
    let share = u64::from(bytes_per_s) * u64::from(burst_ms) / 1_000;
    (share as u32).clamp(1_300, bytes_per_s.max(1_300))
}

const fn ceil_div(a: i64, b: i64) -> i64 {
    (a + b - 1) / b
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn never_more_than_the_budget_in_any_second(
            bytes_per_s in 2_000..200_000u32, burst in 1_300..50_000u32, start in -5_000_000_000i64..5_000_000_000,
            steps in prop::collection::vec((0..300_000i64, 40..1_228usize), 1..400),
        ) {
            let mut pacer = Pacer::new(bytes_per_s, burst);
            let mut now = Stamp(start);
            let mut sent: Vec<(i64, usize)> = Vec::new();
            for (pause, bytes) in steps {
                now = now.plus_micros(if pause < 150_000 { 0 } else { pause });
                let mut waits = 0;
                while let Some(ready) = pacer.wait(now, bytes) {
                    prop_assert!(ready > now, "a wait that does not wait");
                    now = ready;
                    waits += 1;
                    prop_assert!(waits < 5);
                }
                pacer.spend(now, bytes);
                sent.push((now.0, bytes));
                let second: usize = sent.iter().filter(|s| s.0 > now.0 - SECOND_MICROS).map(|s| s.1).sum();
                prop_assert!(second <= bytes_per_s as usize, "{second} bytes in a second");
            }
        }
    }

    proptest! {
        #[test]
        fn a_thin_budget_holds_over_any_time_but_for_one_datagram(
            bytes_per_s in 500..2_000u32, start in -5_000_000_000i64..5_000_000_000,
            steps in prop::collection::vec((0..3_000_000i64, 40..1_228usize), 1..200),
        ) {
            let mut pacer = Pacer::new(bytes_per_s, 1_300);
            let mut now = Stamp(start);
            let mut sent: Vec<(i64, i64)> = Vec::new();
            for (pause, bytes) in steps {
                now = now.plus_micros(if pause < 2_000_000 { 0 } else { pause });
                if let Some(ready) = pacer.wait(now, bytes) {
                    prop_assert!(ready > now, "a wait that does not wait");
                    now = ready;
                    prop_assert_eq!(pacer.wait(now, bytes), None, "the wait was too short");
                }
                pacer.spend(now, bytes);
                sent.push((now.0, bytes as i64));
                let mut sum = 0;
                for &(at, bytes) in sent.iter().rev() {
                    sum += bytes;
                    let allowed = 1_300 * SECOND_MICROS + i64::from(bytes_per_s) * (now.0 - at);
                    prop_assert!(sum * SECOND_MICROS <= allowed, "{sum} bytes in {} µs", now.0 - at);
                }
            }
        }
    }

    #[test]
    fn a_thin_budget_is_used_in_full() {
        for bytes_per_s in [500, 1_024, 1_999] {
            let mut pacer = Pacer::new(bytes_per_s, 1_300);
            let (mut now, mut sent) = (Stamp(0), 0);
            while now < Stamp(100 * SECOND_MICROS) {
                match pacer.wait(now, 1_228) {
                    Some(ready) => now = ready,
                    None => {
                        pacer.spend(now, 1_228);
                        sent += 1_228;
                    }
                }
            }
            assert!(sent > bytes_per_s * 98, "{sent} of {} bytes used", bytes_per_s * 100);
        }
    }

    #[test]
    fn spreads_over_time_and_uses_the_budget() {
        let mut pacer = Pacer::new(10_000, 2_000);
        let (mut now, mut sent) = (Stamp(0), 0);
        while now < Stamp(10 * SECOND_MICROS) {
            match pacer.wait(now, 1_000) {
                Some(ready) => now = ready,
                None => {
                    pacer.spend(now, 1_000);
                    sent += 1_000;
                }
            }
        }
        assert!((95_000..=101_000).contains(&sent), "{sent} of 100,000 bytes used");
    }
}
