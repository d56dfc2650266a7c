//! What is measured of the link to a peer: round trip and offset between the clocks, both from echoed stamps.

use flockmap_grid::Stamp;
use std::collections::VecDeque;

/// Smoothed round-trip time as in RFC 6298, in microseconds.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RoundTrip {
    smoothed: Option<(i64, i64)>,
    initial: i64,
}

/// Variation counts at least this much: timers of operating systems are no finer.
const GRANULARITY: i64 = 5_000;
const TIMEOUT_MIN: i64 = 20_000;
/// A slow radio with a long queue is not a lossy one.
const TIMEOUT_MAX: i64 = 30_000_000;

impl RoundTrip {
    pub(crate) const fn new(initial_micros: i64) -> Self {
        Self { smoothed: None, initial: initial_micros }
    }

    /// Takes a sample in; one out of range (a clock that jumped) is ignored.
    pub(crate) fn sample(&mut self, micros: i64) {
        if !(0..=60_000_000).contains(&micros) {
            return;
        }
        self.smoothed = Some(match self.smoothed {
            None => (micros, micros / 2),
            Some((mean, variation)) => {
                let variation = (3 * variation + (mean - micros).abs()) / 4;
                ((7 * mean + micros) / 8, variation)
            }
        });
    }

    /// The smoothed round trip, once measured.
    pub(crate) fn micros(&self) -> Option<i64> {
        self.smoothed.map(|(mean, _)| mean)
    }

    /// The smoothed variation of the round trip; 0 as long as it is unknown.
    pub(crate) fn variation(&self) -> i64 {
        self.smoothed.map_or(0, |(_, variation)| variation)
    }

    /// After this time without a sign, what was sent counts as lost.
    pub(crate) fn timeout(&self) -> i64 {
        self.smoothed.map_or(self.initial, |(mean, variation)| {
            (mean + (4 * variation).max(GRANULARITY)).clamp(TIMEOUT_MIN, TIMEOUT_MAX)
        })
    }
}

/// All datagrams are lost.
pub(crate) const LOSS_ONE: u32 = 1 << 16;

/// Share of what is sent to a peer that gets lost, smoothed over some 64 packages, in parts of [`LOSS_ONE`].
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Loss(u32);

impl Loss {
    /// Takes in what a request said of packages sent.
    pub(crate) fn sample(&mut self, confirmed: u64, lost: u64) {
        for (count, is_lost) in [(confirmed, false), (lost, true)] {
            for _ in 0..count.min(256) {
                self.0 = self.0 - self.0 / 64 + if is_lost { LOSS_ONE / 64 } else { 0 };
            }
        }
    }

    pub(crate) const fn share(self) -> u32 {
        self.0
    }
}

/// Offset between a peer's clock and the own one, as NTP does it: of the recent exchanges the one with the
/// shortest round trip is the least disturbed by queues.
#[derive(Clone, Debug, Default)]
pub(crate) struct ClockFilter {
    /// When measured, round trip, offset.
    samples: VecDeque<(Stamp, i64, i64)>,
}

const SAMPLES_MAX: usize = 16;
/// Older samples are forgotten, as clocks drift (100 ppm: 3 ms in that time).
const SAMPLE_LIFE: i64 = 30_000_000;

impl ClockFilter {
    /// Takes in an exchange: own send, peer's receipt, peer's send, own receipt. The peer's two are on its clock.
    pub(crate) fn sample(&mut self, sent: Stamp, peer_received: Stamp, peer_sent: Stamp, received: Stamp) {
        let round_trip = received.micros_since(sent).saturating_sub(peer_sent.micros_since(peer_received));
        if !(0..=60_000_000).contains(&round_trip) {
            return;
        }
        let (there, back) = (peer_received.micros_since(sent), peer_sent.micros_since(received));
        let offset = ((i128::from(there) + i128::from(back)).div_euclid(2)) as i64;
        while self.samples.len() >= SAMPLES_MAX
            || self.samples.front().is_some_and(|s| received.micros_since(s.0) > SAMPLE_LIFE)
        {
            self.samples.pop_front();
        }
        self.samples.push_back((received, round_trip, offset));
    }

    /// The peer's clock minus the own clock, in microseconds.
    pub(crate) fn offset(&self) -> Option<i64> {
        self.samples.iter().min_by_key(|s| s.1).map(|s| s.2)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn round_trip_follows_its_samples() {
        let mut round_trip = RoundTrip::new(300_000);
        assert_eq!(round_trip.timeout(), 300_000);
        for _ in 0..50 {
            round_trip.sample(40_000);
        }
        assert_eq!(round_trip.micros(), Some(40_000));
        assert_eq!(round_trip.timeout(), 40_000 + GRANULARITY);
        round_trip.sample(-5);
        assert_eq!(round_trip.micros(), Some(40_000));
        round_trip.sample(200_000);
        assert!(round_trip.timeout() > 100_000);
    }

    #[test]
    fn the_clock_offset_comes_from_the_least_disturbed_exchange() {
        let mut clock = ClockFilter::default();
        let offset = 7_000_000_000;
        for (there, back) in [(90_000, 10_000), (20_000, 20_000), (10_000, 300_000)] {
            let sent = Stamp(1_000);
            let peer_received = Stamp(1_000 + there + offset);
            let peer_sent = peer_received.plus_micros(50_000);
            let received = Stamp(peer_sent.0 - offset + back);
            clock.sample(sent, peer_received, peer_sent, received);
        }
        assert_eq!(clock.offset(), Some(offset));
    }

    #[test]
    fn hostile_stamps_do_no_harm() {
        let mut clock = ClockFilter::default();
        let ends = [Stamp(i64::MIN), Stamp(-1), Stamp(0), Stamp(i64::MAX)];
        for a in ends {
            for b in ends {
                for c in ends {
                    clock.sample(Stamp(5), a, b, c);
                    clock.sample(a, b, c, Stamp(5));
                }
            }
        }
    }
}
