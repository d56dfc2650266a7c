//! Methods of sending a map, side by side on the same batches of the same records.

use std::time::{Duration, Instant};

use anyhow::Context;
use flockmap::codec::Batch;
use flockmap::grid::{Layer, MapperConfig};
use flockmap::{BatchConfig, Changes, Stamp};
use flockmap_cli::measure::{Comparison, KB, SentBytes, Times, blocks_of};
use flockmap_cli::sources::Frame;
use flockmap_cli::stop;
use serde::Serialize;

use crate::baselines::{Messages, Method, Observation, Receiver, Sender};
use crate::batcher::{Batcher, Step};

/// All methods at work. One record after another; each is a robot that all the others listen to.
pub struct CodecRun {
    mapper: MapperConfig,
    batch: BatchConfig,
    /// Robots that listen to each.
    pub receivers: u64,
    robots: usize,
    /// Of all records together.
    pub seconds: f64,
    /// Of all records together.
    pub batches: u64,
    /// Voxels in all batches together.
    pub changed_voxels: u64,
    /// In the order asked for.
    methods: Vec<(Method, Sums)>,
}

/// What a method cost and how far it is right. What is skipped is not in the JSON of `codecs`.
#[derive(Serialize)]
pub struct Row {
    pub name: String,
    #[serde(skip)]
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
    /// Share of the voxels known to the sender, as packed, or to a receiver, when all has arrived, that are
    /// equal; less than 1 is a fault of a lossless method.
    pub agreement: f64,
    /// Whether the method does what it says: a lossless one has every voxel, and every stamp that it sends,
    /// right.
    #[serde(skip)]
    pub is_as_promised: bool,
}

impl CodecRun {
    /// Nothing measured yet. Each robot's messages go to so many `receivers`, one by one (unicast: N − 1).
    pub fn new(mapper: MapperConfig, batch: BatchConfig, methods: &[Method], receivers: usize) -> Self {
        let methods = methods.iter().map(|method| (*method, Sums::default())).collect();
        let receivers = receivers.max(1) as u64;
        Self { mapper, batch, receivers, robots: 0, seconds: 0.0, batches: 0, changed_voxels: 0, methods }
    }

    /// The record of one robot: maps it, closes batches, and gives each batch to every method. Stamps must
    /// begin near 0. Calls `progress` after each scan. Ends early if the user asks for it. Returns what was
    /// published in the end.
    pub fn record(
        &mut self,
        frames: impl IntoIterator<Item = Frame>,
        mut progress: impl FnMut(),
    ) -> anyhow::Result<Layer> {
        let mut robot = Batcher::new(self.robots, &self.mapper, self.batch)?;
        let mut truth = Layer::default();
        let lanes = self.methods.iter().map(|(method, _)| Lane::new(*method, &self.mapper, self.receivers));
        let mut lanes = lanes.collect::<anyhow::Result<Vec<_>>>()?;
        let (batches, changed_voxels) = (&mut self.batches, &mut self.changed_voxels);
        let mut close = |now, lanes: &mut [Lane], batch: &Batch, changes: &Changes| {
            *batches += 1;
            *changed_voxels += changes.len() as u64;
            truth.apply(changes, batch.end);
            truth.note_sensor(batch.end, batch.sensor);
            lanes.iter_mut().try_for_each(|lane| lane.batch(now, batch, changes))
        };
        for frame in frames {
            if stop::requested() {
                break;
            }
            let masks = frame.masks();
            let Frame { scan, pose, .. } = frame;
            let seen = Observation { scan: &scan, pose: &pose, masks: &masks };
            robot.scan(&scan, &pose, &masks, |now, step| match step {
                Step::Closed(batch, changes) => close(now, &mut lanes, &batch, &changes),
                Step::Mapped => lanes.iter_mut().try_for_each(|lane| lane.scan(now, &seen)),
            })?;
            progress();
        }
        if let Some((batch, changes)) = robot.end() {
            close(robot.last, &mut lanes, &batch, &changes)?;
        }
        for ((_, sums), lane) in self.methods.iter_mut().zip(lanes) {
            sums.add(lane.end(&truth));
        }
        self.robots += 1;
        self.seconds += robot.last.seconds();
        Ok(truth)
    }

    /// Takes in the records of another run with the same methods.
    pub fn join(&mut self, other: Self) {
        self.robots += other.robots;
        self.seconds += other.seconds;
        self.batches += other.batches;
        self.changed_voxels += other.changed_voxels;
        self.methods.iter_mut().zip(other.methods).for_each(|((_, sums), (_, other))| sums.add(other));
    }

    /// What came out of all records so far: one for each method, in the order asked for.
    pub fn rows(&self) -> Vec<Row> {
        self.methods.iter().map(|(method, sums)| sums.row(*method, self.seconds)).collect()
    }
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
    /// What the robots sent, and most that one sent in a second.
    total_bytes: u64,
    second_bytes_max: u64,
}

impl Sums {
    fn add(&mut self, other: Self) {
        self.packages += other.packages;
        self.datagrams += other.datagrams;
        self.encode.0.extend(other.encode.0);
        self.decode.0.extend(other.decode.0);
        self.compared.merge(other.compared);
        self.stamps_differ |= other.stamps_differ;
        self.total_bytes += other.total_bytes;
        self.second_bytes_max = self.second_bytes_max.max(other.second_bytes_max);
    }

    fn row(&self, method: Method, seconds: f64) -> Row {
        let Self { packages, datagrams, total_bytes, compared, .. } = *self;
        let encode = self.encode.summary();
        let is_right = compared.known == compared.equal && !self.stamps_differ;
        Row {
            name: method.to_string(),
            method,
            total_bytes,
            avg_kb_s: total_bytes as f64 / KB / seconds.max(1e-3),
            max_kb_s: self.second_bytes_max as f64 / KB,
            packages,
            datagrams,
            encode_ms_mean: encode.mean_ms,
            encode_ms_p99: encode.p99_ms,
            decode_ms_mean: self.decode.summary().mean_ms,
            timed: encode.count,
            agreement: compared.share(),
            is_as_promised: is_right || !method.is_lossless(),
        }
    }
}

/// One method on one record.
struct Lane {
    method: Method,
    sums: Sums,
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

impl Lane {
    fn new(method: Method, mapper: &MapperConfig, receivers: u64) -> anyhow::Result<Self> {
        Ok(Self {
            method,
            sums: Sums::default(),
            sender: method.sender(mapper),
            receiver: method.receiver(mapper)?,
            receivers,
            sent: SentBytes::default(),
            took: Duration::ZERO,
            messages: Vec::new(),
        })
    }

    fn scan(&mut self, now: Stamp, seen: &Observation<'_>) -> anyhow::Result<()> {
        let started = Instant::now();
        self.sender.scan(seen, &mut self.messages).with_context(|| self.method.to_string())?;
        self.took += started.elapsed();
        self.deliver(now).map(drop)
    }

    fn batch(&mut self, now: Stamp, batch: &Batch, changes: &Changes) -> anyhow::Result<()> {
        let started = Instant::now();
        let packed = self.sender.batch(now, batch, changes, &mut self.messages);
        packed.with_context(|| self.method.to_string())?;
        self.sums.encode.add(core::mem::take(&mut self.took) + started.elapsed());
        self.sender.published(batch, changes);
        let took = self.deliver(now)?;
        self.sums.decode.add(took);
        Ok(())
    }

    /// Counts the messages and gives them to the receiver. Returns the time that it took.
    fn deliver(&mut self, now: Stamp) -> anyhow::Result<Duration> {
        let mut took = Duration::ZERO;
        for message in self.messages.drain(..) {
            self.sent.add(now, message.len() as u64 * self.receivers);
            self.sums.packages += self.receivers;
            self.sums.datagrams += message.len().div_ceil(DATAGRAM_BYTES) as u64 * self.receivers;
            let started = Instant::now();
            self.receiver.receive(&message).with_context(|| self.method.to_string())?;
            took += started.elapsed();
        }
        Ok(took)
    }

    /// The record is over: compares with what the batches said.
    fn end(self, truth: &Layer) -> Sums {
        let layer = self.receiver.layer();
        Sums {
            compared: Comparison::of(self.receiver.states(), blocks_of(truth)),
            stamps_differ: layer.is_some_and(|layer| layer.digest() != truth.digest()),
            total_bytes: self.sent.total(),
            second_bytes_max: self.sent.largest_second(),
            ..self.sums
        }
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

    fn run(receivers: usize) -> CodecRun {
        let mapper = MapperConfig::preset(Preset::RogMap, Resolution::from_metres(0.1).unwrap(), 7.0);
        let methods = ["paper", "scan-relay", "gvp", "octomap-diff-10s"].map(|name| name.parse().unwrap());
        let mut run = CodecRun::new(mapper, BatchConfig::default(), &methods, receivers);
        for _ in 0..2 {
            run.record(frames(), || ()).unwrap();
        }
        run
    }

    #[test]
    fn every_receiver_costs_the_same_again() {
        let (one, three) = (run(1), run(3));
        for ((method, one), (_, three)) in one.methods.iter().zip(&three.methods) {
            assert_eq!(3 * one.total_bytes, three.total_bytes, "{method}");
            assert_eq!(3 * one.packages, three.packages);
            assert_eq!(one.compared, three.compared, "one receiver is decoded for all");
        }
    }

    #[test]
    fn what_a_method_leaves_unsent_counts_against_it() {
        let rows = run(1).rows();
        let agreement = |name: &str| {
            let row = rows.iter().find(|row| row.name == name).unwrap();
            assert!(row.is_as_promised, "{name}");
            row.agreement
        };
        assert_eq!((agreement("paper"), agreement("scan-relay")), (1.0, 1.0));
        assert_eq!(agreement("octomap-diff-10s"), 0.0, "the record is shorter than its period");
        assert!(agreement("gvp") < 1.0);
    }
}
