//! What is measured of the link to a peer: round trip and offset between the clocks, both from echoed stamps.

use core::time::Duration;
use flockmap_grid::Stamp;
use std::collections::VecDeque;

/// Smoothed round-trip time as in RFC 6298.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RoundTrip {
    /// Mean and variation in microseconds.
    smoothed_micros: Option<(u64, u64)>,
    initial: Duration,
}

/// Variation counts at least this much: timers of operating systems are no finer.
const GRANULARITY_MICROS: u64 = 5_000;
const TIMEOUT_MIN: Duration = Duration::from_millis(20);
/// Samples out of this range come of a clock that jumped.
const SAMPLE_MAX: Duration = Duration::from_secs(60);
/// A slow radio with a long queue is not a lossy one.
pub(crate) const TIMEOUT_MAX: Duration = Duration::from_secs(30);

impl RoundTrip {
    pub(crate) const fn new(initial: Duration) -> Self {
        Self { smoothed_micros: None, initial }
    }

    /// Takes a sample in; one out of range (a clock that jumped) is ignored.
    pub(crate) fn sample(&mut self, round_trip: Duration) {
        if round_trip > SAMPLE_MAX {
            return;
        }
        let micros = round_trip.as_micros() as u64;
        self.smoothed_micros = Some(match self.smoothed_micros {
            None => (micros, micros / 2),
            Some((mean, variation)) => {
                let variation = (3 * variation + mean.abs_diff(micros)) / 4;
                ((7 * mean + micros) / 8, variation)
            }
        });
    }

    /// The smoothed round trip, once measured.
    pub(crate) fn mean(&self) -> Option<Duration> {
        self.smoothed_micros.map(|(mean, _)| Duration::from_micros(mean))
    }

    /// The smoothed variation of the round trip; zero as long as it is unknown.
    pub(crate) fn variation(&self) -> Duration {
        Duration::from_micros(self.smoothed_micros.map_or(0, |(_, variation)| variation))
    }

    /// After this time without a sign, what was sent counts as lost.
    pub(crate) fn timeout(&self) -> Duration {
        self.smoothed_micros.map_or(self.initial, |(mean, variation)| {
            let micros = mean + (4 * variation).max(GRANULARITY_MICROS);
            Duration::from_micros(micros).clamp(TIMEOUT_MIN, TIMEOUT_MAX)
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
const SAMPLE_LIFE: Duration = Duration::from_secs(30);

impl ClockFilter {
    /// Takes in an exchange: own send, peer's receipt, peer's send, own receipt. The peer's two are on its clock.
    pub(crate) fn sample(&mut self, sent: Stamp, peer_received: Stamp, peer_sent: Stamp, received: Stamp) {
        let round_trip = received.micros_since(sent).saturating_sub(peer_sent.micros_since(peer_received));
        if !(0..=SAMPLE_MAX.as_micros() as i64).contains(&round_trip) {
            return;
        }
        let (there, back) = (peer_received.micros_since(sent), peer_sent.micros_since(received));
        let offset = ((i128::from(there) + i128::from(back)).div_euclid(2)) as i64;
        while self.samples.len() >= SAMPLES_MAX
            || self.samples.front().is_some_and(|s| received.since(s.0) > SAMPLE_LIFE)
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
        let mut round_trip = RoundTrip::new(Duration::from_millis(300));
        assert_eq!(round_trip.timeout(), Duration::from_millis(300));
        for _ in 0..50 {
            round_trip.sample(Duration::from_millis(40));
        }
        assert_eq!(round_trip.mean(), Some(Duration::from_millis(40)));
        assert_eq!(round_trip.timeout(), Duration::from_micros(40_000 + GRANULARITY_MICROS));
        round_trip.sample(SAMPLE_MAX + Duration::from_micros(1));
        assert_eq!(round_trip.mean(), Some(Duration::from_millis(40)));
        round_trip.sample(Duration::from_millis(200));
        assert!(round_trip.timeout() > Duration::from_millis(100));
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
