//! What a swarm costs, by the number of its robots and by its radio: broadcast, nothing but the radio against it.

use super::{RadioPreset, Report, SwarmOptions, fly};
use flockmap::Cast;

/// Numbers of robots in the table.
pub const ROBOTS: [usize; 6] = [2, 5, 10, 20, 50, 100];
/// Seconds of mapping in each flight.
pub const MAPPING_S: u32 = 5;
/// Seconds after which it is no more waited for agreement.
pub const WAIT_S: u32 = 120;
const SEED: u64 = 1;

/// What stands above the rows.
pub fn head() -> String {
    let text = "\
What a swarm costs: flockmap sim table. Each robot maps its part of a hall for {MAPPING_S} s (the more robots, the larger; voxels of 0.25 m, ten scans of 60 rays a second), broadcasts
what changed and asks for what it misses. Then links heal; agreement is the time from there until all layers are equal (-: not
within {WAIT_S} s, and the figures count until then). Budget: what a robot may send in a second (its part of 70 % of a shared radio,
but at least the 500 bytes/s that a session needs). Map: bytes of the packages that it made itself. Sent: all that it sent, with 28
bytes of IP and UDP for each datagram; of it requests, in per cent. Air: time on the air, in per cent of the flight, of all robots
together where they share it (beyond 100 %: more than it carries, the rest waits). Age: from the end of a batch to its merge at another robot. All per robot on the mean.

radio           robots budget B/s   map B   sent B  requests    air age 50 % age 99 %  agreement
";
    text.replace("{MAPPING_S}", &MAPPING_S.to_string()).replace("{WAIT_S}", &WAIT_S.to_string())
}

/// One row, with the end of the line. The same on every machine.
///
/// # Errors
/// What a checker found.
pub fn row(radio: RadioPreset, robots: usize) -> Result<String, String> {
    let report = flight(radio, robots);
    if let Some(failure) = &report.failure {
        return Err(format!("{}\n{failure}", report.command));
    }
    let count = report.robots.len().max(1) as f64;
    let sum = |of: fn(&super::RobotFigures) -> f64| report.robots.iter().map(of).sum::<f64>();
    let numbers = radio.numbers();
    let bytes = sum(|robot| robot.bytes as f64);
    let requests = sum(|robot| robot.request_bytes as f64);
    let air = sum(|robot| robot.airtime_s) / if numbers.config.is_shared { 1.0 } else { count };
    let budget = numbers.budget(robots).map_or_else(|| "none".to_owned(), |budget| budget.to_string());
    let agreement = report.agreement_s.map_or_else(|| "-".to_owned(), |s| format!("{s:.2} s"));
    Ok(format!(
        "{:<15}{robots:>7}{budget:>11}{:>8.0}{:>9.0}{:>8.0} %{:>5.1} %{:>7.3} s{:>7.3} s{agreement:>11}\n",
        radio.name(),
        sum(|robot| robot.package_bytes as f64) / count,
        bytes / count,
        100.0 * requests / bytes.max(1.0),
        100.0 * air / report.flown_s.max(1.0),
        sum(|robot| robot.age_median_s) / count,
        sum(|robot| robot.age_99_s) / count,
    ))
}

fn flight(radio: RadioPreset, robots: usize) -> Report {
    fly(&SwarmOptions {
        robots: Some(robots),
        radio: Some(radio),
        seconds: Some(f64::from(MAPPING_S)),
        cast: Some(Cast::Broadcast),
        is_calm: true,
        until_agreement_s: Some(WAIT_S),
        ..SwarmOptions::new(SEED)
    })
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
