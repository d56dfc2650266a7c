//! The clock of a robot, and the clock of its machine.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use flockmap::Stamp;

/// How far the system clock must have moved against the node's to count as stepped. Less is the time between
/// two looks at two clocks, or a clock that is slewed.
const STEP_MIN_MICROS: i64 = 100_000;

/// Steps are looked for this often.
const LOOK_PERIOD: Duration = Duration::from_secs(1);

/// Both clocks are read again if the system took longer than this in between.
const READING_MAX: Duration = Duration::from_millis(1);

/// The time in microseconds since 1970 as the machine had it when the clock was made, counted on from there
/// by the monotonic clock: it never runs backwards or jumps, whatever is done to the machine's time. Copies
/// show the same time.
#[derive(Clone, Copy, Debug)]
pub struct Clock {
    began: Instant,
    began_at: Stamp,
    system: fn() -> SystemTime,
}

impl Clock {
    /// A clock that shows the machine's time now.
    pub fn new() -> Self {
        Self::with_system_time(SystemTime::now)
    }

    /// A clock that shows this time now.
    pub fn at(stamp: Stamp) -> Self {
        Self { began: Instant::now(), began_at: stamp, system: SystemTime::now }
    }

    /// A clock on a machine whose system clock is this function. It shows the machine's time now.
    pub fn with_system_time(system: fn() -> SystemTime) -> Self {
        Self { began: Instant::now(), began_at: stamp_of(system()), system }
    }

    /// The time now.
    pub fn now(&self) -> Stamp {
        self.began_at.plus_micros(i64::try_from(self.began.elapsed().as_micros()).unwrap_or(i64::MAX))
    }

    /// What the machine's own clock shows now. It may be stepped, forwards and backwards.
    pub fn system_now(&self) -> Stamp {
        stamp_of((self.system)())
    }

    /// This clock and the machine's own at the same moment.
    pub fn now_and_system_now(&self) -> (Stamp, Stamp) {
        // Whoever is interrupted between the two looks tries again, but not for ever.
        for _ in 0..4 {
            let before = Instant::now();
            let both = (self.now(), self.system_now());
            if before.elapsed() < READING_MAX {
                return both;
            }
        }
        (self.now(), self.system_now())
    }

    /// How far the machine's own clock is ahead of this one, in microseconds. It changes when the machine's
    /// is stepped, or when the machine was asleep.
    pub fn system_ahead(&self) -> i64 {
        let (now, system) = self.now_and_system_now();
        system.micros_since(now)
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

/// Microseconds since 1970; negative before.
fn stamp_of(time: SystemTime) -> Stamp {
    let micros = |duration: Duration| i64::try_from(duration.as_micros()).unwrap_or(i64::MAX);
    Stamp(match time.duration_since(UNIX_EPOCH) {
        Ok(since) => micros(since),
        Err(before) => -micros(before.duration()),
    })
}

/// Finds the steps of a machine's clock. Nothing depends on it but what is said and counted.
#[derive(Debug)]
pub(crate) struct StepWatch {
    clock: Clock,
    ahead: i64,
    looked: Instant,
}

impl StepWatch {
    pub(crate) fn new(clock: Clock) -> Self {
        Self { clock, ahead: clock.system_ahead(), looked: Instant::now() }
    }

    /// Looks, unless it did a moment ago; returns what there is to say of a step.
    pub(crate) fn poll(&mut self) -> Option<String> {
        if self.looked.elapsed() < LOOK_PERIOD {
            return None;
        }
        self.looked = Instant::now();
        self.note(self.clock.system_ahead())
    }

    fn note(&mut self, ahead: i64) -> Option<String> {
        // A slow drift is followed and not reported.
        let before = std::mem::replace(&mut self.ahead, ahead);
        let step = ahead.saturating_sub(before);
        let seconds = |micros: i64| micros as f64 / 1e6;
        (step.unsigned_abs() >= STEP_MIN_MICROS.unsigned_abs()).then(|| {
            format!(
                "the system clock was stepped by {:+.3} s, or the machine slept: it was {:+.3} s off the node's clock and is \
                 {:+.3} s off now; the node's clock goes on, and stamps of the sensor are taken by the new time",
                seconds(step),
                seconds(before),
                seconds(ahead)
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicI64, Ordering};

    fn at_micros(micros: &AtomicI64) -> SystemTime {
        let micros = micros.load(Ordering::Relaxed);
        let apart = Duration::from_micros(micros.unsigned_abs());
        if micros < 0 { UNIX_EPOCH - apart } else { UNIX_EPOCH + apart }
    }

    #[test]
    fn the_node_s_clock_does_not_follow_a_step() {
        static SYSTEM: AtomicI64 = AtomicI64::new(5_000_000);
        let clock = Clock::with_system_time(|| at_micros(&SYSTEM));
        let began = clock.now();
        assert!(began >= Stamp(5_000_000));
        for system in [3_600_000_000, -7_000_000, i64::from(i32::MIN) * 1_000_000, 0] {
            let before = clock.now();
            SYSTEM.store(system, Ordering::Relaxed);
            assert_eq!(clock.system_now(), Stamp(system));
            // However slow this machine is, it is no day.
            assert!(clock.now() >= before && clock.now() < began.plus_micros(86_400_000_000));
        }
    }

    #[test]
    fn each_step_is_said_once_with_both_offsets_and_a_drift_is_not() {
        let mut watch = StepWatch { clock: Clock::new(), ahead: 0, looked: Instant::now() };
        for ahead in (0..1_000_000).step_by(99_999) {
            assert_eq!(watch.note(ahead), None, "slewed");
        }
        watch.ahead = 1_000_000;
        let text = watch.note(3_601_000_000).unwrap();
        for part in ["stepped by +3600.000 s", "was +1.000 s off", "is +3601.000 s off now"] {
            assert!(text.contains(part), "{text}");
        }
        assert_eq!(watch.note(3_601_000_010), None, "said once");
        let text = watch.note(-9_000_000).unwrap();
        assert!(text.contains("stepped by -3610.000 s") && text.contains("is -9.000 s off now"), "{text}");
        assert!(watch.note(i64::MIN).is_some() && watch.note(i64::MAX).is_some(), "whatever it shows");
    }
}
