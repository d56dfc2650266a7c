//! `flockmap-bench codecs`: all methods on the same batches.

use core::str::FromStr;
use flockmap_cli::outputs;
use std::path::PathBuf;

use clap::Args;
use flockmap::codec::Codec;
use flockmap_cli::document::DataTable;
use flockmap_cli::measure::IP_UDP_BYTES;
use flockmap_cli::measure::KB;
use flockmap_cli::numbers::{kb, percent, thousands};
use flockmap_cli::options::{MapArgs, SourceArgs};
use flockmap_cli::progress::Progress;
use flockmap_cli::{json_file, sources, stop};
use serde::Serialize;

use crate::baselines::Method;
use crate::codec_run::{CodecRun, Row};
use crate::snapshot_run::{self, SnapshotRow};

/// All codecs on the same batches of mapping: bytes, time, agreement
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap-bench codecs forest --lidar avia
  flockmap-bench codecs robot1.mcap robot2.mcap --resolution 0.2 --range 30 --json codecs.json
  flockmap-bench codecs forest --codec paper,flock
  flockmap-bench codecs forest --codec paper,flock --obstacle-period 0.1 --publish-period 2
  flockmap-bench codecs forest --codec all

A method is `flock`, Flockmap's own codec, in packages of at most 1,150 bytes; or another codec (raw, nested-zlib, paper,
racer), which codes each batch as one package, or with `-datagrams` in such packages as well; or a rival. Some rivals are
lossy or stale: they are marked, and their agreement is what they reach.
Exit code 1 if a lossless method gets a voxel wrong.")]
pub struct CodecsArgs {
    /// Records, or one world: forest, indoor, or a .bt .pcd .ply .las .laz file
    #[arg(value_name = "RECORD", required = true)]
    pub records: Vec<PathBuf>,
    /// Methods, separated by commas, or all [default: raw,nested-zlib,paper,racer,paper-datagrams,flock]
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub codec: Vec<Named>,
    /// Write the table as JSON
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub json: Option<PathBuf>,
    #[command(flatten)]
    pub map: MapArgs,
    #[command(flatten)]
    pub source: SourceArgs,
}

/// What a word of `--codec` names: a method, or all of them.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Named(pub Vec<Method>);

impl FromStr for Named {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        if name == "all" {
            Ok(Self(Method::ALL.to_vec()))
        } else {
            name.parse().map(|method| Self(vec![method]))
        }
    }
}

/// The methods that are named, each once. Named none: the short list.
fn methods(names: &[Named]) -> Vec<Method> {
    let mut methods: Vec<Method> = Vec::new();
    for method in names.iter().flat_map(|named| &named.0) {
        if !methods.contains(method) {
            methods.push(*method);
        }
    }
    if names.is_empty() {
        let others = Codec::ALL.into_iter().filter(|codec| *codec != Codec::Flock);
        methods.extend(others.map(Method::Whole).chain([Codec::Paper, Codec::Flock].map(Method::Datagrams)));
    }
    methods
}

/// What the JSON holds.
#[derive(Serialize)]
struct Output<'a> {
    records: Vec<String>,
    resolution_m: f64,
    range_m: f64,
    publish_period_s: f64,
    batch_limit: usize,
    changed_voxels: u64,
    methods: &'a [Row],
    /// The final maps, as a late joiner gets them. Only of methods that make map packages.
    snapshots: Vec<SnapshotRow>,
}

/// Runs the command. Whether every lossless method is lossless.
pub fn run(args: &CodecsArgs) -> anyhow::Result<bool> {
    let (mapper, batch) = (args.map.mapper()?, args.map.batch()?);
    let sources = sources::open(&args.records, &args.source, args.map.range, false)?;
    let methods = methods(&args.codec);
    let resolution = mapper.resolution;
    let mut run = CodecRun::new(mapper, batch, &methods, 1);
    let mut layers = Vec::new();
    let expected = sources.robots.iter().map(|source| source.frames_expected).sum();
    let progress = Progress::new("scans", expected);
    let records = sources.robots.iter().map(|source| source.name.clone()).collect();
    for source in sources.robots {
        progress.say(format!("{}: scans", source.name));
        layers.push(run.record(source.frames, || progress.step())?);
    }
    drop(progress);
    let rows = run.rows();
    let snapshots = snapshot_run::run(&layers, resolution, &methods)?;
    let output = Output {
        records,
        resolution_m: args.map.resolution,
        range_m: args.map.range,
        publish_period_s: args.map.publish_period,
        batch_limit: args.map.batch_limit,
        changed_voxels: run.changed_voxels,
        methods: &rows,
        snapshots,
    };
    print(&output, &sources.title, &run);
    json_file::write_asked(args.json.as_deref(), &output)?;
    let broken: Vec<String> =
        rows.iter().filter(|row| !row.is_as_promised).map(|row| row.name.clone()).collect();
    if !broken.is_empty() {
        eprintln!(
            "error: {} should give back what went in and does not: this is a fault of flockmap, please report it",
            broken.join(", ")
        );
    }
    Ok(broken.is_empty())
}

fn print(output: &Output<'_>, title: &str, run: &CodecRun) {
    let Output { resolution_m, range_m, publish_period_s, batch_limit, changed_voxels, methods, .. } = output;
    let CodecRun { seconds, batches, .. } = run;
    println!("{title}");
    println!(
        "  {resolution_m} m voxels, {range_m} m range, publish period {publish_period_s} s, batch limit {}; {seconds:.1} s in all, {} batches, {} changed voxels{}\n",
        thousands(*batch_limit as u64),
        thousands(*batches),
        thousands(*changed_voxels),
        if stop::requested() { " (partial: ended by Ctrl-C)" } else { "" }
    );
    let paper = methods.iter().find(|row| row.method == Method::Whole(Codec::Paper));
    let paper = paper.map(|row| row.total_bytes);
    let bits = |row: &Row| row.total_bytes as f64 * 8.0 / (*changed_voxels).max(1) as f64;
    let table = DataTable::of_text(
        methods,
        &[
            ("method", &|row| row.name.clone()),
            ("total bytes", &|row| thousands(row.total_bytes)),
            ("vs paper", &|row| beside(paper, row.total_bytes, 2)),
            ("bits/voxel", &|row| format!("{:.2}", bits(row))),
            ("avg KB/s", &|row| kb(row.avg_kb_s * KB)),
            ("max KB/s", &|row| kb(row.max_kb_s * KB)),
            ("packages", &|row| thousands(row.packages)),
            ("IP + UDP", &|row| thousands(row.datagrams * IP_UDP_BYTES)),
            ("encode ms", &|row| format!("{:.2}", row.encode_ms_mean)),
            ("99 %", &|row| format!("{:.2}", row.encode_ms_p99)),
            ("decode ms", &|row| format!("{:.2}", row.decode_ms_mean)),
            ("agreement", &|row| percent(row.agreement) + if row.method.is_lossless() { "" } else { " *" }),
        ],
    );
    print!("{table}");
    println!(
        "
  Bytes of packages with their headers; IP and UDP come on top with 28 bytes for each datagram of at most 1,472 bytes. KB = 1,024
  bytes. Average: a robot's, over the whole record; max: largest second of any robot. Times: all packages of a batch, one core. `racer` is its 4 + 1 bytes a
  voxel in one package a batch; its own messages of 200 voxels add 52 bytes each. Agreement: voxels equal to those packed, of
  all that either side knows, when everything has arrived."
    );
    for method in methods.iter().map(|row| row.method).filter(|method| !method.is_lossless()) {
        println!("  * {method}: {}", method.about());
    }
    print_snapshots(&output.snapshots);
}

/// Bytes in those of `paper`, if they were measured.
fn beside(paper: Option<u64>, bytes: u64, digits: usize) -> String {
    let ratio = |paper: u64| format!("×{:.digits$}", bytes as f64 / paper.max(1) as f64);
    paper.map_or_else(String::new, ratio)
}

fn print_snapshots(rows: &[SnapshotRow]) {
    if rows.is_empty() {
        return;
    }
    println!("\n  The final map as a snapshot, with all its stamps: what a late joiner gets.\n");
    let paper = rows.iter().find(|row| row.name == "paper").map(|row| row.total_bytes);
    let table = DataTable::of_text(
        rows,
        &[
            ("method", &|row| row.name.clone()),
            ("total bytes", &|row| thousands(row.total_bytes)),
            ("vs paper", &|row| beside(paper, row.total_bytes, 3)),
            ("chunks", &|row| thousands(row.chunks)),
            ("encode ms", &|row| format!("{:.1}", row.encode_ms)),
            ("decode ms", &|row| format!("{:.1}", row.decode_ms)),
        ],
    );
    print!("{table}");
    println!(
        "  Chunks of at most 1,150 bytes; where the changes are not cut, of at most 1 MiB. Decoding includes merging."
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn methods_are_named_once_each() {
        let named =
            |list: &str| methods(&list.split(',').map(|name| name.parse().unwrap()).collect::<Vec<Named>>());
        assert_eq!(methods(&[]).len(), 6);
        assert_eq!(named("paper,racer,paper"), [Method::Whole(Codec::Paper), Method::Whole(Codec::Racer)]);
        assert_eq!(named("racer,all").len(), Method::ALL.len());
        assert!("datagrams".parse::<Named>().is_err());
    }
}
