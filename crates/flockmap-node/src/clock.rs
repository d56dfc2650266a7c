//! The clock of a robot.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use flockmap::Stamp;

/// The time in microseconds since 1970 as the machine had it when the clock was made, counted on from there by the
/// monotonic clock: it never runs backwards or jumps, whatever is done to the machine's time. Copies tell the same time.
#[derive(Clone, Copy, Debug)]
pub struct Clock {
    began: Instant,
    began_at: Stamp,
}

impl Clock {
    /// A clock that shows the machine's time now.
    pub fn new() -> Self {
        let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        Self::at(Stamp(i64::try_from(since_1970.as_micros()).unwrap_or(i64::MAX)))
    }

    /// A clock that shows this time now.
    pub fn at(stamp: Stamp) -> Self {
        Self { began: Instant::now(), began_at: stamp }
    }

    /// The time now.
    pub fn now(&self) -> Stamp {
        self.began_at.plus_micros(i64::try_from(self.began.elapsed().as_micros()).unwrap_or(i64::MAX))
    }

    /// When the clock will show `stamp`; what is past is now, what is far is a day away.
    pub fn instant_of(&self, stamp: Stamp) -> Instant {
        let ahead = stamp.micros_since(self.now()).clamp(0, 86_400_000_000);
        Instant::now() + Duration::from_micros(ahead.unsigned_abs())
    }
}

impl Default for Clock {
    fn default() -> Self {
        Self::new()
    }
}
