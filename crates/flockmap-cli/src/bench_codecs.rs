//! `flockmap bench codecs`: all methods on the same cycles.

use core::fmt;
use core::str::FromStr;

use flockmap::codec::Codec;
use flockmap_baselines::{Method, UnknownMethod};
use serde::Serialize;

use crate::args::BenchCodecsArgs;
use crate::codec_run::{self, CodecRun, Outcome};
use crate::measure::KB;
use crate::present_run::{self, PresentRow};
use crate::progress::Progress;
use crate::table::{Table, kb, percent, thousands};
use crate::{json_file, sources, stop};

/// What `--codec` takes: a method, or all of them.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum MethodName {
    One(Method),
    All,
}

impl FromStr for MethodName {
    type Err = UnknownMethod;

    fn from_str(name: &str) -> Result<Self, UnknownMethod> {
        if name == "all" { Ok(Self::All) } else { name.parse().map(Self::One) }
    }
}

impl fmt::Display for MethodName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::One(method) => method.fmt(f),
            Self::All => f.pad("all"),
        }
    }
}

/// The methods that are named, each once. Named none: the short list.
fn methods(names: &[MethodName]) -> Vec<Method> {
    if names.is_empty() {
        let others = Codec::ALL.into_iter().filter(|codec| *codec != Codec::Flock);
        let mut methods: Vec<Method> = others.map(Method::Whole).collect();
        methods.push(Method::Datagrams(Codec::Paper));
        methods.push(Method::Datagrams(Codec::Flock));
        return methods;
    }
    let mut methods: Vec<Method> = Vec::new();
    for name in names {
        let named = match name {
            MethodName::One(method) => core::slice::from_ref(method),
            MethodName::All => Method::ALL.as_slice(),
        };
        for method in named {
            if !methods.contains(method) {
                methods.push(*method);
            }
        }
    }
    methods
}

/// What the JSON holds.
#[derive(Serialize, Debug)]
struct Output {
    records: Vec<String>,
    resolution_m: f64,
    range_m: f64,
    t_l_s: f64,
    d: usize,
    changed_voxels: u64,
    methods: Vec<Row>,
    /// The final maps, as a late joiner gets them. Only of methods that make map packages.
    present_states: Vec<PresentRow>,
}

#[derive(Serialize, Debug)]
struct Row {
    name: String,
    /// Of all records together: packages with their headers, without IP and UDP.
    total_bytes: u64,
    /// Total by the length of all records together, so per robot.
    avg_kb_s: f64,
    /// Largest window of one second of any record.
    max_kb_s: f64,
    packages: u64,
    /// Times are for all packages of a cycle.
    encode_ms_mean: f64,
    encode_ms_p99: f64,
    decode_ms_mean: f64,
    /// Share of voxels that the receiver has as they were packed; less than 1 is a fault of a lossless method.
    agreement: f64,
}

impl From<&codec_run::Row> for Row {
    fn from(row: &codec_run::Row) -> Self {
        Self {
            name: row.method.to_string(),
            total_bytes: row.total_bytes,
            avg_kb_s: row.avg_kb_s,
            max_kb_s: row.max_kb_s,
            packages: row.packages,
            encode_ms_mean: row.encode.mean_ms,
            encode_ms_p99: row.encode.p99_ms,
            decode_ms_mean: row.decode.mean_ms,
            agreement: row.compared.share(),
        }
    }
}

/// Runs the command. Whether every lossless method is lossless.
pub fn run(args: &BenchCodecsArgs) -> anyhow::Result<bool> {
    let (mapper, cycle) = (args.map.mapper()?, args.map.cycle()?);
    let sources = sources::open(&args.records, &args.source, args.map.range, false)?;
    let methods = methods(&args.codec);
    let resolution = mapper.resolution;
    let mut run = CodecRun::new(mapper, cycle, &methods, 1);
    let mut layers = Vec::new();
    let expected = sources.robots.iter().map(|source| source.frames_expected).sum();
    let mut progress = Progress::new("scans", expected);
    let mut names = Vec::new();
    for source in sources.robots {
        progress.say(format!("{}: scans", source.name));
        names.push(source.name);
        layers.push(run.record(source.frames, || progress.step())?);
    }
    drop(progress);
    let outcome = run.finish();
    let present_states = present_run::run(&layers, resolution, &methods)?;
    let output = Output {
        records: names,
        resolution_m: args.map.resolution,
        range_m: args.map.range,
        t_l_s: args.map.t_l,
        d: args.map.d,
        changed_voxels: outcome.changed_voxels,
        methods: outcome.rows.iter().map(Row::from).collect(),
        present_states,
    };
    print(&output, &sources.title, &outcome);
    if let Some(path) = &args.json {
        json_file::write(path, &output)?;
    }
    let broken: Vec<String> =
        outcome.rows.iter().filter(|row| !row.is_as_promised()).map(|row| row.method.to_string()).collect();
    if !broken.is_empty() {
        eprintln!(
            "error: {} should give back what went in and does not: this is a fault of flockmap, please report it",
            broken.join(", ")
        );
    }
    Ok(broken.is_empty())
}

fn print(output: &Output, title: &str, outcome: &Outcome) {
    let Output { resolution_m, range_m, t_l_s, d, changed_voxels, methods, .. } = output;
    let Outcome { seconds, cycles, rows, .. } = outcome;
    println!("{title}");
    println!(
        "  {resolution_m} m voxels, {range_m} m range, t_l {t_l_s} s, d {}; {seconds:.1} s in all, {} cycles, {} changed voxels{}\n",
        thousands(*d as u64),
        thousands(*cycles),
        thousands(*changed_voxels),
        if stop::requested() { " (partial: ended by Ctrl-C)" } else { "" }
    );
    let reference = methods.iter().find(|row| row.name == "paper").map(|row| row.total_bytes);
    let mut table = Table::new([
        "method",
        "total bytes",
        "vs paper",
        "bits/voxel",
        "avg KB/s",
        "max KB/s",
        "packages",
        "IP + UDP",
        "encode ms",
        "99 %",
        "decode ms",
        "agreement",
    ]);
    let mut lossy = Vec::new();
    for (row, run) in methods.iter().zip(rows) {
        let ratio = reference.map_or_else(String::new, |paper| {
            format!("×{:.2}", row.total_bytes as f64 / paper.max(1) as f64)
        });
        table.row([
            row.name.clone(),
            thousands(row.total_bytes),
            ratio,
            format!("{:.2}", row.total_bytes as f64 * 8.0 / (*changed_voxels).max(1) as f64),
            kb(row.avg_kb_s * KB),
            kb(row.max_kb_s * KB),
            thousands(row.packages),
            thousands(run.datagrams * 28),
            format!("{:.2}", row.encode_ms_mean),
            format!("{:.2}", row.encode_ms_p99),
            format!("{:.2}", row.decode_ms_mean),
            if run.method.is_lossless() {
                percent(row.agreement)
            } else {
                lossy.push(run.method);
                format!("{} *", percent(row.agreement))
            },
        ]);
    }
    print!("{table}");
    println!(
        "
  Bytes of packages with their headers; IP and UDP come on top with 28 bytes for each datagram of at most 1,472 bytes. KB = 1,024
  bytes. Average: a robot's, over the whole record; max: largest second of any robot. Times: all packages of a cycle, one core. `racer` is its 4 + 1 bytes a
  voxel in one package a cycle; its own messages of 200 voxels add 52 bytes each. Agreement: voxels equal to those packed, of
  all that either side knows, when everything has arrived."
    );
    for method in lossy {
        println!("  * {method}: {}", method.about());
    }
    print_present_states(&output.present_states);
}

fn print_present_states(rows: &[PresentRow]) {
    if rows.is_empty() {
        return;
    }
    println!("\n  The final map as a present state, with all its stamps: what a late joiner gets.\n");
    let reference = rows.iter().find(|row| row.name == "paper").map(|row| row.total_bytes);
    let mut table = Table::new(["method", "total bytes", "vs paper", "tiles", "encode ms", "decode ms"]);
    for row in rows {
        table.row([
            row.name.clone(),
            thousands(row.total_bytes),
            reference.map_or_else(String::new, |paper| {
                format!("×{:.3}", row.total_bytes as f64 / paper.max(1) as f64)
            }),
            thousands(row.tiles),
            format!("{:.1}", row.encode_ms),
            format!("{:.1}", row.decode_ms),
        ]);
    }
    print!("{table}");
    println!(
        "  Tiles of at most 1,150 bytes; where the changes are not cut, of at most 1 MiB. Decoding includes merging."
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn methods_are_named_once_each() {
        let named = |list: &str| {
            methods(&list.split(',').map(|name| name.parse().unwrap()).collect::<Vec<MethodName>>())
        };
        assert_eq!(methods(&[]).len(), 6);
        assert_eq!(named("paper,racer,paper"), [Method::Whole(Codec::Paper), Method::Whole(Codec::Racer)]);
        assert_eq!(named("racer,all").len(), Method::ALL.len());
        assert!("datagrams".parse::<MethodName>().is_err());
    }
}
