//! What a run of a swarm comes to.

mod document;

use flockmap::{Cast, Preset, Robot, RobotConfig, Stamp, Stream};
use serde::Serialize;

use crate::measure::{AgeSummary, AgesByState, Comparison, KB, SentBytes, TimeSummary};
use crate::member::{IP_UDP_BYTES, Measures};
use crate::picture::{MapPicture, Picture};
use crate::program::command_line;
use crate::stop;

/// The paper's time from the start of a batch to its package, Table IV.
pub const PAPER_T_PACK_MS: f64 = 5.30;
/// The paper's time from receiving a package to its voxels in the map, Table IV.
pub const PAPER_T_INSERT_MS: f64 = 7.08;

/// A run of a swarm.
#[derive(Serialize)]
pub struct Report {
    /// The command that made it.
    pub command: String,
    pub title: String,
    pub version: &'static str,
    pub settings: Settings,
    /// Whether everything arrived everywhere.
    pub complete: bool,
    /// Whether Ctrl-C ended it early.
    pub interrupted: bool,
    /// Time from 0 to the last scan; averages are over this.
    pub record_s: f64,
    /// Time from the last scan until everything had arrived everywhere.
    pub settle_s: Option<f64>,
    pub robots: Vec<RobotReport>,
    pub sum: Bytes,
    /// What RACER would have sent for the same changes.
    pub racer: Baseline,
    /// What the paper's method would have sent for the same batches, one whole package each.
    pub paper_whole: Baseline,
    pub agreement: Vec<Pair>,
    /// Share of equal voxels over all pairs: 1 or it is a fault.
    pub agreement_all: f64,
    pub age_occupied: AgeSummary,
    pub age_free: AgeSummary,
    pub t_map: TimeSummary,
    pub t_pack: TimeSummary,
    pub t_recv2insert: TimeSummary,
    pub paper_t_pack_ms: f64,
    pub paper_t_recv2insert_ms: f64,
    /// KB sent by all robots in each second.
    pub kb_per_second: Vec<f64>,
    /// The same for RACER.
    pub racer_kb_per_second: Vec<f64>,
    #[serde(skip)]
    pub pictures: Vec<Pictures>,
}

/// What was set.
#[derive(Serialize, Clone)]
pub struct Settings {
    pub resolution_m: f64,
    pub range_m: f64,
    pub publish_period_s: f64,
    pub obstacle_period_s: Option<f64>,
    pub d: usize,
    pub mapper: String,
    pub codec: String,
    pub cast: &'static str,
    /// What the radio does to datagrams.
    pub radio: String,
    pub seed: u64,
}

impl Settings {
    /// How robots are set, and what the radio is.
    pub fn new(robot: &RobotConfig, mapper: Preset, radio: &str) -> Self {
        let seconds = |ms: u32| f64::from(ms) / 1e3;
        Self {
            resolution_m: robot.mapper.resolution.metres(),
            range_m: robot.mapper.range_m,
            publish_period_s: seconds(robot.batch.publish_period_ms),
            obstacle_period_s: robot.batch.obstacle_period_ms.map(seconds),
            d: robot.batch.voxels_max,
            mapper: mapper.to_string(),
            codec: robot.codec.to_string(),
            cast: match robot.session.cast {
                Cast::Unicast => "unicast",
                Cast::Broadcast => "broadcast",
            },
            radio: radio.to_owned(),
            seed: robot.seed,
        }
    }
}

/// Bytes on the wire. KB are 1,024 bytes.
#[derive(Serialize, Clone, Copy, Default)]
pub struct Bytes {
    /// UDP payload: requests, packages, repairs, all headers.
    pub total_bytes: u64,
    /// 28 bytes of IP and UDP for each datagram, on top.
    pub ip_udp_bytes: u64,
    pub avg_kb_s: f64,
    /// Largest window of one second.
    pub max_kb_s: f64,
    pub datagrams: u64,
}

#[derive(Serialize, Clone, Copy)]
pub struct Baseline {
    #[serde(flatten)]
    pub bytes: Bytes,
    /// How many times ours that is.
    pub ratio: f64,
}

#[derive(Serialize)]
pub struct RobotReport {
    pub name: String,
    pub id: u16,
    #[serde(flatten)]
    pub bytes: Bytes,
    /// Requests sent, with their IP and UDP headers.
    pub requests: u64,
    pub request_bytes: u64,
    /// Datagrams of packages sent, with their IP and UDP headers.
    pub package_datagrams: u64,
    pub package_datagram_bytes: u64,
    pub batches: u64,
    /// Batches that were due and waited for the budget.
    pub batches_deferred: u64,
    /// Batches that hold only what was nearest, since the budget has no room for more.
    pub batches_in_parts: u64,
    pub changed_voxels: u64,
    pub own_packages: u64,
    pub packages_sent: u64,
    /// Found lost, and sent again.
    pub resent: u64,
    pub relayed: u64,
    pub duplicates_received: u64,
    pub snapshot_chunks_sent: u64,
    pub refused: u64,
    pub map: MapReport,
    pub layers: Vec<LayerReport>,
    pub scans: u64,
    pub scans_damaged: u64,
}

#[derive(Serialize, Clone, Copy)]
pub struct MapReport {
    pub free: usize,
    pub occupied: usize,
    pub own_memory_bytes: usize,
}

#[derive(Serialize)]
pub struct LayerReport {
    pub origin: u16,
    pub epoch: u64,
    pub voxels: usize,
    pub digest: String,
    pub memory_bytes: usize,
}

/// A receiver's layer beside its origin's.
#[derive(Serialize)]
pub struct Pair {
    pub receiver: u16,
    pub origin: u16,
    pub voxels: u64,
    pub equal: u64,
    /// Share of equal voxels.
    pub agreement: f64,
    /// Whether the stamps are equal too.
    pub stamps_equal: bool,
    pub packages_held: u64,
    pub packages: u64,
}

impl Pair {
    /// Whether every voxel and every stamp is equal.
    pub const fn is_equal(&self) -> bool {
        self.equal == self.voxels && self.stamps_equal
    }
}

/// A robot's map at several moments.
pub struct Pictures {
    pub robot: String,
    /// When, in seconds, and the picture.
    pub moments: Vec<(f64, Picture)>,
}

/// One robot at the end of a run.
pub struct Member {
    pub name: String,
    pub robot: Robot,
    pub measures: Measures,
    /// Its map at several moments.
    pub pictures: Vec<MapPicture>,
    pub scans_damaged: u64,
}

/// How a run went.
pub struct Run {
    pub members: Vec<Member>,
    /// Time of the last scan.
    pub last_scan: Stamp,
    /// When everything had arrived everywhere; `None` if it has not.
    pub arrived: Option<Stamp>,
    /// To map a scan, to make packages of a batch, to take a datagram into the fused map.
    pub times: [TimeSummary; 3],
}

/// Robots whose maps are drawn.
const PICTURED_MAX: usize = 6;

impl Report {
    /// Puts everything together.
    pub fn new(run: &Run, title: String, settings: Settings) -> anyhow::Result<Self> {
        let (robots, record_s) = (&run.members, run.last_scan.seconds());
        let [t_map, t_pack, t_recv2insert] = run.times;
        let seconds = record_s.max(1e-3);
        // Copies of each datagram that RACER, and the paper, would have to send.
        let copies = if settings.cast == "broadcast" { 1 } else { robots.len().saturating_sub(1) as u64 };
        let sum = SentBytes::together(robots.iter().map(|r| &r.measures.sent));
        let datagrams = robots.iter().map(|r| r.measures.datagrams).sum();
        let sum_bytes = bytes_of(&sum, datagrams, 1, seconds);
        let baseline = |sent: &dyn Fn(&Measures) -> (&SentBytes, u64)| {
            let together = SentBytes::together(robots.iter().map(|r| sent(&r.measures).0));
            let datagrams = robots.iter().map(|r| sent(&r.measures).1).sum();
            let bytes = bytes_of(&together, datagrams, copies, seconds);
            let ratio = bytes.total_bytes as f64 / sum_bytes.total_bytes.max(1) as f64;
            (Baseline { bytes, ratio }, together)
        };
        let (racer, racer_sent) = baseline(&|m| (&m.racer, m.racer_messages));
        let (paper_whole, _) = baseline(&|m| (&m.paper, m.paper_packages));
        let agreement = pairs(robots);
        let mut all = Comparison::default();
        agreement.iter().for_each(|pair| all.merge(Comparison { known: pair.voxels, equal: pair.equal }));
        let mut ages = AgesByState::default();
        robots.iter().for_each(|r| ages.merge(&r.measures.ages));
        let mut pictures = Vec::new();
        for robot in robots.iter().take(PICTURED_MAX) {
            let drawn = crate::picture::draw(&robot.pictures)?;
            let moments = robot.pictures.iter().map(|picture| picture.at.seconds()).zip(drawn).collect();
            pictures.push(Pictures { robot: robot.name.clone(), moments });
        }
        Ok(Self {
            command: command_line(),
            title,
            version: env!("CARGO_PKG_VERSION"),
            complete: agreement.iter().all(|pair| pair.packages_held == pair.packages),
            interrupted: stop::requested(),
            record_s,
            settle_s: run.arrived.map(|at| at.micros_since(run.last_scan).max(0) as f64 / 1e6),
            robots: robots.iter().map(|robot| robot_report(robot, seconds)).collect(),
            sum: sum_bytes,
            racer,
            paper_whole,
            agreement_all: all.share(),
            agreement,
            age_occupied: ages.occupied.summary(),
            age_free: ages.free.summary(),
            t_map,
            t_pack,
            t_recv2insert,
            paper_t_pack_ms: PAPER_T_PACK_MS,
            paper_t_recv2insert_ms: PAPER_T_INSERT_MS,
            kb_per_second: kb_series(&sum, 1),
            racer_kb_per_second: kb_series(&racer_sent, copies),
            settings,
            pictures,
        })
    }

    /// Whether it is as it must be: everything arrived, and every voxel is equal.
    pub fn is_good(&self) -> bool {
        self.complete && self.agreement.iter().all(Pair::is_equal)
    }
}

fn bytes_of(sent: &SentBytes, datagrams: u64, copies: u64, seconds: f64) -> Bytes {
    let total_bytes = sent.total() * copies;
    Bytes {
        total_bytes,
        ip_udp_bytes: datagrams * copies * IP_UDP_BYTES,
        avg_kb_s: total_bytes as f64 / KB / seconds,
        max_kb_s: (sent.largest_second() * copies) as f64 / KB,
        datagrams: datagrams * copies,
    }
}

fn kb_series(sent: &SentBytes, copies: u64) -> Vec<f64> {
    sent.per_second().into_iter().map(|bytes| (bytes * copies) as f64 / KB).collect()
}

fn robot_report(member: &Member, seconds: f64) -> RobotReport {
    let Member { name, robot, measures, scans_damaged, .. } = member;
    let (session, counters) = (robot.session().counters(), robot.counters());
    let (free, occupied) = robot.map().count();
    let layer = |(stream, layer): (Stream, &flockmap::grid::Layer)| LayerReport {
        origin: stream.origin.0,
        epoch: stream.epoch,
        voxels: layer.len(),
        digest: format!("{:016x}", layer.digest()),
        memory_bytes: layer.memory_bytes(),
    };
    RobotReport {
        name: name.clone(),
        id: robot.own_stream().origin.0,
        bytes: bytes_of(&measures.sent, measures.datagrams, 1, seconds),
        requests: session.requests_out.datagrams,
        request_bytes: session.requests_out.bytes,
        package_datagrams: session.packages_out.datagrams,
        package_datagram_bytes: session.packages_out.bytes,
        batches: counters.batches,
        batches_deferred: counters.batches_deferred,
        batches_in_parts: counters.batches_in_parts,
        changed_voxels: counters.changes,
        own_packages: counters.packages,
        packages_sent: session.sent,
        resent: session.lost,
        relayed: session.relayed,
        duplicates_received: session.duplicates,
        snapshot_chunks_sent: session.chunks_sent,
        refused: counters.damaged + counters.no_room + counters.foreign_resolution,
        map: MapReport { free, occupied, own_memory_bytes: robot.mapper().memory_bytes() },
        layers: robot.fusion().layers().map(layer).collect(),
        scans: counters.scans,
        scans_damaged: *scans_damaged,
    }
}

/// Every robot's layer of every other beside the original, and its own layer beside its mapper.
fn pairs(robots: &[Member]) -> Vec<Pair> {
    let none = flockmap::grid::Layer::default();
    let mut pairs = Vec::new();
    for origin in robots.iter().map(|member| &member.robot) {
        let stream = origin.own_stream();
        let reported = origin.fusion().layer(stream).unwrap_or(&none);
        let packages = origin.counters().packages;
        for receiver in robots.iter().map(|member| &member.robot) {
            let layer = receiver.fusion().layer(stream).unwrap_or(&none);
            let mut compared = Comparison::of_layers(layer, reported);
            // What the origin's own map knows now must be what it published, too. A voxel that has become
            // Unknown since stays as published.
            for (index, block) in origin.mapper().blocks() {
                let received = layer.block(index).copied().unwrap_or_default();
                let wrong: u32 = block.minus(&received).known_count();
                compared.equal = compared.equal.saturating_sub(u64::from(wrong));
            }
            let received = receiver.session().received(stream).map_or(0, |set| u64::from(set.prefix()));
            let is_own = receiver.own_stream() == stream;
            pairs.push(Pair {
                receiver: receiver.own_stream().origin.0,
                origin: stream.origin.0,
                voxels: compared.known,
                equal: compared.equal,
                agreement: compared.share(),
                stamps_equal: layer.digest() == reported.digest(),
                packages_held: if is_own { packages } else { received.min(packages) },
                packages,
            });
        }
    }
    pairs
}
