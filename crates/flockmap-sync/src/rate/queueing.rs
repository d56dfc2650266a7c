//! How long datagrams queue, whatever the clocks show.

use core::time::Duration;
use flockmap_grid::Stamp;

/// The least of the values of this span of time and of the one before.
#[derive(Clone, Copy, Debug)]
pub(super) struct Least {
    values: Option<[i64; 2]>,
    since: Stamp,
    span: Duration,
}

impl Least {
    pub(super) const fn new(span: Duration) -> Self {
        Self { values: None, since: Stamp(0), span }
    }

    pub(super) fn get(&self) -> Option<i64> {
        self.values.map(|[this, before]| this.min(before))
    }

    /// Takes a value in; the least with it.
    pub(super) fn note(&mut self, now: Stamp, value: i64) -> i64 {
        let is_over = now.since(self.since) >= self.span;
        let [this, before] = match self.values {
            Some([this, before]) if !is_over => [this.min(value), before],
            values => {
                self.since = now;
                [value, values.map_or(value, |[this, _]| this)]
            }
        };
        self.values = Some([this, before]);
        this.min(before)
    }
}

const SPAN: Duration = Duration::from_secs(300);
const NOISE: i64 = 20_000;
/// A datagram that seems to have queued for longer comes of a clock that was set.
const QUEUED_MAX: i64 = 300_000_000;
/// No radio takes longer there and back while nothing queues: a short datagram of LoRa takes half of it one way.
const ROUND_TRIP_MAX: i64 = 1_500_000;

/// How long datagrams to and from another robot queue: the delay of each against the base delay, the least one of the last
/// five to ten minutes. (In less time a queue that cross traffic keeps full would become the base.)
///
/// A queue that stood all the time is in the base delays too. Clocks cancel out in both together, so what these are beyond
/// the round trip of any radio is counted as well.
#[derive(Clone, Copy, Debug)]
pub(crate) struct QueueingDelays {
    /// Base delays, in microseconds, between two clocks.
    to: Least,
    from: Least,
}

impl Default for QueueingDelays {
    fn default() -> Self {
        Self { to: Least::new(SPAN), from: Least::new(SPAN) }
    }
}

/// How long a datagram queued, in microseconds.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Queued {
    /// Beyond the base delay.
    pub(crate) beyond_base: i64,
    /// With the queue that stood all the time.
    pub(crate) all: i64,
}

impl QueueingDelays {
    /// How long a datagram to it queued, from its delay between two clocks that need not agree. `None`: not known, since
    /// it is the first one, or lowers the base delay, or a clock was set.
    pub(crate) fn sample_to(&mut self, now: Stamp, delay: i64) -> Option<Queued> {
        let beyond_base = sample(&mut self.to, now, delay)?;
        Some(Queued { beyond_base, all: beyond_base + self.standing() })
    }

    /// The same of a datagram from it.
    pub(crate) fn sample_from(&mut self, now: Stamp, delay: i64) -> Option<Queued> {
        let beyond_base = sample(&mut self.from, now, delay)?;
        Some(Queued { beyond_base, all: beyond_base + self.standing() })
    }

    fn standing(&self) -> i64 {
        let round_trip = self.to.get().zip(self.from.get()).map(|(to, from)| to.saturating_add(from));
        round_trip.map_or(0, |time| time.saturating_sub(ROUND_TRIP_MAX).clamp(0, QUEUED_MAX))
    }
}

fn sample(base: &mut Least, now: Stamp, delay: i64) -> Option<i64> {
    let before = base.get();
    let queued = delay.saturating_sub(base.note(now, delay));
    let is_known = before.is_some_and(|before| delay >= before.saturating_sub(NOISE));
    (is_known && queued < QUEUED_MAX).then_some(queued)
}

#[cfg(test)]
mod tests {
    use super::*;

    const CLOCKS_APART: i64 = 77_000_000;

    /// How long one queues each way: to the other robot, whose clock is ahead, and from it.
    fn queued(delays: &mut QueueingDelays, at: i64, to: i64, from: i64) -> [Option<i64>; 2] {
        let to = delays.sample_to(Stamp(at), to + CLOCKS_APART);
        let from = delays.sample_from(Stamp(at), from - CLOCKS_APART);
        [to, from].map(|queued| queued.map(|queued| queued.all))
    }

    #[test]
    fn a_datagram_queued_for_what_it_came_later_than_the_base_delay() {
        let mut delays = QueueingDelays::default();
        queued(&mut delays, 0, 20_000, 30_000);
        assert_eq!(queued(&mut delays, 1, 50_000, 130_000), [Some(30_000), Some(100_000)]);
    }

    #[test]
    fn a_queue_that_stood_all_the_time_shows_in_the_round_trip() {
        let mut delays = QueueingDelays::default();
        queued(&mut delays, 0, 3_000_000, 4_000_000);
        let standing = 7_000_000 - ROUND_TRIP_MAX;
        assert_eq!(queued(&mut delays, 1, 3_000_000, 4_500_000), [Some(standing), Some(standing + 500_000)]);
        // Once it was empty, the base delays say all.
        queued(&mut delays, 2, 20_000, 30_000);
        assert_eq!(queued(&mut delays, 3, 3_020_000, 30_000), [Some(3_000_000), Some(0)]);
    }

    #[test]
    fn a_slow_radio_is_not_a_queue() {
        let mut delays = QueueingDelays::default();
        let half = ROUND_TRIP_MAX / 2;
        queued(&mut delays, 0, half, half);
        assert_eq!(queued(&mut delays, 1, half, half), [Some(0), Some(0)]);
    }
}
