//! The clock of a robot: it shows another time than the others' clocks, and runs a little faster or slower.

use flockmap_grid::Stamp;

/// A clock that shows `offset` at the beginning of the flight and gains `ppm` microseconds every second.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) struct Clock {
    pub(super) offset: i64,
    pub(super) ppm: i64,
}

impl Clock {
    /// What it shows at a time of the flight, in microseconds since its beginning.
    pub(super) fn shows(self, at: i64) -> Stamp {
        Stamp(self.offset + at + (at * self.ppm).div_euclid(1_000_000))
    }

    /// The same clock, set so that it shows `stamp` at a time of the flight.
    pub(super) fn showing(self, at: i64, stamp: Stamp) -> Self {
        Self { offset: self.offset + stamp.micros_since(self.shows(at)), ..self }
    }

    /// The first time of the flight at which it shows at least this.
    pub(super) fn when(self, stamp: Stamp) -> i64 {
        let since = i128::from(stamp.0) - i128::from(self.offset);
        let guess = since * 1_000_000 / (1_000_000 + i128::from(self.ppm));
        let mut at = (guess.clamp(0, i128::from(i64::MAX / 4)) as i64 - 2).max(0);
        while at < i64::MAX / 4 - 4 && self.shows(at) < stamp {
            at += 1;
        }
        at
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn when_is_the_first_moment_that_shows_a_stamp() {
        for ppm in [-100, 0, 100] {
            let clock = Clock { offset: -7_000_000_123, ppm };
            for at in [0, 1, 999_999, 10_000_001, 3_600_000_000] {
                let first = clock.when(clock.shows(at));
                assert!(first <= at && clock.shows(first) == clock.shows(at));
                assert!(first == 0 || clock.shows(first - 1) < clock.shows(at));
            }
        }
    }
}
