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

/// How long datagrams in one direction queue: the delay of each against the base delay, the least one of the last five to
/// ten minutes. (In less time a queue that cross traffic keeps full would become the base.)
#[derive(Clone, Copy, Debug)]
pub(crate) struct QueueingDelay {
    /// In microseconds, between two clocks.
    base: Least,
}

const SPAN: Duration = Duration::from_secs(300);
const NOISE: i64 = 20_000;
/// A datagram that seems to have queued for longer comes of a clock that was set.
const QUEUED_MAX: i64 = 300_000_000;

impl Default for QueueingDelay {
    fn default() -> Self {
        Self { base: Least::new(SPAN) }
    }
}

impl QueueingDelay {
    /// Microseconds that a datagram queued, from its delay between two clocks that need not agree. `None`: not
    /// known, since it is the first one, or lowers the base delay, or a clock was set.
    pub(crate) fn sample(&mut self, now: Stamp, delay: i64) -> Option<i64> {
        let before = self.base.get();
        let queued = delay.saturating_sub(self.base.note(now, delay));
        let is_known = before.is_some_and(|before| delay >= before.saturating_sub(NOISE));
        (is_known && queued < QUEUED_MAX).then_some(queued)
    }
}
