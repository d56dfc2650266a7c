//! What a swarm costs, by the number of its robots and by its radio: broadcast, nothing but the radio against it.

use super::report::RobotFigures;
use super::{RadioPreset, Report, SwarmOptions, fly};
use flockmap::Cast;

/// Numbers of robots in the table.
pub const ROBOTS: [usize; 6] = [2, 5, 10, 20, 50, 100];
/// Flights of each row; of their figures the worst stands there.
pub const SEEDS: u64 = 5;
/// Seconds of mapping in each flight.
pub const MAPPING_S: u32 = 5;
/// Seconds after which it is no more waited for agreement.
pub const WAIT_S: u32 = 300;

/// What stands above the rows.
pub fn head() -> String {
    let text = "\
What a swarm costs: flockmap sim table. Each robot maps its part of a hall for {MAPPING_S} s (the more robots, the larger; voxels of 0.25 m, ten scans of 60 rays a second), broadcasts
what changed and asks for what it misses; nobody tells it what the radio carries. Then links heal; agreement is the time from there until all layers are equal (-: not
within {WAIT_S} s, and the figures count until then). Map: bytes of the packages that it made itself. Sent: all that it sent, with 28
bytes of IP and UDP for each datagram, and as a multiple of the map; of it requests, in per cent. Air: time on the air, in per cent of the flight, of all robots
together where they share it. Bound: of the agreement, the bytes of all maps over what the radio carries. Age: from the end of a batch to its merge at another robot.
All per robot on the mean; of {SEEDS} flights the worst.

radio           robots   map B   sent B sent/map requests    air age 50 % age 99 %   bound  agreement
";
    let numbers = [("{MAPPING_S}", u64::from(MAPPING_S)), ("{WAIT_S}", WAIT_S.into()), ("{SEEDS}", SEEDS)];
    numbers.into_iter().fold(text.to_owned(), |text, (name, number)| text.replace(name, &number.to_string()))
}

/// One flight of a row.
pub fn flight(radio: RadioPreset, robots: usize, seed: u64) -> Report {
    fly(&SwarmOptions {
        robots: Some(robots),
        radio: Some(radio),
        seconds: Some(f64::from(MAPPING_S)),
        cast: Some(Cast::Broadcast),
        is_calm: true,
        until_agreement_s: Some(WAIT_S),
        ..SwarmOptions::new(seed)
    })
}

/// The row of some flights, with the end of the line. The same on every machine.
///
/// # Errors
/// What a checker found.
pub fn row(radio: RadioPreset, robots: usize, flights: &[Report]) -> Result<String, String> {
    if let Some((report, failure)) =
        flights.iter().find_map(|report| Some((report, report.failure.as_ref()?)))
    {
        return Err(format!("{}\n{failure}", report.command));
    }
    let config = radio.numbers().config;
    let shared = if config.is_shared { 1 } else { robots };
    let sum = |report: &Report, of: fn(&RobotFigures) -> f64| report.robots.iter().map(of).sum::<f64>();
    let worst = |of: &dyn Fn(&Report) -> f64| flights.iter().map(of).fold(0.0, f64::max);
    let mean = |of: fn(&RobotFigures) -> f64| worst(&|report| sum(report, of) / robots as f64);
    let map = |report: &Report| sum(report, |robot| robot.package_bytes as f64).max(1.0);
    let sent = |report: &Report| sum(report, |robot| robot.bytes as f64).max(1.0);
    let requests = worst(&|report| sum(report, |robot| robot.request_bytes as f64) / sent(report));
    let air = worst(&|report| sum(report, |robot| robot.airtime_s) / shared as f64 / report.flown_s.max(1.0));
    let bound =
        worst(&|report| map(report) / shared as f64 / f64::from(config.rate_bytes_per_s.unwrap_or(u32::MAX)));
    let mut agreements = flights.iter().map(|report| report.agreement_s);
    let agreement = agreements.try_fold(0.0, |all, one| Some(f64::max(all, one?)));
    let agreement = agreement.map_or_else(|| "-".to_owned(), |s| format!("{s:.2} s"));
    Ok(format!(
        "{:<15}{robots:>7}{:>8.0}{:>9.0}{:>9.2}{:>7.0} %{:>5.1} %{:>7.3} s{:>7.3} s{bound:>6.1} s{agreement:>11}\n",
        radio.name(),
        mean(|robot| robot.package_bytes as f64),
        mean(|robot| robot.bytes as f64),
        worst(&|report| sent(report) / map(report)),
        100.0 * requests,
        100.0 * air,
        mean(|robot| robot.age_median_s),
        mean(|robot| robot.age_99_s),
    ))
}

/// The first row of `new` that is not in `old`, with the one that is there in its place. Rows that only `old`
/// has are not looked at.
pub fn difference(old: &str, new: &[String]) -> Option<(String, String)> {
    let key = |line: &str| line.split_whitespace().take(2).map(str::to_owned).collect::<Vec<_>>();
    new.iter().find_map(|row| {
        let there = old.lines().find(|line| key(line) == key(row)).unwrap_or("");
        (there.trim_end() != row.trim_end()).then(|| (there.to_owned(), row.trim_end().to_owned()))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_that_changed_is_found_and_others_may_be_left_out() {
        let row = |bytes| format!("wifi  2  {bytes}\n");
        let old = format!("{}{}wifi  5  7\n", head(), row(3));
        assert_eq!(difference(&old, &[row(3)]), None);
        assert_eq!(difference(&old, &[row(4)]), Some(("wifi  2  3".to_owned(), "wifi  2  4".to_owned())));
        assert!(difference(&old, &["lora  2  3".to_owned()]).is_some());
    }
}
