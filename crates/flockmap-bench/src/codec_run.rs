//! Methods of sending a map, side by side on the same batches of the same records.

use std::time::{Duration, Instant};

use anyhow::Context;
use flockmap::codec::Batch;
use flockmap::grid::{Layer, Mapper, MapperConfig};
use flockmap::{BatchConfig, Changes, Packer, RobotId, Stamp, Stream};
use flockmap_cli::measure::{Comparison, KB, SentBytes, Times, blocks_of};
use flockmap_cli::sources::Frame;
use flockmap_cli::stop;
use serde::Serialize;

use crate::baselines::{Messages, Method, Observation, Receiver, Sender};

/// All methods at work. One record after another; each is a robot that all the others listen to.
pub struct CodecRun {
    mapper: MapperConfig,
    batch: BatchConfig,
    receivers: u64,
    benches: Vec<Bench>,
    seconds: f64,
    batches: u64,
    changed_voxels: u64,
}

/// What came out.
pub struct Outcome {
    /// Of all records together.
    pub seconds: f64,
    /// Of all records together.
    pub batches: u64,
    /// Voxels in all batches together.
    pub changed_voxels: u64,
    /// One for each method, in the order asked for.
    pub rows: Vec<Row>,
}

/// What a method cost and how far it is right. What is skipped is not in the JSON of `codecs`.
#[derive(Serialize)]
pub struct Row {
    #[serde(rename = "name")]
    pub method: Method,
    /// Of all robots together, each message once for each receiver: with its own headers, without IP and UDP.
    pub total_bytes: u64,
    /// Total by the length of all records together, so the mean of the robots.
    pub avg_kb_s: f64,
    /// Largest window of one second of any robot.
    pub max_kb_s: f64,
    /// Messages, each once for each receiver.
    pub packages: u64,
    /// Datagrams of at most 1,472 bytes that carry them: 28 bytes of IP and UDP each come on top.
    #[serde(skip)]
    pub datagrams: u64,
    /// Time for all messages of a batch with its scans, on the sender, and for a batch on one receiver.
    pub encode_ms_mean: f64,
    pub encode_ms_p99: f64,
    pub decode_ms_mean: f64,
    /// Batches that these times are means of.
    #[serde(skip)]
    pub timed: usize,
    /// Share of the voxels known to the sender, as packed, or to a receiver, when all has arrived, that are equal; less than 1 is a
    /// fault of a lossless method.
    pub agreement: f64,
    #[serde(skip)]
    pub compared: Comparison,
    #[serde(skip)]
    stamps_differ: bool,
}

impl Row {
    /// Whether the method does what it says: a lossless one has every voxel, and every stamp that it sends, right.
    pub fn is_as_promised(&self) -> bool {
        !self.method.is_lossless() || (self.compared.known == self.compared.equal && !self.stamps_differ)
    }
}

impl CodecRun {
    /// Nothing measured yet. Each robot's messages go to so many `receivers`, one by one (unicast: N − 1).
    pub fn new(mapper: MapperConfig, batch: BatchConfig, methods: &[Method], receivers: usize) -> Self {
        let benches = methods.iter().map(|method| Bench { method: *method, sums: Sums::default() }).collect();
        let receivers = receivers.max(1) as u64;
        Self { mapper, batch, receivers, benches, seconds: 0.0, batches: 0, changed_voxels: 0 }
    }

    /// The record of one robot: maps it, closes batches, and gives each batch to every method. Stamps must begin near 0.
    /// Calls `progress` after each scan. Ends early if the user asks for it. Returns what was published in the end.
    pub fn record(
        &mut self,
        frames: impl IntoIterator<Item = Frame>,
        mut progress: impl FnMut(),
    ) -> anyhow::Result<Layer> {
        let number = self.benches.first().map_or(0, |bench| bench.sums.robots);
        let stream = Stream { origin: RobotId(number as u16 + 1), epoch: 1 };
        let mut mapper = Mapper::new(self.mapper.clone())?;
        let mut packer = Packer::new(self.batch, stream, self.mapper.resolution, Stamp(0));
        let mut truth = Layer::default();
        let mut lanes = self
            .benches
            .iter_mut()
            .map(|bench| bench.lane(&self.mapper, self.receivers))
            .collect::<anyhow::Result<Vec<_>>>()?;
        let (batches, changed_voxels) = (&mut self.batches, &mut self.changed_voxels);
        let mut close = |now, lanes: &mut [Lane<'_>], (batch, changes): (Batch, Changes)| {
            *batches += 1;
            *changed_voxels += changes.len() as u64;
            truth.apply(&changes, batch.end);
            truth.note_sensor(batch.end, batch.sensor);
            lanes.iter_mut().try_for_each(|lane| lane.batch(now, &batch, &changes))
        };
        let mut last = Stamp(0);
        for frame in frames {
            if stop::requested() {
                break;
            }
            let masks = frame.masks();
            let Frame { scan, pose, .. } = frame;
            // The deadline of a batch may pass between two scans.
            while let Some(deadline) = packer.deadline(&mapper).filter(|at| *at < scan.stamp) {
                let now = deadline.max(last);
                match packer.close_due(now, &mut mapper) {
                    Some(batch) => close(now, &mut lanes, batch)?,
                    None => break,
                }
            }
            last = scan.stamp;
            mapper.insert(&scan, &pose, &masks);
            packer.note_scan(last, &pose);
            let seen = Observation { scan: &scan, pose: &pose, masks: &masks };
            lanes.iter_mut().try_for_each(|lane| lane.scan(last, &seen))?;
            while let Some(batch) = packer.close_due(last, &mut mapper) {
                close(last, &mut lanes, batch)?;
            }
            progress();
        }
        if let Some(batch) = packer.close(last, &mut mapper) {
            close(last, &mut lanes, batch)?;
        }
        lanes.into_iter().for_each(|lane| lane.end(&truth));
        self.seconds += last.seconds();
        Ok(truth)
    }

    /// What came out of all records so far.
    pub fn finish(self) -> Outcome {
        let Self { seconds, batches, changed_voxels, .. } = self;
        let rows = self.benches.into_iter().map(|bench| bench.row(seconds)).collect();
        Outcome { seconds, batches, changed_voxels, rows }
    }
}

/// One method over all records.
struct Bench {
    method: Method,
    sums: Sums,
}

/// What a method came to.
#[derive(Default)]
struct Sums {
    packages: u64,
    datagrams: u64,
    encode: Times,
    decode: Times,
    compared: Comparison,
    stamps_differ: bool,
    /// Robots so far, what they sent, and most that one sent in a second.
    robots: usize,
    total_bytes: u64,
    second_bytes_max: u64,
}

/// One method on one record.
struct Lane<'a> {
    bench: &'a mut Bench,
    sender: Box<dyn Sender>,
    receiver: Box<dyn Receiver>,
    receivers: u64,
    sent: SentBytes,
    /// Time that the sender took since the last batch.
    took: Duration,
    messages: Messages,
}

/// Most bytes of UDP payload in an Ethernet frame.
const DATAGRAM_BYTES: usize = 1_472;

impl Bench {
    fn lane(&mut self, mapper: &MapperConfig, receivers: u64) -> anyhow::Result<Lane<'_>> {
        Ok(Lane {
            sender: self.method.sender(mapper),
            receiver: self.method.receiver(mapper)?,
            bench: self,
            receivers,
            sent: SentBytes::default(),
            took: Duration::ZERO,
            messages: Vec::new(),
        })
    }

    fn row(self, seconds: f64) -> Row {
        let Sums { packages, datagrams, total_bytes, compared, stamps_differ, .. } = self.sums;
        let encode = self.sums.encode.summary();
        Row {
            method: self.method,
            total_bytes,
            avg_kb_s: total_bytes as f64 / KB / seconds.max(1e-3),
            max_kb_s: self.sums.second_bytes_max as f64 / KB,
            packages,
            datagrams,
            encode_ms_mean: encode.mean_ms,
            encode_ms_p99: encode.p99_ms,
            decode_ms_mean: self.sums.decode.summary().mean_ms,
            timed: encode.count,
            agreement: compared.share(),
            compared,
            stamps_differ,
        }
    }
}

impl Lane<'_> {
    fn scan(&mut self, now: Stamp, seen: &Observation<'_>) -> anyhow::Result<()> {
        let started = Instant::now();
        self.sender.scan(seen, &mut self.messages).with_context(|| self.bench.method.to_string())?;
        self.took += started.elapsed();
        if self.messages.is_empty() { Ok(()) } else { self.deliver(now).map(|_| ()) }
    }

    fn batch(&mut self, now: Stamp, batch: &Batch, changes: &Changes) -> anyhow::Result<()> {
        let started = Instant::now();
        self.sender
            .batch(now, batch, changes, &mut self.messages)
            .with_context(|| self.bench.method.to_string())?;
        self.bench.sums.encode.add(core::mem::take(&mut self.took) + started.elapsed());
        self.sender.published(batch, changes);
        let took = self.deliver(now)?;
        self.bench.sums.decode.add(took);
        Ok(())
    }

    /// Counts the messages and gives them to the receiver. Returns the time that it took.
    fn deliver(&mut self, now: Stamp) -> anyhow::Result<Duration> {
        let mut took = Duration::ZERO;
        for message in self.messages.drain(..) {
            self.sent.add(now, message.len() as u64 * self.receivers);
            self.bench.sums.packages += self.receivers;
            self.bench.sums.datagrams += message.len().div_ceil(DATAGRAM_BYTES) as u64 * self.receivers;
            let started = Instant::now();
            self.receiver.receive(&message).with_context(|| self.bench.method.to_string())?;
            took += started.elapsed();
        }
        Ok(took)
    }

    /// The record is over: compares with what the batches said.
    fn end(self, truth: &Layer) {
        let compared = Comparison::of(self.receiver.states(), blocks_of(truth));
        let sums = &mut self.bench.sums;
        sums.compared.known += compared.known;
        sums.compared.equal += compared.equal;
        sums.stamps_differ |= self.receiver.layer().is_some_and(|layer| layer.digest() != truth.digest());
        sums.robots += 1;
        sums.total_bytes += self.sent.total();
        sums.second_bytes_max = sums.second_bytes_max.max(self.sent.largest_second());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap::{Pose, Preset, Resolution, Scan};

    fn frames() -> impl Iterator<Item = Frame> {
        (1..30i64).map(|number| {
            let wall = |y: i32| [2.0 + number as f32 * 0.03, y as f32 * 0.05, 0.02 * y as f32];
            let scan = Scan {
                stamp: Stamp(number * 100_000),
                points: (-30..30).map(wall).collect(),
                ..Scan::default()
            };
            Frame { scan, pose: Pose::IDENTITY, team_mates: Vec::new() }
        })
    }

    fn run(receivers: usize) -> Outcome {
        let mapper = MapperConfig::preset(Preset::RogMap, Resolution::from_metres(0.1).unwrap(), 7.0);
        let methods = ["paper", "scan-relay", "gvp", "octomap-diff-10s"].map(|name| name.parse().unwrap());
        let mut run = CodecRun::new(mapper, BatchConfig::default(), &methods, receivers);
        for _ in 0..2 {
            run.record(frames(), || ()).unwrap();
        }
        run.finish()
    }

    #[test]
    fn every_receiver_costs_the_same_again() {
        let (one, three) = (run(1), run(3));
        for (one, three) in one.rows.iter().zip(&three.rows) {
            assert_eq!(3 * one.total_bytes, three.total_bytes, "{}", one.method);
            assert_eq!(3 * one.packages, three.packages);
            assert_eq!(one.compared, three.compared, "one receiver is decoded for all");
        }
    }

    #[test]
    fn what_a_method_leaves_unsent_counts_against_it() {
        let outcome = run(1);
        let agreement = |name: &str| {
            let row = outcome.rows.iter().find(|row| row.method.to_string() == name).unwrap();
            assert!(row.is_as_promised(), "{name}");
            row.compared.share()
        };
        assert_eq!((agreement("paper"), agreement("scan-relay")), (1.0, 1.0));
        assert_eq!(agreement("octomap-diff-10s"), 0.0, "the record is shorter than its period");
        assert!(agreement("gvp") < 1.0);
    }
}
