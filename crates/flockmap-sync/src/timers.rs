//! When a session has something to do: one table of all its timers, as quinn's.

use flockmap_grid::Stamp;

/// Something that is due at a time.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Timer {
    /// The periodic request, also where nothing has changed: it is the sign of life.
    Request,
    /// A request that a peer should hear soon: a new one, or one that can stop sending.
    Greeting,
    /// A request because packages are missing.
    Gap,
    /// A request that makes the peers look whether the end of a burst is lost.
    Probe,
    /// A probe, or obstacles a second time, for peers that lose much.
    FastRepair,
    /// A budget that stopped sending has room again.
    Budget,
    /// A peer may count as gone, not earlier.
    Silence,
}

impl Timer {
    const ALL: [Self; 7] = [
        Self::Request,
        Self::Greeting,
        Self::Gap,
        Self::Probe,
        Self::FastRepair,
        Self::Budget,
        Self::Silence,
    ];
    /// Those at which a request goes out.
    pub(crate) const REQUESTS: [Self; 4] = [Self::Request, Self::Greeting, Self::Gap, Self::Probe];
}

/// The time of each timer that is set.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Timers([Option<Stamp>; Timer::ALL.len()]);

impl Timers {
    pub(crate) const fn get(&self, timer: Timer) -> Option<Stamp> {
        self.0[timer as usize]
    }

    pub(crate) const fn set(&mut self, timer: Timer, at: Stamp) {
        self.0[timer as usize] = Some(at);
    }

    /// Sets a timer unless it is set for an earlier time.
    pub(crate) fn set_sooner(&mut self, timer: Timer, at: Stamp) {
        self.set(timer, self.get(timer).map_or(at, |earlier| earlier.min(at)));
    }

    pub(crate) const fn stop(&mut self, timer: Timer) {
        self.0[timer as usize] = None;
    }

    pub(crate) fn is_due(&self, timer: Timer, now: Stamp) -> bool {
        self.get(timer).is_some_and(|at| at <= now)
    }

    /// The earliest of some timers.
    pub(crate) fn next(&self, timers: &[Timer]) -> Option<Stamp> {
        timers.iter().filter_map(|timer| self.get(*timer)).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_timer_has_a_place_of_its_own_and_the_earliest_of_those_asked_for_is_next() {
        let mut timers = Timers::default();
        for (at, timer) in (10..).zip(Timer::ALL) {
            timers.set(timer, Stamp(at));
        }
        for (at, timer) in (10..).zip(Timer::ALL) {
            assert_eq!(timers.get(timer), Some(Stamp(at)));
        }
        assert_eq!(timers.next(&[Timer::Budget, Timer::Gap]), Some(Stamp(12)));
        timers.set_sooner(Timer::Gap, Stamp(20));
        timers.set_sooner(Timer::Budget, Stamp(11));
        assert_eq!([Timer::Gap, Timer::Budget].map(|timer| timers.is_due(timer, Stamp(11))), [false, true]);
        timers.stop(Timer::Gap);
        assert_eq!(timers.get(Timer::Gap), None);
    }
}
