//! The paper's application (Sec. V-B): a leader that looks backwards flies on its follower's map.

use flockmap_autonomy::application::SeriesOptions;
use flockmap_cli::document::{Cell, DataTable, Part, Section, Verdict};

use super::figures::TABLE_THREE;
use crate::application::{self, Row};

/// Flights that must succeed, of all that have sync without limits: 19 of 20.
const SUCCESS_SHARE: f64 = 0.95;

/// Flies everything.
pub fn measure(seeds: u64, quick: bool, threads: usize) -> anyhow::Result<Vec<Row>> {
    let mut options = SeriesOptions { seeds, threads, ..SeriesOptions::default() };
    if quick {
        options.rates_bytes_per_s = vec![5 * 1024, 25 * 1024];
        options.losses = vec![0.0, 0.4];
    }
    application::measure(&options)
}

pub fn section(rows: &[Row]) -> Section {
    let table = DataTable::of(
        "application",
        rows,
        &[
            ("sync", "sync", &|row| Cell::text(&row.name)),
            ("flights", "flights", &|row| Cell::count(row.flights)),
            ("successes", "success", &|row| Cell::count(row.successes)),
            ("leader_hits", "leader hit", &|row| Cell::count(row.leader_hits)),
            ("follower_hits", "follower hit", &|row| Cell::count(row.follower_hits)),
            ("robots_touched", "robots touched", &|row| Cell::count(row.robots_touched)),
            ("time_outs", "time over", &|row| Cell::count(row.time_outs)),
            ("seconds", "seconds to the goal", &|row| Cell::maybe(row.seconds, 1)),
            ("leader_tx_kb_s", "leader TX KB/s", &|row| Cell::Number(row.leader_sent_kb_s, 1)),
            ("leader_rx_kb_s", "RX KB/s", &|row| Cell::Number(row.leader_received_kb_s, 1)),
            ("leader_tx_kb_s_max", "TX max", &|row| Cell::Number(row.leader_sent_kb_s_max, 1)),
            ("leader_rx_kb_s_max", "RX max", &|row| Cell::Number(row.leader_received_kb_s_max, 1)),
            ("obstacle_age_median_s", "obstacle age, s", &|row| Cell::maybe(row.obstacle_age_median_s, 2)),
            ("obstacle_age_p99_s", "99 %, s", &|row| Cell::maybe(row.obstacle_age_p99_s, 2)),
        ],
    )
    .with_note(application::NOTES.split_whitespace().collect::<Vec<_>>().join(" "));
    let [(_, tx_avg, tx_max), (_, rx_avg, rx_max)] = TABLE_THREE;
    let parts = vec![
        Part::Words(format!(
            "Two robots cross a small dense forest of 30 m. The leader's LiDAR faces backwards: it sees what lies ahead only through the map of its \
             follower. The same flights with and without sync, with budgets, and with loss. The paper flew this for real, \"multiple times\" with \
             success, and measured {tx_avg} KB/s sent and {rx_avg} received on average, {tx_max} and {rx_max} in the largest second (its Table III)."
        )),
        Part::Table(table),
    ];
    Section::new("application", "The application: flying on a team-mate's map", parts)
}

/// Whether sync makes the difference.
pub fn verdict(rows: &[Row]) -> Option<Verdict> {
    let share = |row: &Row| row.successes as f64 / row.flights.max(1) as f64;
    let without = rows.iter().find(|row| row.loss.is_none());
    let with = rows.iter().find(|row| row.loss.is_some() && row.rate_kb_s.is_none());
    let (without, with) = (without?, with?);
    let good = share(with) >= SUCCESS_SHARE && share(without) < 0.5;
    let words = format!(
        "The leader that looks backwards reaches its goal in {} of {} flights with sync, in {} of {} without.",
        with.successes, with.flights, without.successes, without.flights
    );
    Some(Verdict::good_or_note(good, words))
}
