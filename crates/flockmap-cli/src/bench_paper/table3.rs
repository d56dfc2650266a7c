//! Table III and Fig. 9: two nodes over an emulated Wi-Fi, sent and received over time.

use flockmap::{Codec, SessionConfig};
use flockmap_netsim::Link;

use super::figures::{CHANGES_MAX, FLIGHT_T_L_S, FLIGHT_UPDATE_BOX_M, TABLE_THREE};
use super::flown::{Flown, LIDAR_RANGE_M};
use super::jobs::{self, Job};
use super::stack::{self, Stack, StackPlan, Traffic};
use super::{cycle, mapper};
use crate::chart::{self, Axis, Line, Scale};
use crate::document::{Cell, DataTable, Part, Section};
use crate::measure::KB;

/// The emulated Wi-Fi: every tenth datagram is lost.
pub const WIFI: Link = Link { loss: 0.1, delay_micros: 10_000, jitter_micros: 10_000, duplication: 0.0 };

/// The runs, by session.
pub struct Measured {
    pub ours: Stack,
    pub paper: Stack,
}

/// What is run: the paper's settings of its real flight.
pub fn plan(codec: Codec, session: SessionConfig, seed: u64) -> anyhow::Result<StackPlan> {
    let mut mapper = mapper(0.1, LIDAR_RANGE_M)?;
    mapper.update_box_m = Some(FLIGHT_UPDATE_BOX_M);
    Ok(StackPlan {
        title: "two nodes over an emulated Wi-Fi".to_owned(),
        mapper,
        cycle: cycle(FLIGHT_T_L_S, CHANGES_MAX),
        codec,
        session,
        link: WIFI,
        seed,
    })
}

/// Runs both sessions on the forest.
pub fn measure(flown: &Flown, seed: u64, threads: usize) -> anyhow::Result<Option<Measured>> {
    let sessions = [
        ("ours", Codec::Flock, SessionConfig::default()),
        ("the paper's", Codec::Paper, SessionConfig::paper()),
    ];
    let jobs = sessions.into_iter().map(|(name, codec, session)| {
        Job::new(format!("Table III, {name}"), move || {
            stack::run(&plan(codec, session, seed)?, flown.sources(LIDAR_RANGE_M)?)
        })
    });
    let mut stacks = jobs::run(threads, jobs.collect())?.into_iter();
    let (Some(Some(ours)), Some(Some(paper))) = (stacks.next(), stacks.next()) else { return Ok(None) };
    Ok(Some(Measured { ours, paper }))
}

pub fn section(measured: &Measured) -> Section {
    let mut table = DataTable::new(
        "table3",
        &[
            ("session", "session"),
            ("robot", "robot"),
            ("tx_avg_kb_s", "TX avg"),
            ("rx_avg_kb_s", "RX avg"),
            ("tx_max_kb_s", "TX max"),
            ("rx_max_kb_s", "RX max"),
            ("age_obstacles_median_s", "obstacle age, median s"),
            ("age_obstacles_p99_s", "99 %, s"),
            ("agreement", "agreement"),
        ],
    );
    for (name, stack) in [("Flockmap", &measured.ours), ("as in the paper", &measured.paper)] {
        let seconds = stack.report.record_s.max(1e-3);
        for (number, Traffic { sent, received }) in stack.traffic.iter().enumerate() {
            let avg = |bytes: u64| Cell::Number(bytes as f64 / KB / seconds, 2);
            let max = |bytes: u64| Cell::Number(bytes as f64 / KB, 2);
            table.row([
                Cell::text(name),
                Cell::Whole(number as u64 + 1),
                avg(sent.total()),
                avg(received.total()),
                max(sent.largest_second()),
                max(received.largest_second()),
                Cell::Number(stack.report.age_occupied.median_s, 2),
                Cell::Number(stack.report.age_occupied.p99_s, 2),
                Cell::Share(stack.report.agreement_all),
            ]);
        }
    }
    let [(_, tx_avg, tx_max), (_, rx_avg, rx_max)] = TABLE_THREE;
    table.row([
        Cell::text("the paper, real flight"),
        Cell::Whole(1),
        Cell::Number(tx_avg, 2),
        Cell::Number(rx_avg, 2),
        Cell::Number(tx_max, 2),
        Cell::Number(rx_max, 2),
        Cell::Missing,
        Cell::Missing,
        Cell::Missing,
    ]);
    table.note = "Flockmap: codec `flock`, its own session; as in the paper: codec `paper`, the paper's session. KB/s of UDP payload with requests, repairs and all headers. Ages are of both robots' voxels together. An exploration turns round and looks again, \
                  where the paper's flight went straight through a forest not seen before: its like is the application below, whose table has its own traffic."
        .to_owned();
    let parts = vec![
        Part::Words(format!(
            "The two robots of the forest over an emulated Wi-Fi: {:.0} % of all datagrams lost, {:.0} ms delay and up to {:.0} ms jitter. \
             0.1 m voxels, an update box of ±{} × ±{} × ±{} m, t_l {FLIGHT_T_L_S} s, as in the paper's real flight.",
            WIFI.loss * 100.0,
            WIFI.delay_micros as f64 / 1e3,
            WIFI.jitter_micros as f64 / 1e3,
            FLIGHT_UPDATE_BOX_M[0],
            FLIGHT_UPDATE_BOX_M[1],
            FLIGHT_UPDATE_BOX_M[2],
        )),
        Part::Table(table),
        Part::Html(fig9(measured)),
    ];
    Section {
        id: "table3",
        title: "Table III and Fig. 9: two nodes over a Wi-Fi with loss".to_owned(),
        parts,
    }
}

/// What robot 1 sends and receives in each second.
fn fig9(measured: &Measured) -> String {
    let mut html = String::from("<div class=\"charts\">");
    for (name, stack) in
        [("Flockmap's own session", &measured.ours), ("the paper's session", &measured.paper)]
    {
        let Some(Traffic { sent, received }) = stack.traffic.first() else { continue };
        // The last second is a part of one.
        let whole = (stack.report.record_s.floor() as usize).max(2);
        let series = |per_second: Vec<u64>| -> Vec<f64> {
            let mut values: Vec<f64> = per_second.into_iter().map(|bytes| bytes as f64 / KB).collect();
            values.resize(whole, 0.0);
            values
        };
        let average = vec![(0.0, TABLE_THREE[0].1), (whole as f64 - 1.0, TABLE_THREE[0].1)];
        html += &format!(
            "<div><h3>Fig. 9: robot 1, {name}</h3>{}</div>",
            chart::svg(
                Axis { label: "time in s", scale: Scale::Linear },
                Axis { label: "KB in each second", scale: Scale::Linear },
                &[
                    Line::per_second("sent", "c1", &series(sent.per_second())),
                    Line::per_second("received", "c3", &series(received.per_second())),
                    Line { name: "average sent in the paper's flight", class: "limit", points: average },
                ],
            )
        );
    }
    html + "</div>"
}
