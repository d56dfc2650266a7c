//! What came of a flight.

use super::check::Failure;
use core::fmt;
use std::collections::BTreeMap;

/// What one robot sent and merged, over all its runs in the flight.
#[derive(Clone, Debug, Default)]
#[non_exhaustive]
pub struct RobotFigures {
    /// Which robot.
    pub id: u16,
    /// Runs that it began.
    pub runs: u32,
    /// Whether it flew at the end.
    pub is_alive: bool,
    /// Datagrams sent; by unicast counted for each receiver.
    pub datagrams: u64,
    /// Their bytes, with 28 bytes of IP and UDP headers each.
    pub bytes: u64,
    /// Of these: requests.
    pub request_bytes: u64,
    /// Of the datagrams: requests.
    pub requests: u64,
    /// Time on the air in seconds; 0 where the radio has no rate.
    pub airtime_s: f64,
    /// Own packages made.
    pub packages: u64,
    /// Bytes of these.
    pub package_bytes: u64,
    /// Packages of others merged as they came.
    pub merged: u64,
    /// Median age of what it merged, from the end of its batch to the merge, in seconds.
    pub age_median_s: f64,
    /// The age that 99 % did not exceed, in seconds.
    pub age_99_s: f64,
}

/// How often each kind of event was seen.
pub type Seen = BTreeMap<&'static str, u64>;

/// A flight and what it showed.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Report {
    /// The command that flies it again.
    pub command: String,
    /// The settings that matter, as text.
    pub settings: Vec<String>,
    /// What happened when, in seconds.
    pub events: Vec<(f64, String)>,
    /// Each robot.
    pub robots: Vec<RobotFigures>,
    /// Seconds of mapping, after which links healed.
    pub mapping_s: f64,
    /// From there until all maps were equal, in seconds. `None`: they were not.
    pub agreement_s: Option<f64>,
    /// Within which they had to be, in seconds; it follows from the settings.
    pub agreement_within_s: f64,
    /// How often each kind of event was seen.
    pub seen: Seen,
    /// Seconds of virtual time.
    pub flown_s: f64,
    /// Inputs given to robots.
    pub steps: u64,
    /// What a checker found, if it found something.
    pub failure: Option<Failure>,
}

impl Report {
    /// Whether all checkers were content.
    pub const fn is_good(&self) -> bool {
        self.failure.is_none()
    }
}

/// The middle and the ninety-ninth of a hundred; 0 of nothing.
pub(super) fn median_and_99(values: &mut [i64]) -> (f64, f64) {
    values.sort_unstable();
    let at = |share: f64| {
        let last = values.len().saturating_sub(1) as f64;
        values.get((last * share).round() as usize).map_or(0.0, |micros| *micros as f64 / 1e6)
    };
    (at(0.5), at(0.99))
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let who = self.robot.map_or_else(|| "the swarm".to_owned(), |id| format!("{id:?}"));
        writeln!(f, "checker {} at {:.6} s, {who}", self.checker, self.at_s)?;
        writeln!(f, "  expected: {}", self.expected)?;
        write!(f, "  found:    {}", self.found)
    }
}
