//! Table II: what the Hilbert walk saves against nested order.

use flockmap::codec::Codec;
use flockmap_baselines::Method;

use super::figures::{Scene, TABLE_TWO, TABLE_TWO_RANGE_M};
use super::flown::Flown;
use super::jobs::{self, Job};
use super::methods::MethodRows;
use super::table1;
use crate::document::{Cell, DataTable, Part, Section};

/// Measures both orders on the forest.
pub fn measure(flown: &Flown, threads: usize) -> anyhow::Result<Option<MethodRows>> {
    let methods = [Method::Whole(Codec::Paper), Method::Whole(Codec::NestedZlib)];
    let robots = (0..flown.scene.robots()).map(|robot| {
        Job::new(format!("Table II, robot {}", robot + 1), move || {
            table1::codecs(flown, robot, 0.1, TABLE_TWO_RANGE_M, None, &methods)
        })
    });
    let outcomes: Option<Vec<_>> = jobs::run(threads, robots.collect())?.into_iter().collect();
    Ok(outcomes.map(|outcomes| MethodRows::of_robots(&outcomes, flown.scene.robots() - 1)))
}

pub fn section(rows: &MethodRows) -> Section {
    let mut table = DataTable::new(
        "table2",
        &[
            ("order", "order"),
            ("total_bytes", "total bytes"),
            ("avg_kb_s", "avg KB/s"),
            ("avg_kb_s_in_paper", "in the paper"),
            ("max_kb_s", "max KB/s"),
            ("max_kb_s_in_paper", "in the paper "),
        ],
    );
    for (name, avg, max) in TABLE_TWO {
        if let Some(row) = rows.get(name) {
            table.row([
                Cell::text(if name == "paper" { "Hilbert walk" } else { "nested" }),
                Cell::Whole(row.total_bytes),
                Cell::Number(row.avg_kb_s, 2),
                Cell::Number(avg, 2),
                Cell::Number(row.max_kb_s, 2),
                Cell::Number(max, 2),
            ]);
        }
    }
    let percent = |ratio: f64| (1.0 - 1.0 / ratio) * 100.0;
    let saved = rows.ratio("nested-zlib", "paper").map_or(f64::NAN, percent);
    let in_paper = percent(TABLE_TWO[1].1 / TABLE_TWO[0].1);
    table.note = format!(
        "The Hilbert walk saves {saved:.1} % of the bytes here, {in_paper:.1} % of the average in the paper. Nested: x slowest, z fastest."
    );
    let parts = vec![
        Part::Words(format!(
            "The {}, 0.1 m voxels, {TABLE_TWO_RANGE_M} m range, the same cycles packed in both orders, then zlib level 6.",
            Scene::Forest.name()
        )),
        Part::Table(table),
    ];
    Section { id: "table2", title: "Table II: Hilbert walk against nested order".to_owned(), parts }
}
