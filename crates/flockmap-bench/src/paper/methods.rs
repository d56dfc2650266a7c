//! Methods side by side: one row each, whatever was measured of it.

use flockmap::codec::Codec;
use flockmap_cli::chart::{self, Bar};
use flockmap_cli::document::{Cell, DataTable};
use flockmap_cli::measure::IP_UDP_BYTES;
use flockmap_cli::numbers::percent_short;
use maud::{Markup, html};

use crate::baselines::Method;
use crate::codec_run::CodecRun;

/// What a method cost on one record, all robots together.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MethodRow {
    pub name: String,
    /// In a sentence, what it is.
    pub about: String,
    /// Each message once for each receiver.
    pub total_bytes: u64,
    /// What `paper` needs for the same scans, and the voxels that change in them.
    pub paper_bytes: u64,
    pub changed_voxels: u64,
    /// 28 bytes for each datagram, on top.
    pub ip_udp_bytes: u64,
    /// Mean of the robots.
    pub avg_kb_s: f64,
    /// Largest window of one second of any robot.
    pub max_kb_s: f64,
    /// Share of voxels that are right at the receivers at the end.
    pub agreement: f64,
    /// Whether every voxel must be right.
    pub is_lossless: bool,
    /// Whether it does what it promises.
    pub is_as_promised: bool,
    /// Mean time for a batch at the sender and at a receiver, where it was measured.
    pub encode_ms: Option<f64>,
    pub decode_ms: Option<f64>,
}

/// Rows of one record, and what they are measured by.
#[derive(Clone, Debug)]
pub struct MethodRows {
    pub rows: Vec<MethodRow>,
    /// Voxels in all batches of all robots.
    pub changed_voxels: u64,
    /// Robots that listen to each.
    pub receivers: u64,
    /// Lengths of all robots' records together.
    pub seconds: f64,
}

impl MethodRows {
    /// What was measured of the robots, each on its own with the same methods; `None` without robots.
    pub fn of_robots(runs: impl IntoIterator<Item = CodecRun>) -> Option<Self> {
        let all = runs.into_iter().reduce(|mut all, run| {
            all.join(run);
            all
        })?;
        let CodecRun { receivers, changed_voxels, seconds, .. } = all;
        let measured = all.rows();
        let paper = measured.iter().find(|row| row.method == Method::Whole(Codec::Paper));
        let paper_bytes = paper.map_or(0, |row| row.total_bytes);
        let rows = measured.into_iter().map(|row| MethodRow {
            name: row.name,
            about: row.method.about().to_owned(),
            total_bytes: row.total_bytes,
            paper_bytes,
            changed_voxels,
            ip_udp_bytes: row.datagrams * IP_UDP_BYTES,
            avg_kb_s: row.avg_kb_s,
            max_kb_s: row.max_kb_s,
            agreement: row.agreement,
            is_lossless: row.method.is_lossless(),
            is_as_promised: row.is_as_promised,
            encode_ms: (row.timed > 0).then_some(row.encode_ms_mean),
            decode_ms: (row.timed > 0).then_some(row.decode_ms_mean),
        });
        Some(Self { rows: rows.collect(), changed_voxels, receivers, seconds })
    }

    /// The row of this name.
    pub fn get(&self, name: &str) -> Option<&MethodRow> {
        self.rows.iter().find(|row| row.name == name)
    }

    /// How many times the bytes of the second method the first one's are.
    pub fn ratio(&self, of: &str, to: &str) -> Option<f64> {
        let (of, to) = (self.get(of)?, self.get(to)?);
        (to.total_bytes > 0).then(|| of.total_bytes as f64 / to.total_bytes as f64)
    }

    /// Bits for each changed voxel and receiver.
    pub fn bits(&self, row: &MethodRow) -> f64 {
        row.total_bytes as f64 * 8.0 / (row.changed_voxels.max(1) * self.receivers) as f64
    }

    /// All of it as a table.
    pub fn table(&self, id: impl Into<String>) -> DataTable {
        DataTable::of(
            id,
            &self.rows,
            &[
                ("method", "method", &|row| Cell::text(&row.name)),
                ("total_bytes", "total bytes", &|row| Cell::Whole(row.total_bytes)),
                ("times_paper", "× paper", &|row| Cell::maybe(row.times_paper(), 2)),
                ("bits_per_changed_voxel", "bits a change", &|row| Cell::Number(self.bits(row), 2)),
                ("avg_kb_s", "avg KB/s", &|row| Cell::Number(row.avg_kb_s, 2)),
                ("max_kb_s", "max KB/s", &|row| Cell::Number(row.max_kb_s, 2)),
                ("ip_udp_bytes", "+ IP/UDP", &|row| Cell::Whole(row.ip_udp_bytes)),
                ("agreement", "agreement", &|row| Cell::Share(row.agreement)),
                ("lossless", "lossless", &|row| Cell::text(if row.is_lossless { "yes" } else { "no" })),
                ("encode_ms", "encode ms", &|row| Cell::maybe(row.encode_ms, 2)),
                ("decode_ms", "decode ms", &|row| Cell::maybe(row.decode_ms, 2)),
            ],
        )
    }

    /// Bytes in those of `paper` as bars, the fewest first. What is far beyond `racer` is cut off.
    pub fn bars(&self) -> Markup {
        let mut rows: Vec<(&MethodRow, f64)> =
            self.rows.iter().filter_map(|row| Some((row, row.times_paper()?))).collect();
        rows.sort_by(|a, b| a.1.total_cmp(&b.1));
        let end = self.get("racer").and_then(MethodRow::times_paper).unwrap_or(10.0) * 1.6;
        let bars: Vec<Bar> = rows
            .iter()
            .map(|(row, times)| {
                let (class, right) = if row.agreement >= 1.0 {
                    ("c1", String::new())
                } else {
                    ("c2", format!(", {} right", percent_short(row.agreement)))
                };
                let cut = if *times > end { "▸ " } else { "" };
                Bar {
                    name: row.name.clone(),
                    class,
                    value: times.min(end),
                    text: format!("{cut}× {times:.2}{right}"),
                }
            })
            .collect();
        html! {
            (chart::bars(&bars))
            p.legend {
                "Bytes in those of " code { "paper" } ". "
                span.entry { span.key.c1 {} "every voxel right" } " "
                span.entry { span.key.c2 {} "voxels wrong or missing at the end" }
                " ▸ longer than drawn"
            }
        }
    }
}

impl MethodRow {
    /// Bytes in those of `paper` for the same scans.
    pub fn times_paper(&self) -> Option<f64> {
        (self.paper_bytes > 0).then(|| self.total_bytes as f64 / self.paper_bytes as f64)
    }
}

/// So much of each record goes to the methods that relay scans: packing a second of scans takes about a second.
pub const fn relayed_s(quick: bool) -> f64 {
    if quick { 2.0 } else { 8.0 }
}

/// The methods that relay scans, and the one that they are measured against.
pub fn relays() -> Vec<Method> {
    let mut methods = vec![Method::Whole(Codec::Paper)];
    methods.extend(Method::ALL.into_iter().filter(|method| is_relay(*method)));
    methods
}

const fn is_relay(method: Method) -> bool {
    matches!(method, Method::ScanRelay | Method::ScanRelay1cm)
}

impl MethodRows {
    /// Takes in the relays, measured on the first so many seconds of the same records.
    pub fn add_relays(&mut self, relays: Self, seconds: f64) {
        let rows = relays.rows.into_iter().filter(|row| row.name != "paper").map(|mut row| {
            row.about = format!(
                "{} Measured on the first {seconds} s of each record, and against `paper` on the same.",
                row.about
            );
            row.name = format!("{}, first {seconds} s", row.name);
            row
        });
        self.rows.extend(rows);
    }

    /// Takes in rows that were measured on the whole records by other means.
    pub fn add(&mut self, rows: impl IntoIterator<Item = MethodRow>) {
        let paper_bytes = self.get("paper").map_or(0, |paper| paper.total_bytes);
        let changed_voxels = self.changed_voxels;
        self.rows.extend(rows.into_iter().map(|row| MethodRow { paper_bytes, changed_voxels, ..row }));
    }
}

/// All methods that code batches. Of the codecs cut to datagrams only those that Flockmap would send.
pub fn all() -> Vec<Method> {
    let beside = [Codec::Raw, Codec::NestedZlib, Codec::Racer].map(Method::Datagrams);
    Method::ALL.into_iter().filter(|method| !beside.contains(method) && !is_relay(*method)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_counts_against_the_paper() {
        let row = |name: &str, total_bytes, agreement| MethodRow {
            name: name.to_owned(),
            about: String::new(),
            total_bytes,
            paper_bytes: 1_000,
            changed_voxels: 2_000,
            ip_udp_bytes: 28,
            avg_kb_s: 1.0,
            max_kb_s: 2.0,
            agreement,
            is_lossless: agreement == 1.0,
            is_as_promised: true,
            encode_ms: None,
            decode_ms: Some(1.0),
        };
        let rows = vec![row("paper", 1_000, 1.0), row("racer", 9_600, 1.0), row("gvp", 500, 0.9)];
        let rows = MethodRows { rows, changed_voxels: 2_000, receivers: 1, seconds: 10.0 };
        assert_eq!(rows.ratio("racer", "paper"), Some(9.6));
        assert_eq!(rows.ratio("racer", "none"), None);
        let table = rows.table("t");
        assert_eq!(table.rows[1][2], Cell::Number(9.6, 2));
        assert_eq!(table.rows[0][3], Cell::Number(4.0, 2));
        let bars = rows.bars().into_string();
        assert!(bars.contains("× 0.50, 90.0 % right") && !bars.contains("▸ ×"));
    }
}
