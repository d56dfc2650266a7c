//! Table III and Fig. 9: two nodes over an emulated Wi-Fi, sent and received over time.

use flockmap::{Codec, RobotConfig, SessionConfig};
use flockmap_cli::chart::{self, Axis, Line, Scale};
use flockmap_cli::document::{Cell, DataTable, Part, Section, Verdict};
use flockmap_cli::measure::{KB, SentBytes};
use flockmap_cli::report::Report;
use flockmap_netsim::Link;
use maud::{Markup, html};

use super::figures::{CHANGES_MAX, FLIGHT_PUBLISH_PERIOD_S, FLIGHT_UPDATE_BOX_M, TABLE_THREE};
use super::flown::{Flown, LIDAR_RANGE_M};
use super::jobs;
use super::settings::{batch, mapper, robot};
use super::stack::{self, Stack};

/// The emulated Wi-Fi: every tenth datagram is lost.
pub const WIFI: Link = Link { loss: 0.1, delay_micros: 10_000, jitter_micros: 10_000, ..Link::PERFECT };

/// The session of each run.
const SESSIONS: [&str; 2] = ["Flockmap", "as in the paper"];

/// A robot with the paper's settings of its real flight.
pub fn flight_robot(codec: Codec, session: SessionConfig, seed: u64) -> anyhow::Result<RobotConfig> {
    let mut mapper = mapper(0.1, LIDAR_RANGE_M)?;
    mapper.update_box_m = Some(FLIGHT_UPDATE_BOX_M);
    let robot = robot(mapper, batch(FLIGHT_PUBLISH_PERIOD_S, CHANGES_MAX), seed);
    Ok(RobotConfig { codec, session, ..robot })
}

/// Runs both sessions on the forest; ours comes first.
pub fn measure(flown: &Flown, seed: u64, threads: usize) -> anyhow::Result<Option<Vec<Stack>>> {
    let sessions = vec![
        ("Table III, ours".to_owned(), (Codec::Flock, SessionConfig::default())),
        ("Table III, the paper's".to_owned(), (Codec::Paper, SessionConfig::paper())),
    ];
    let stacks = jobs::run(threads, sessions, |(codec, session)| {
        let robot = flight_robot(codec, session, seed)?;
        let title = "two nodes over an emulated Wi-Fi".to_owned();
        stack::run(title, &robot, WIFI, flown.sources(LIDAR_RANGE_M)?)
    })?;
    Ok(stacks.into_iter().collect())
}

pub fn section(stacks: &[Stack]) -> Section {
    /// A robot of a run, or of the paper's flight: KB/s sent and received on average, in the largest second.
    struct Line<'a> {
        session: &'static str,
        robot: usize,
        kb_s: [f64; 4],
        report: Option<&'a Report>,
    }
    let mut lines = Vec::new();
    for (session, stack) in SESSIONS.into_iter().zip(stacks) {
        let seconds = stack.report.record_s.max(1e-3);
        for (number, [sent, received]) in stack.traffic.iter().enumerate() {
            let avg = |of: &SentBytes| of.total() as f64 / KB / seconds;
            let max = |of: &SentBytes| of.largest_second() as f64 / KB;
            let kb_s = [avg(sent), avg(received), max(sent), max(received)];
            lines.push(Line { session, robot: number + 1, kb_s, report: Some(&stack.report) });
        }
    }
    let [(_, tx_avg, tx_max), (_, rx_avg, rx_max)] = TABLE_THREE;
    let kb_s = [tx_avg, rx_avg, tx_max, rx_max];
    lines.push(Line { session: "the paper, real flight", robot: 1, kb_s, report: None });
    let table = DataTable::of(
        "table3",
        &lines,
        &[
            ("session", "session", &|l| Cell::text(l.session)),
            ("robot", "robot", &|l| Cell::count(l.robot)),
            ("tx_avg_kb_s", "TX avg", &|l| Cell::Number(l.kb_s[0], 2)),
            ("rx_avg_kb_s", "RX avg", &|l| Cell::Number(l.kb_s[1], 2)),
            ("tx_max_kb_s", "TX max", &|l| Cell::Number(l.kb_s[2], 2)),
            ("rx_max_kb_s", "RX max", &|l| Cell::Number(l.kb_s[3], 2)),
            ("age_obstacles_median_s", "obstacle age, median s", &|l| {
                Cell::maybe(l.report.map(|r| r.age_occupied.median_s), 2)
            }),
            ("age_obstacles_p99_s", "99 %, s", &|l| Cell::maybe(l.report.map(|r| r.age_occupied.p99_s), 2)),
            ("agreement", "agreement", &|l| l.report.map_or(Cell::Missing, |r| Cell::Share(r.agreement_all))),
        ],
    );
    let note = "Flockmap: codec `flock`, its own session; as in the paper: codec `paper`, the paper's session. KB/s of UDP payload with requests, repairs and all headers. Ages are of both robots' voxels together. An exploration turns round and looks again, \
                where the paper's flight went straight through a forest not seen before: its like is the application below, whose table has its own traffic.";
    let parts = vec![
        Part::Words(format!(
            "The two robots of the forest over an emulated Wi-Fi: {:.0} % of all datagrams lost, {:.0} ms delay and up to {:.0} ms jitter. \
             0.1 m voxels, an update box of ±{} × ±{} × ±{} m, publish period {FLIGHT_PUBLISH_PERIOD_S} s, as in the paper's real flight.",
            WIFI.loss * 100.0,
            WIFI.delay_micros as f64 / 1e3,
            WIFI.jitter_micros as f64 / 1e3,
            FLIGHT_UPDATE_BOX_M[0],
            FLIGHT_UPDATE_BOX_M[1],
            FLIGHT_UPDATE_BOX_M[2],
        )),
        Part::Table(table.with_note(note)),
        Part::Figure(fig9(stacks)),
    ];
    Section::new("table3", "Table III and Fig. 9: two nodes over a Wi-Fi with loss", parts)
}

/// Whether both runs ended with equal layers.
pub fn verdict(stacks: &[Stack]) -> Verdict {
    let good = stacks.iter().all(|stack| stack.report.is_good());
    let words = if good {
        "Table III: with both sessions the nodes end with equal layers, voxel by voxel."
    } else {
        "Table III: nodes end with layers that differ. This is a fault of flockmap, please report it."
    };
    Verdict::good_if(good, words)
}

/// What robot 1 sends and receives in each second.
fn fig9(stacks: &[Stack]) -> Markup {
    let chart = |stack: &Stack| {
        let [sent, received] = stack.traffic.first()?;
        // The last second is a part of one.
        let whole = (stack.report.record_s.floor() as usize).max(2);
        let series = |sent: &SentBytes| -> Vec<f64> {
            let mut values: Vec<f64> = sent.per_second().into_iter().map(|bytes| bytes as f64 / KB).collect();
            values.resize(whole, 0.0);
            values
        };
        let average = vec![(0.0, TABLE_THREE[0].1), (whole as f64 - 1.0, TABLE_THREE[0].1)];
        Some(chart::lines(
            Axis { label: "time in s", scale: Scale::Linear },
            Axis { label: "KB in each second", scale: Scale::Linear },
            &[
                Line::per_second("sent", "c1", &series(sent)),
                Line::per_second("received", "c3", &series(received)),
                Line { name: "average sent in the paper's flight", class: "limit", points: average },
            ],
        ))
    };
    let runs = ["Flockmap's own session", "the paper's session"].into_iter().zip(stacks);
    html! {
        div.charts {
            @for (name, stack) in runs {
                @if let Some(chart) = chart(stack) { div { h3 { "Fig. 9: robot 1, " (name) } (chart) } }
            }
        }
    }
}
