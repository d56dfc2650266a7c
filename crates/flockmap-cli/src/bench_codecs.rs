//! `flockmap bench codecs`: all codecs on the same cycles.

use core::fmt;
use core::str::FromStr;
use std::time::{Duration, Instant};

use flockmap::codec::{Codec, Content, Cycle, Decoder, Encoder, PACKAGE_BYTES_MAX, Package};
use flockmap::grid::{Layer, Mapper};
use flockmap::{Changes, Packer, RobotId, Stamp, Stream};
use serde::Serialize;

use crate::args::BenchCodecsArgs;
use crate::measure::{Comparison, KB, Sent, Times};
use crate::progress::Progress;
use crate::table::{Table, kb, percent, thousands};
use crate::{json_file, sources, stop};

/// A codec, and whether it codes a cycle whole or cut into datagrams.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Method {
    codec: Codec,
    datagrams: bool,
}

const DATAGRAMS: &str = "-datagrams";

impl FromStr for Method {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let (codec, datagrams) = name.strip_suffix(DATAGRAMS).map_or((name, false), |codec| (codec, true));
        let codec = codec.parse().map_err(|error| format!("{error}, each also with {DATAGRAMS}"))?;
        Ok(Self { codec, datagrams })
    }
}

impl fmt::Display for Method {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}", self.codec.name(), if self.datagrams { DATAGRAMS } else { "" })
    }
}

fn default_methods() -> Vec<Method> {
    let mut methods: Vec<Method> =
        Codec::ALL.into_iter().map(|codec| Method { codec, datagrams: false }).collect();
    methods.push(Method { codec: Codec::Paper, datagrams: true });
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
    /// Share of voxels that come out as they went in; anything but 1 is a fault.
    agreement: f64,
}

/// One method at work.
struct Bench {
    method: Method,
    encoder: Encoder,
    decoder: Decoder,
    next_index: u32,
    layer: Layer,
    sent: Sent,
    total: u64,
    largest_second: u64,
    packages: u64,
    encode: Times,
    decode: Times,
    compared: Comparison,
    stamps_agree: bool,
}

impl Bench {
    fn new(method: Method) -> Self {
        Self {
            method,
            encoder: Encoder::new(),
            decoder: Decoder::new(),
            next_index: 1,
            layer: Layer::default(),
            sent: Sent::default(),
            total: 0,
            largest_second: 0,
            packages: 0,
            encode: Times::default(),
            decode: Times::default(),
            compared: Comparison::default(),
            stamps_agree: true,
        }
    }

    fn cycle(&mut self, now: Stamp, cycle: &Cycle, changes: &Changes) -> anyhow::Result<()> {
        let Method { codec, datagrams } = self.method;
        let started = Instant::now();
        let packages = if datagrams {
            self.encoder.encode_cycle(codec, cycle, self.next_index, changes, PACKAGE_BYTES_MAX)?
        } else {
            vec![self.encoder.encode_whole(codec, cycle, self.next_index, changes)?]
        };
        self.encode.add(started.elapsed());
        self.next_index += packages.len() as u32;
        self.packages += packages.len() as u64;
        let mut took = Duration::ZERO;
        for package in &packages {
            self.sent.add(now, package.bytes().len() as u64);
            let started = Instant::now();
            let received = Package::parse(package.bytes())?;
            let content = self.decoder.decode(&received)?;
            took += started.elapsed();
            if let Content::Changes(decoded) = content {
                self.layer.apply(&decoded, received.header().cycle_end);
            }
        }
        self.decode.add(took);
        Ok(())
    }

    /// The record is over: compares with what the cycles said.
    fn end_record(&mut self, truth: &Layer) {
        let compared = Comparison::of_layers(&self.layer, truth);
        self.compared.known += compared.known;
        self.compared.equal += compared.equal;
        self.stamps_agree &= self.layer.digest() == truth.digest();
        self.total += self.sent.total();
        self.largest_second = self.largest_second.max(self.sent.largest_second());
        self.layer = Layer::default();
        self.sent = Sent::default();
        self.next_index = 1;
    }

    fn row(&self, seconds: f64) -> Row {
        let (encode, decode) = (self.encode.summary(), self.decode.summary());
        Row {
            name: self.method.to_string(),
            total_bytes: self.total,
            avg_kb_s: self.total as f64 / KB / seconds.max(1e-3),
            max_kb_s: self.largest_second as f64 / KB,
            packages: self.packages,
            encode_ms_mean: encode.mean_ms,
            encode_ms_p99: encode.p99_ms,
            decode_ms_mean: decode.mean_ms,
            agreement: self.compared.share(),
        }
    }
}

/// Runs the command. Whether every method is lossless.
pub fn run(args: &BenchCodecsArgs) -> anyhow::Result<bool> {
    let (resolution, cycle_config, mapper_config) =
        (args.map.resolution()?, args.map.cycle()?, args.map.mapper()?);
    let sources = sources::open(&args.records, &args.source, args.map.range, false)?;
    let methods = if args.codec.is_empty() { default_methods() } else { args.codec.clone() };
    let mut benches: Vec<Bench> = methods.into_iter().map(Bench::new).collect();
    let expected = sources.robots.iter().map(|source| source.frames_expected).sum();
    let mut progress = Progress::new("scans", expected);
    let (mut seconds, mut changed_voxels, mut cycles) = (0.0, 0u64, 0u64);
    let mut names = Vec::new();
    for (number, source) in sources.robots.into_iter().enumerate() {
        progress.say(format!("{}: scans", source.name));
        names.push(source.name);
        let stream = Stream { origin: RobotId(number as u16 + 1), epoch: 1 };
        let mut mapper = Mapper::new(mapper_config.clone())?;
        let mut packer = Packer::new(cycle_config, stream, resolution, Stamp(0));
        let mut truth = Layer::default();
        let mut last = Stamp(0);
        let mut each = |now, (cycle, changes): (Cycle, Changes)| -> anyhow::Result<()> {
            changed_voxels += changes.len() as u64;
            cycles += 1;
            truth.apply(&changes, cycle.end);
            benches.iter_mut().try_for_each(|bench| bench.cycle(now, &cycle, &changes))
        };
        for frame in source.frames {
            if stop::requested() {
                break;
            }
            // The deadline of a cycle may pass between two scans.
            while let Some(deadline) = packer.deadline(&mapper).filter(|at| *at < frame.scan.stamp) {
                let now = deadline.max(last);
                match packer.close_due(now, &mut mapper) {
                    Some(cycle) => each(now, cycle)?,
                    None => break,
                }
            }
            last = frame.scan.stamp;
            mapper.insert(&frame.scan, &frame.pose, &[]);
            packer.note_scan(last);
            while let Some(cycle) = packer.close_due(last, &mut mapper) {
                each(last, cycle)?;
            }
            progress.step();
        }
        if let Some(cycle) = packer.close(last, &mut mapper) {
            each(last, cycle)?;
        }
        seconds += last.seconds();
        benches.iter_mut().for_each(|bench| bench.end_record(&truth));
    }
    drop(progress);
    let output = Output {
        records: names,
        resolution_m: args.map.resolution,
        range_m: args.map.range,
        t_l_s: args.map.t_l,
        d: args.map.d,
        changed_voxels,
        methods: benches.iter().map(|bench| bench.row(seconds)).collect(),
    };
    print(&output, &sources.title, seconds, cycles);
    if let Some(path) = &args.json {
        json_file::write(path, &output)?;
    }
    let lossless = benches.iter().all(|bench| bench.compared.share() == 1.0 && bench.stamps_agree);
    if !lossless {
        eprintln!(
            "error: a method does not give back what went in: this is a fault of flockmap, please report it"
        );
    }
    Ok(lossless)
}

fn print(output: &Output, title: &str, seconds: f64, cycles: u64) {
    let Output { resolution_m, range_m, t_l_s, d, changed_voxels, methods, .. } = output;
    println!("{title}");
    println!(
        "  {resolution_m} m voxels, {range_m} m range, t_l {t_l_s} s, d {}; {seconds:.1} s in all, {} cycles, {} changed voxels{}\n",
        thousands(*d as u64),
        thousands(cycles),
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
        "encode ms",
        "99 %",
        "decode ms",
        "agreement",
    ]);
    for row in methods {
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
            format!("{:.2}", row.encode_ms_mean),
            format!("{:.2}", row.encode_ms_p99),
            format!("{:.2}", row.decode_ms_mean),
            percent(row.agreement),
        ]);
    }
    print!("{table}");
    println!(
        "
  Bytes of packages with their headers; IP and UDP add 28 bytes to each datagram. KB = 1,024 bytes. Average: a robot's, over the
  whole record; max: largest second of any robot. Times: all packages of a cycle, one core. `racer` is its 4 + 1 bytes a
  voxel in one package a cycle; its own messages of 200 voxels add 52 bytes each."
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn methods_have_names() {
        for name in ["raw", "nested-zlib", "paper", "racer", "paper-datagrams", "racer-datagrams"] {
            assert_eq!(name.parse::<Method>().unwrap().to_string(), name);
        }
        assert!("datagrams".parse::<Method>().is_err());
    }
}
