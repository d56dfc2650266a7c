//! Bytes of each second, for a line over time.

use std::collections::VecDeque;
use std::sync::Mutex;

use flockmap_grid::Stamp;
use serde_json::{Value, json};

/// So many seconds are kept, the newest.
pub const SERIES_STEPS_MAX: usize = 3_600;

const STEP_MICROS: i64 = 1_000_000;

/// What was added in up to so many seconds is shared among them; of a longer time nothing is known but its end.
const SPREAD_MAX: u64 = 3;

/// What went over the radio in each second, by name. At most 115 kB for four names.
#[derive(Debug)]
pub struct Series {
    names: Vec<String>,
    kept: Mutex<Kept>,
}

#[derive(Debug, Default)]
struct Kept {
    /// Totals and when they were said last.
    before: Option<(Stamp, Vec<u64>)>,
    /// Number of the first second that is kept.
    first: i64,
    /// One entry for each name; `None` where nothing was said in that second.
    steps: VecDeque<Option<Vec<u64>>>,
}

impl Series {
    /// Nothing yet.
    pub fn new(names: Vec<String>) -> Self {
        Self { names, kept: Mutex::default() }
    }

    /// Says what has been counted since the beginning, one number for each name; about once a second, with
    /// stamps that rise. What was added is shared among the seconds since the call before, if they are three at most,
    /// and else counts for the second of `now`. The first call begins the series.
    pub fn push(&self, now: Stamp, totals: &[u64]) {
        let mut kept = self.kept.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let Some((at, before)) = kept.before.replace((now, totals.to_vec())) else { return };
        let second = now.0.div_euclid(STEP_MICROS);
        // A clock that goes back, or leaps, begins a new series.
        if now < at || kept.steps.is_empty() {
            kept.first = second;
            kept.steps.clear();
        }
        let ahead = usize::try_from(second - kept.first).unwrap_or(usize::MAX);
        if ahead >= kept.steps.len() + SERIES_STEPS_MAX {
            (kept.first, kept.steps) = (second, VecDeque::new());
        }
        while kept.steps.len() <= usize::try_from(second - kept.first).unwrap_or(0) {
            kept.steps.push_back(None);
            if kept.steps.len() > SERIES_STEPS_MAX {
                kept.steps.pop_front();
                kept.first += 1;
            }
        }
        let seconds = second.saturating_sub(at.0.div_euclid(STEP_MICROS)).clamp(1, i64::MAX) as u64;
        // Who says it not quite each second has not been silent.
        let seconds = if seconds <= SPREAD_MAX { seconds.min(kept.steps.len() as u64) } else { 1 };
        let more: Vec<u64> =
            totals.iter().zip(before).map(|(total, before)| total.saturating_sub(before)).collect();
        for (back, step) in kept.steps.iter_mut().rev().take(seconds as usize).enumerate() {
            let sums = step.get_or_insert_with(|| vec![0; self.names.len()]);
            // What cannot be shared evenly is of the last one.
            let part = |more: u64| more / seconds + if back == 0 { more % seconds } else { 0 };
            sums.iter_mut().zip(&more).for_each(|(sum, more)| *sum += part(*more));
        }
    }

    /// As `docs/view.md` says.
    pub(crate) fn json(&self) -> Value {
        let kept = self.kept.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let of = |name: usize| -> Vec<Option<u64>> {
            kept.steps.iter().map(|step| step.as_ref().and_then(|step| step.get(name).copied())).collect()
        };
        let bytes: Vec<_> = (0..self.names.len()).map(of).collect();
        let begin = kept.first.saturating_mul(STEP_MICROS);
        json!({ "begin_us": begin, "step_s": 1, "names": self.names, "bytes": bytes })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn series() -> Series {
        Series::new(vec!["sent".into(), "received".into()])
    }

    #[test]
    fn each_second_has_what_was_added_in_it_and_gaps_are_said() {
        let series = series();
        for (ms, totals) in [
            (10_000, [100, 7]),
            (11_000, [150, 7]),
            (11_900, [160, 8]),
            (14_100, [201, 9]),
            (18_000, [211, 9]),
        ] {
            series.push(Stamp(ms * 1_000), &totals);
        }
        assert_eq!(
            series.json(),
            json!({ "begin_us": 11_000_000, "step_s": 1, "names": ["sent", "received"],
                "bytes": [[60, 13, 13, 15, null, null, null, 10], [1, 0, 0, 1, null, null, null, 0]] })
        );
    }

    #[test]
    fn a_long_flight_keeps_the_newest_hour_and_a_leap_of_the_clock_costs_nothing() {
        let series = series();
        (0..10_000).for_each(|s| series.push(Stamp(s * 1_000_000), &[s as u64 * 3, 0]));
        let sent = |series: &Series| series.json()["bytes"][0].as_array().unwrap().clone();
        assert_eq!(sent(&series).len(), SERIES_STEPS_MAX);
        assert_eq!(series.json()["begin_us"], 6_400_000_000_i64);
        assert!(sent(&series).iter().all(|bytes| *bytes == 3));
        series.push(Stamp(i64::MAX), &[40_000, 0]);
        assert_eq!(sent(&series), [json!(10_003)]);
        series.push(Stamp(0), &[40_001, 0]);
        assert_eq!(sent(&series), [json!(1)]);
    }
}
