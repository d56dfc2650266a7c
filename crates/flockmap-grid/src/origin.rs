//! Who observed, in which run, and when.

use core::fmt;
use core::time::Duration;

/// A robot of the swarm. Unique within the swarm; chosen by the user.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema))]
pub struct RobotId(pub u16);

impl fmt::Debug for RobotId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "robot {}", self.0)
    }
}

impl fmt::Display for RobotId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// All that one robot observed in one run: packages are numbered 1, 2, 3 … within a stream.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Stream {
    /// The robot whose sensor made the observations.
    pub origin: RobotId,
    /// The run of that robot: [`epoch`].
    pub epoch: u64,
}

/// The epoch of a run: the seconds since 1970 at which it began, and 32 random bits. Later runs of a robot
/// have higher epochs. Where a clock shows the same second twice, the random bits distinguish the runs; where
/// it was set back, a robot that hears of a higher epoch of its own id begins anew above that.
///
/// ```
/// use flockmap_grid::{epoch, seconds_of_epoch};
///
/// let run = epoch(1_795_000_000, 0x1234_5678);
/// assert_eq!(seconds_of_epoch(run), 1_795_000_000);
/// ```
pub const fn epoch(seconds: u32, random: u32) -> u64 {
    (seconds as u64) << 32 | random as u64
}

/// The seconds since 1970 in an epoch.
pub const fn seconds_of_epoch(epoch: u64) -> u32 {
    (epoch >> 32) as u32
}

impl fmt::Debug for Stream {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?} epoch {}", self.origin, self.epoch)
    }
}

/// A point in time in microseconds, on the clock of one robot. Which zero the clock has is up to the user;
/// two robots' clocks may differ, fusion corrects for it.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Stamp(pub i64);

impl Stamp {
    /// A stamp from seconds; saturates at the ends of the range.
    pub fn from_seconds(seconds: f64) -> Self {
        Self((seconds * 1e6).round() as i64)
    }

    /// The stamp in seconds.
    pub fn seconds(self) -> f64 {
        self.0 as f64 / 1e6
    }

    /// This stamp moved on; saturates at the end of the range. Parts of a microsecond do not count.
    pub const fn plus(self, span: Duration) -> Self {
        let micros = span.as_micros();
        Self(self.0.saturating_add_unsigned(if micros > u64::MAX as u128 { u64::MAX } else { micros as u64 }))
    }

    /// How long ago `earlier` was; zero if it is later than this stamp.
    pub const fn since(self, earlier: Self) -> Duration {
        let micros = self.micros_since(earlier);
        Duration::from_micros(if micros < 0 { 0 } else { micros as u64 })
    }

    /// This stamp moved by some microseconds; saturates at the ends of the range.
    pub const fn plus_micros(self, micros: i64) -> Self {
        Self(self.0.saturating_add(micros))
    }

    /// Microseconds from `earlier` to this stamp; saturates at the ends of the range.
    pub const fn micros_since(self, earlier: Self) -> i64 {
        self.0.saturating_sub(earlier.0)
    }
}

impl fmt::Debug for Stamp {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.6} s", self.seconds())
    }
}
