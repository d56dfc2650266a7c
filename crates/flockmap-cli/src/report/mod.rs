//! What a run of a swarm comes to.

mod document;
mod fused;
mod words;

use flockmap::{Cast, Preset, Robot, RobotConfig, Stamp, Stream};
use serde::Serialize;

use crate::map_figure::{MapFigure, Path};
use crate::measure::{
    AgeSummary, AgesByState, Comparison, IP_UDP_BYTES, KB, SentBytes, SentDatagrams, TimeSummary,
};
use crate::member::Measures;
use crate::picture::{self, MapPicture};
use crate::program::command_line;
use crate::stop;
use fused::Fused;

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
    /// The fused maps beside each other. They may differ where several robots saw a voxel.
    pub fused: Fused,
    pub age_occupied: AgeSummary,
    pub age_free: AgeSummary,
    pub t_map: TimeSummary,
    pub t_pack: TimeSummary,
    pub t_recv2insert: TimeSummary,
    pub paper_t_pack_ms: f64,
    pub paper_t_recv2insert_ms: f64,
    /// KB on the wire, of all robots, in each second.
    pub kb_per_second: Vec<f64>,
    /// The same for RACER.
    pub racer_kb_per_second: Vec<f64>,
    /// The same for the paper's method.
    pub paper_kb_per_second: Vec<f64>,
    /// What the first robot saw itself, and its fused map.
    #[serde(skip)]
    pub own_and_fused: Vec<MapFigure>,
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
    pub batch_limit: usize,
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
            batch_limit: robot.batch.voxels_max,
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
    /// Of the payload.
    pub avg_kb_s: f64,
    /// Of the payload, largest window of one second.
    pub max_kb_s: f64,
    /// With IP and UDP.
    pub wire_avg_kb_s: f64,
    /// With IP and UDP, largest window of one second.
    pub wire_max_kb_s: f64,
    pub datagrams: u64,
}

impl Bytes {
    /// Payload, IP and UDP.
    pub const fn wire_bytes(&self) -> u64 {
        self.total_bytes + self.ip_udp_bytes
    }
}

#[derive(Serialize, Clone, Copy)]
pub struct Baseline {
    #[serde(flatten)]
    pub bytes: Bytes,
    /// How many times ours that is, on the wire.
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
    /// Bytes of these, once each, without any header of a datagram.
    pub own_package_bytes: u64,
    /// Submaps that were begun after the first, how often one was moved, and the bytes of packages that say so.
    pub submaps_begun: u64,
    pub submap_poses: u64,
    pub submap_package_bytes: u64,
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
    pub moments: Vec<MapFigure>,
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
        let sum = SentDatagrams::together(robots.iter().map(|r| &r.measures.sent));
        let sum_bytes = bytes_of(&sum, 1, seconds);
        let baseline = |sent: &dyn Fn(&Measures) -> &SentDatagrams| {
            let together = SentDatagrams::together(robots.iter().map(|r| sent(&r.measures)));
            let bytes = bytes_of(&together, copies, seconds);
            let ratio = bytes.wire_bytes() as f64 / sum_bytes.wire_bytes().max(1) as f64;
            (Baseline { bytes, ratio }, kb_series(&together.wire, copies))
        };
        let (racer, racer_kb_per_second) = baseline(&|m| &m.racer);
        let (paper_whole, paper_kb_per_second) = baseline(&|m| &m.paper);
        let agreement = pairs(robots);
        let mut all = Comparison::default();
        agreement.iter().for_each(|pair| all.merge(Comparison { known: pair.voxels, equal: pair.equal }));
        let mut ages = AgesByState::default();
        robots.iter().for_each(|r| ages.merge(&r.measures.ages));
        let pictured = 0..robots.len().min(PICTURED_MAX);
        let pictures = pictured.map(|number| moments(robots, number)).collect::<anyhow::Result<_>>()?;
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
            kb_per_second: kb_series(&sum.wire, 1),
            racer_kb_per_second,
            paper_kb_per_second,
            fused: Fused::of(robots.iter().map(|member| &member.robot)),
            own_and_fused: own_and_fused(robots)?,
            settings,
            pictures,
        })
    }

    /// Whether it is as it must be: everything arrived, and every voxel is equal.
    pub fn is_good(&self) -> bool {
        self.complete && self.agreement.iter().all(Pair::is_equal)
    }
}

fn bytes_of(sent: &SentDatagrams, copies: u64, seconds: f64) -> Bytes {
    let kb = |bytes: u64| (bytes * copies) as f64 / KB;
    Bytes {
        total_bytes: sent.payload.total() * copies,
        ip_udp_bytes: sent.datagrams * copies * IP_UDP_BYTES,
        avg_kb_s: kb(sent.payload.total()) / seconds,
        max_kb_s: kb(sent.payload.largest_second()),
        wire_avg_kb_s: kb(sent.wire.total()) / seconds,
        wire_max_kb_s: kb(sent.wire.largest_second()),
        datagrams: sent.datagrams * copies,
    }
}

fn kb_series(sent: &SentBytes, copies: u64) -> Vec<f64> {
    sent.per_second().into_iter().map(|bytes| (bytes * copies) as f64 / KB).collect()
}

/// Where all robots flew, for a picture of the map of one.
fn paths(robots: &[Member], own: usize) -> Vec<Path<'_>> {
    let path = |number: usize| Path {
        number: number + 1,
        is_own: number == own,
        places: &robots[number].measures.path,
    };
    (0..robots.len()).map(path).collect()
}

/// The map of a robot at several moments.
fn moments(robots: &[Member], number: usize) -> anyhow::Result<Pictures> {
    let (member, paths) = (&robots[number], paths(robots, number));
    let figure = |(at, picture): (Stamp, picture::Picture)| {
        let caption = format!("after {:.0} s", at.seconds());
        MapFigure::new(picture, String::new(), &caption, &paths, at)
    };
    let times = member.pictures.iter().map(|picture| picture.at);
    let moments = times.zip(picture::draw(&member.pictures)?).map(figure).collect();
    Ok(Pictures { robot: member.name.clone(), moments })
}

/// What the first robot saw itself beside its fused map, at the end. Nothing of a robot that flew alone, or
/// that has no map.
fn own_and_fused(robots: &[Member]) -> anyhow::Result<Vec<MapFigure>> {
    let ([first, _, ..], Some(last)) = (robots, robots.first().and_then(|first| first.pictures.last()))
    else {
        return Ok(Vec::new());
    };
    let fused = picture::draw(core::slice::from_ref(last))?.pop();
    let (Some(own), Some(fused)) = (picture::draw_own(&first.robot, last)?, fused) else {
        return Ok(Vec::new());
    };
    let seen: u64 = first.robot.mapper().blocks().map(|(_, block)| u64::from(block.known_count())).sum();
    let (free, occupied) = last.count();
    let known = |voxels: u64| format!("{:.1} million voxels known", voxels as f64 / 1e6);
    let all = paths(robots, 0);
    let figure = |picture, title: &str, voxels, paths| {
        MapFigure::new(picture, title.to_owned(), &known(voxels), paths, last.at)
    };
    let others = if robots.len() == 2 { "robot 2" } else { "the others" };
    Ok(vec![
        figure(own, "What robot 1 saw itself", seen, &all[..1]),
        figure(fused, &format!("Its map with what came from {others}"), (free + occupied) as u64, &all),
    ])
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
        bytes: bytes_of(&measures.sent, 1, seconds),
        requests: session.requests_out.datagrams,
        request_bytes: session.requests_out.bytes,
        package_datagrams: session.packages_out.datagrams,
        package_datagram_bytes: session.packages_out.bytes,
        batches: counters.batches,
        batches_deferred: counters.batches_deferred,
        batches_in_parts: counters.batches_in_parts,
        changed_voxels: counters.changes,
        own_packages: counters.packages,
        own_package_bytes: counters.package_bytes,
        submaps_begun: counters.submaps_begun,
        submap_poses: counters.submap_poses,
        submap_package_bytes: counters.submap_package_bytes,
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
                let place = origin.mapper().place_of(index);
                let published_at = place.and_then(|(_, sheet)| sheet.block(index)).unwrap_or(index);
                let received = layer.block(published_at).unwrap_or_default();
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
