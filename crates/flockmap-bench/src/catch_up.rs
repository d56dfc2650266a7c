//! `flockmap-bench catch-up`: what an outage and a late joiner cost, beside the map coded once.

use flockmap_cli::outputs;
use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::{Context, ensure};
use clap::Args;
use flockmap::codec::{Encoder, PACKAGE_BYTES_MAX};
use flockmap::grid::{Layer, Snapshot};
use flockmap::sync::wire::{Datagram, Kind, parse_packages};
use flockmap::{Codec, Event, Robot, RobotConfig, RobotId, SessionConfig, Stamp, Stream};
use flockmap_cli::document::DataTable;
use flockmap_cli::flight::Flight;
use flockmap_cli::measure::SentBytes;
use flockmap_cli::numbers::thousands;
use flockmap_cli::options::{MapArgs, SourceArgs, budget};
use flockmap_cli::{json_file, sources, stop, swarm};
use flockmap_netsim::{Datagram as Sending, IP_UDP_BYTES, Link, RadioConfig, Watch};
use serde::Serialize;

/// What an outage and a late joiner cost, beside the map coded once
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap-bench catch-up forest --seconds 600 --outage 60
  flockmap-bench catch-up robot1.mcap robot2.mcap --resolution 0.2 --range 30 --seconds 100 --outage 20

In the middle of the flight the first robot hears nobody and is heard by nobody. When the flight is over and everything has arrived, one
robot more comes with an empty map. Everything on the wire is counted, requests and headers of IP and UDP too. Exit code 1 if layers differ
at the end.")]
pub struct CatchUpArgs {
    /// Records, one for each robot; or one world: forest, indoor, or a .bt .pcd .ply .las .laz file
    #[arg(value_name = "RECORD", required = true)]
    pub records: Vec<PathBuf>,
    /// Length of the outage in seconds; 0: none
    #[arg(long, value_name = "S", default_value_t = 60.0)]
    pub outage: f64,
    /// Most kilobytes (1,024 bytes) that a robot sends in a second, IP and UDP headers counted
    #[arg(long, value_name = "B", default_value_t = 20.0)]
    pub budget_kb_s: f64,
    /// Share of datagrams that the radio loses, 0 to less than 1
    #[arg(long, value_name = "P", default_value_t = 0.0)]
    pub loss: f64,
    /// Delay of the radio in milliseconds
    #[arg(long, value_name = "D", default_value_t = 20.0)]
    pub delay_ms: f64,
    /// Codec of the packages: flock, paper, nested-zlib, raw or racer
    #[arg(long, value_name = "NAME", default_value_t = Codec::Flock)]
    pub codec: Codec,
    /// Write what the table shows as JSON
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub json: Option<PathBuf>,
    #[command(flatten)]
    pub map: MapArgs,
    #[command(flatten)]
    pub source: SourceArgs,
}

/// Virtual time that may pass until everything has arrived.
const SETTLE_MICROS_MAX: i64 = 3_600_000_000;

/// What the JSON holds.
#[derive(Serialize, Debug)]
struct Output {
    title: String,
    seconds: f64,
    budget_kb_s: f64,
    loss: f64,
    delay_ms: f64,
    outage: Option<Outage>,
    joiner: Joiner,
    /// Whether everyone holds the same layers at the end.
    agreement: bool,
}

/// One robot hears nobody for a while, and nobody hears it.
#[derive(Serialize, Debug)]
struct Outage {
    seconds: f64,
    /// Packages of that time: sent in vain while it was not noticed.
    vain_bytes: u64,
    /// Packages of that time: sent after it.
    repair_bytes: u64,
    /// Requests from its end until all of that was received.
    request_bytes: u64,
    total_bytes: u64,
    /// What changed meanwhile and stayed so, coded once for each robot that missed it.
    coded_once_bytes: u64,
    ratio: f64,
    /// From its end until all of that was received.
    repair_s: f64,
}

/// A robot without a sensor and with an empty map comes when the flight is over.
#[derive(Serialize, Debug)]
struct Joiner {
    /// Everything on the wire, requests of all among them, until it had received all.
    total_bytes: u64,
    request_bytes: u64,
    /// The final maps with the stamp of every voxel, coded once.
    coded_once_bytes: u64,
    ratio: f64,
    /// The same without stamps: a bound that nobody who merges by stamps can reach.
    coded_without_stamps_bytes: u64,
    seconds: f64,
    /// Most that one robot sent in any second.
    max_kb_s: f64,
    caught_up_by_states: u64,
}

/// Runs the command. Whether all layers agree at the end.
pub fn run(args: &CatchUpArgs) -> anyhow::Result<bool> {
    ensure!((0.0..1.0).contains(&args.loss), "--loss is {}, expected 0 to less than 1", args.loss);
    let session =
        SessionConfig { radio_bytes_per_s: Some(budget(args.budget_kb_s)?), ..SessionConfig::default() };
    let base = RobotConfig { session, ..args.map.robot(args.codec, args.source.seed)? };
    let sources = sources::open(&args.records, &args.source, args.map.range, false)?;
    ensure!(sources.robots.len() >= 2, "an outage needs at least two robots: --robots 2");
    let title = format!("catching up: {}", sources.title);
    let link = Link { loss: args.loss, delay_micros: (args.delay_ms * 1e3) as i64, ..Link::default() };
    let radio = RadioConfig { seed: args.source.seed, link, ..RadioConfig::default() };
    let robot = |id| Ok(Robot::new(RobotConfig { id, ..base.clone() }, Stamp(0))?);
    let flight = Flight::new(sources.robots, radio, "scans", robot)?;
    let mut swarm = Swarm { flight, meter: Meter::default() };
    let outage = swarm.fly(args)?;
    let joiner = swarm.join(&base)?;
    let agreement = swarm.agrees();
    let seconds = swarm.flight.last_scan.seconds();
    let output = Output {
        title,
        seconds,
        budget_kb_s: args.budget_kb_s,
        loss: args.loss,
        delay_ms: args.delay_ms,
        outage,
        joiner,
        agreement,
    };
    output.print();
    json_file::write_asked(args.json.as_deref(), &output)?;
    Ok(agreement)
}

impl Output {
    fn print(&self) {
        println!("\n{}, {:.0} s, at most {} KB/s a robot", self.title, self.seconds, self.budget_kb_s);
        let row = |name: String, bytes, once, ratio: f64, seconds: f64| {
            [name, thousands(bytes), thousands(once), format!("{ratio:.2}"), format!("{seconds:.1}")]
        };
        let joiner = &self.joiner;
        let outage = self.outage.as_ref().map(|o| {
            let name = format!("outage of {:.0} s", o.seconds);
            row(name, o.total_bytes, o.coded_once_bytes, o.ratio, o.repair_s)
        });
        let (total, once) = (joiner.total_bytes, joiner.coded_once_bytes);
        let joined = row("late joiner".to_owned(), total, once, joiner.ratio, joiner.seconds);
        let rows = outage.into_iter().chain([joined]);
        let table = DataTable::unnamed(["", "bytes", "coded once", "ratio", "took s"], rows);
        println!("{table}");
        if let Some(outage) = &self.outage {
            println!(
                "  outage: {} bytes sent in vain, {} to repair, {} of requests",
                thousands(outage.vain_bytes),
                thousands(outage.repair_bytes),
                thousands(outage.request_bytes)
            );
        }
        println!(
            "  joiner: {} bytes of requests; largest second of a robot {:.1} KB; without stamps the maps take {} bytes",
            thousands(joiner.request_bytes),
            joiner.max_kb_s,
            thousands(joiner.coded_without_stamps_bytes)
        );
        println!("  layers at the end: {}", if self.agreement { "all equal" } else { "THEY DIFFER" });
    }
}

/// The swarm, and what goes over the air.
struct Swarm {
    flight: Flight<Robot>,
    meter: Meter,
}

/// Bytes on the wire with IP and UDP headers, every copy counted.
#[derive(Default)]
struct Meter {
    requests: u64,
    packages: u64,
    /// Datagrams with packages of these indices.
    marked: u64,
    marks: BTreeMap<Stream, (u32, u32)>,
    by_robot: BTreeMap<RobotId, SentBytes>,
    /// End of the newest batch of each robot.
    batch_ends: BTreeMap<Stream, Stamp>,
}

impl Meter {
    fn clear(&mut self) {
        (self.requests, self.packages, self.marked) = (0, 0, 0);
        self.by_robot.clear();
    }
}

impl Watch<Robot> for Meter {
    fn called(&mut self, _now: Stamp, _number: usize, robot: &mut Robot) {
        while let Some(event) = robot.poll_event() {
            if let Event::BatchClosed { batch, .. } = event {
                self.batch_ends.insert(batch.stream, batch.end);
            }
        }
    }

    fn sent(&mut self, now: Stamp, _: usize, robot: &mut Robot, datagram: &mut Sending, copies: usize) {
        let all = ((datagram.bytes.len() + IP_UDP_BYTES) * copies) as u64;
        self.by_robot.entry(robot.own_stream().origin).or_default().add(now, all);
        let datagram = Datagram::new_checked(&datagram.bytes).expect(OWN);
        if datagram.header().kind == Kind::Request {
            self.requests += all;
            return;
        }
        self.packages += all;
        let is_marked = parse_packages(&datagram).expect(OWN).iter().any(|package| {
            let header = package.header();
            self.marks.get(&header.stream).is_some_and(|(low, high)| (*low..=*high).contains(&header.index))
        });
        self.marked += if is_marked { all } else { 0 };
    }
}

/// What a robot sends, it can read.
const OWN: &str = "a robot sends sound datagrams";

impl Swarm {
    /// Flies all scans, with the outage in the middle.
    fn fly(&mut self, args: &CatchUpArgs) -> anyhow::Result<Option<Outage>> {
        let total = args.source.seconds.unwrap_or(60.0);
        let begins = Stamp::from_seconds((total - args.outage) / 2.0);
        let ends = begins.plus_micros((args.outage * 1e6) as i64);
        ensure!(
            args.outage == 0.0 || (args.outage > 0.0 && args.outage < total),
            "--outage is {} s of a flight of {total} s; expected less, or 0 for none",
            args.outage
        );
        let mut plan = (args.outage > 0.0).then_some([begins, ends]).into_iter().flatten().peekable();
        let mut repair: Option<Repair> = None;
        let mut done = None;
        while let Some(next) = self.flight.next_scan() {
            let until = next.min(plan.peek().copied().unwrap_or(next));
            self.flight.network.step(Some(until), &mut self.meter);
            if plan.next_if(|at| *at <= self.flight.network.now()).is_some() {
                match &mut repair {
                    None => repair = Some(self.cut(args.outage)),
                    Some(repair) => self.heal(repair)?,
                }
            }
            if let Some(repair) = repair.as_ref().filter(|r| done.is_none() && r.healed.is_some())
                && swarm::have_all(self.flight.network.nodes(), &repair.upto)
            {
                done = Some(self.outage_of(repair));
            }
            self.flight.scan_due(|robot, _, now, frame| {
                robot.insert_scan(now, &frame.scan, &frame.pose)?;
                Ok(())
            })?;
        }
        for number in 0..self.flight.network.nodes().len() {
            self.flight.network.call(number, &mut self.meter, Robot::flush);
        }
        self.settle()?;
        Ok(done.or_else(|| repair.map(|repair| self.outage_of(&repair))))
    }

    /// Cuts the first robot off.
    fn cut(&mut self, seconds: f64) -> Repair {
        self.set_open(false);
        let from = swarm::newest(self.flight.network.nodes());
        self.meter.clear();
        self.meter.marks = from.iter().map(|(stream, newest)| (*stream, (newest + 1, u32::MAX))).collect();
        Repair { seconds, from, batch_ends: self.meter.batch_ends.clone(), ..Repair::default() }
    }

    /// Cuts or opens all links of the first robot. Returns how many robots there are beside it.
    fn set_open(&mut self, is_open: bool) -> usize {
        let others = self.flight.network.ids()[1..].to_vec();
        for other in &others {
            self.flight.network.radio_mut().set_open_both(RobotId(1), *other, is_open);
        }
        others.len()
    }

    /// Ends the outage, and weighs what was missed.
    fn heal(&mut self, repair: &mut Repair) -> anyhow::Result<()> {
        let others = self.set_open(true);
        // What the others sent each other of that time was no loss.
        repair.vain = if others == 1 { self.meter.marked } else { 0 };
        repair.upto = swarm::newest(self.flight.network.nodes());
        for robot in self.flight.network.nodes() {
            let own = robot.own_stream();
            let since = repair.batch_ends.get(&own).copied().unwrap_or(Stamp(i64::MIN));
            let state = robot.fusion().layer(own).and_then(|layer| layer.snapshot_since(since));
            let copies = if own.origin == RobotId(1) { others } else { 1 };
            repair.coded_once += copies as u64 * coded_bytes(robot, own, state)?;
        }
        self.meter.clear();
        let upto = |stream| repair.upto.get(stream).copied().unwrap_or(0);
        let marks = repair.from.iter().map(|(stream, newest)| (*stream, (newest + 1, upto(stream))));
        self.meter.marks = marks.collect();
        repair.healed = Some(self.flight.network.now());
        Ok(())
    }

    fn outage_of(&self, repair: &Repair) -> Outage {
        let total = repair.vain + self.meter.marked + self.meter.requests;
        Outage {
            seconds: repair.seconds,
            vain_bytes: repair.vain,
            repair_bytes: self.meter.marked,
            request_bytes: self.meter.requests,
            total_bytes: total,
            coded_once_bytes: repair.coded_once,
            ratio: total as f64 / repair.coded_once.max(1) as f64,
            repair_s: repair.healed.map_or(0.0, |at| self.flight.network.now().micros_since(at) as f64 / 1e6),
        }
    }

    /// One robot more, with an empty map.
    fn join(&mut self, base: &RobotConfig) -> anyhow::Result<Joiner> {
        let id = RobotId(self.flight.network.nodes().len() as u16 + 1);
        self.meter.clear();
        self.meter.marks.clear();
        let began = self.flight.network.now();
        self.flight.network.join(Robot::new(RobotConfig { id, ..base.clone() }, began)?);
        self.settle()?;
        let (mut coded_once, mut without_stamps) = (0, 0);
        for robot in self.flight.network.nodes() {
            let own = robot.own_stream();
            let Some(layer) = robot.fusion().layer(own) else { continue };
            coded_once += coded_bytes(robot, own, layer.snapshot())?;
            let mut flat = Layer::default();
            for (_, part) in layer.snapshot().into_iter().flat_map(|state| state.parts) {
                flat.apply(&part, Stamp(0));
            }
            without_stamps += coded_bytes(robot, own, flat.snapshot())?;
        }
        let total = self.meter.requests + self.meter.packages;
        let caught_up = self.flight.network.nodes().last();
        let largest = self.meter.by_robot.values().map(SentBytes::largest_second).max().unwrap_or(0);
        Ok(Joiner {
            total_bytes: total,
            request_bytes: self.meter.requests,
            coded_once_bytes: coded_once,
            ratio: total as f64 / coded_once.max(1) as f64,
            coded_without_stamps_bytes: without_stamps,
            seconds: self.flight.network.now().micros_since(began) as f64 / 1e6,
            max_kb_s: largest as f64 / 1024.0,
            caught_up_by_states: caught_up.map_or(0, |robot| robot.session().counters().caught_up),
        })
    }

    /// Lets time pass until everyone has received everything.
    fn settle(&mut self) -> anyhow::Result<()> {
        let until = self.flight.network.now().plus_micros(SETTLE_MICROS_MAX);
        let arrived = self.flight.settle(until, &mut self.meter, swarm::has_everything);
        ensure!(!stop::requested(), "interrupted");
        arrived.context("not everything had arrived an hour later; is the budget too small?").map(drop)
    }

    fn agrees(&self) -> bool {
        self.flight.network.nodes().iter().all(|sender| {
            let own = sender.own_stream();
            let digest = |robot: &Robot| robot.fusion().layer(own).map(Layer::digest);
            self.flight.network.nodes().iter().all(|robot| digest(robot) == digest(sender))
        })
    }
}

/// What has to be repaired after an outage.
#[derive(Default)]
struct Repair {
    seconds: f64,
    from: BTreeMap<Stream, u32>,
    batch_ends: BTreeMap<Stream, Stamp>,
    upto: BTreeMap<Stream, u32>,
    vain: u64,
    coded_once: u64,
    healed: Option<Stamp>,
}

/// Bytes of the packages that carry a snapshot.
fn coded_bytes(robot: &Robot, stream: Stream, state: Option<Snapshot>) -> anyhow::Result<u64> {
    let Some(state) = state else { return Ok(0) };
    let config = robot.config();
    let chunks = Encoder::new()
        .encode_snapshot(config.codec, stream, 1, config.mapper.resolution, &state, PACKAGE_BYTES_MAX)
        .context("a snapshot cannot be coded")?;
    Ok(chunks.iter().map(|chunk| chunk.bytes().len() as u64).sum())
}
