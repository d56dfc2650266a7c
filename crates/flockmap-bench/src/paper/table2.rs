//! Table II: what the Hilbert walk saves against nested order.

use flockmap::codec::Codec;
use flockmap_cli::document::{Cell, DataTable, Part, Section};

use super::figures::{TABLE_TWO, TABLE_TWO_RANGE_M};
use super::flown::Flown;
use super::jobs;
use super::methods::MethodRows;
use super::settings::mapper;
use super::team;
use crate::baselines::Method;
use crate::place::Place;

/// Measures both orders on the forest.
pub fn measure(flown: &Flown, threads: usize) -> anyhow::Result<Option<MethodRows>> {
    let methods = [Method::Whole(Codec::Paper), Method::Whole(Codec::NestedZlib)];
    let robots = (0..flown.scene.robots()).map(|robot| (format!("Table II, robot {}", robot + 1), robot));
    let runs: Option<Vec<_>> = jobs::run(threads, robots.collect(), |robot| {
        let source = flown.sources(TABLE_TWO_RANGE_M)?.swap_remove(robot);
        let mapper = mapper(0.1, TABLE_TWO_RANGE_M)?;
        team::codecs(source, &mapper, flown.scene.robots() - 1, &methods, |_, _| true)
    })?
    .into_iter()
    .collect();
    Ok(runs.and_then(MethodRows::of_robots))
}

pub fn section(rows: &MethodRows) -> Section {
    let lines: Vec<_> =
        TABLE_TWO.into_iter().filter_map(|(name, avg, max)| Some((rows.get(name)?, avg, max))).collect();
    let table = DataTable::of(
        "table2",
        &lines,
        &[
            ("order", "order", &|(row, ..)| {
                Cell::text(if row.name == "paper" { "Hilbert walk" } else { "nested" })
            }),
            ("total_bytes", "total bytes", &|(row, ..)| Cell::Whole(row.total_bytes)),
            ("avg_kb_s", "avg KB/s", &|(row, ..)| Cell::Number(row.avg_kb_s, 2)),
            ("avg_kb_s_in_paper", "in the paper", &|(_, avg, _)| Cell::Number(*avg, 2)),
            ("max_kb_s", "max KB/s", &|(row, ..)| Cell::Number(row.max_kb_s, 2)),
            ("max_kb_s_in_paper", "in the paper ", &|(.., max)| Cell::Number(*max, 2)),
        ],
    );
    let percent = |ratio: f64| (1.0 - 1.0 / ratio) * 100.0;
    let saved = rows.ratio("nested-zlib", "paper").map_or(f64::NAN, percent);
    let in_paper = percent(TABLE_TWO[1].1 / TABLE_TWO[0].1);
    let note = format!(
        "The Hilbert walk saves {saved:.1} % of the bytes here, {in_paper:.1} % of the average in the paper. Nested: x slowest, z fastest."
    );
    let parts = vec![
        Part::Words(format!(
            "The {}, 0.1 m voxels, {TABLE_TWO_RANGE_M} m range, the same batches packed in both orders, then zlib level 6.",
            Place::Forest.name()
        )),
        Part::Table(table.with_note(note)),
    ];
    Section::new("table2", "Table II: Hilbert walk against nested order", parts)
}
