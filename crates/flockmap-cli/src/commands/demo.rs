//! `flockmap demo`: a swarm on this machine, each robot a node of its own with a socket of its own, and an
//! emulated radio between them.

use flockmap_cli::outputs;
use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};

use anyhow::Context;
use clap::Args;
use flockmap::{Codec, Event, Path, RobotConfig, RobotId, ScanReport, Stamp, Stream, Transmit};
use flockmap_cli::measure::TimeSummary;
use flockmap_cli::member::Measures;
use flockmap_cli::numbers::thousands;
use flockmap_cli::options::{MapArgs, OF_RECORDS, SourceArgs};
use flockmap_cli::picture::MapPicture;
use flockmap_cli::progress::Progress;
use flockmap_cli::report::{Member, Report, Run, Settings};
use flockmap_cli::view::ViewArgs;
use flockmap_cli::{sources, stop, team, view};
use flockmap_node::{
    Clock, Histogram, MapOutput, Node, NodeHandle, NodeOptions, Observation, SendResult, Sensor, Timings,
    Transport, UdpOptions, UdpSockets,
};

use flockmap_view::{Content, Kind, ViewServer};

/// Fly a swarm on this machine over a radio that loses every fifth datagram, and report what it cost
#[derive(Args, Debug)]
#[command(mut_arg("loss", |arg| arg.default_value("0.2")))]
#[command(after_help = "\
Examples:
  flockmap demo
  flockmap demo --view                              (in a browser, live)
  flockmap demo --loss 0.5 --delay-ms 50
  flockmap demo --scene indoor --robots 5 --seconds 30 --out /tmp/indoor

Each robot is a node of its own with its own UDP socket, and an emulated radio stands between them, in this program. With --loss 0, and
no other figure of the radio, they talk over the loopback of this machine alone. At the end there are a table here, and report.html,
report.json and maps.svg in the folder given by --out. Exit code 1 if any two robots disagree on a voxel.", mut_args(super::hidden::hide(&[&OF_RECORDS])))]
pub struct DemoArgs {
    /// forest, indoor, or a world file (.bt .pcd .ply .las .laz)
    #[arg(long, value_name = "SCENE", default_value = "forest")]
    pub scene: PathBuf,
    /// Codec of the packages: flock, paper, nested-zlib, raw or racer
    #[arg(long, value_name = "NAME", default_value_t = Codec::Flock)]
    pub codec: Codec,
    /// Folder for report.html, report.json and maps.svg
    #[arg(long, value_name = "DIR", default_value = "flockmap-demo", value_parser = outputs::folder())]
    pub out: PathBuf,
    /// The radio between the robots.
    #[command(flatten)]
    pub radio: LinkChange,
    #[command(flatten)]
    pub view: ViewArgs,
    #[command(flatten)]
    pub map: MapArgs,
    #[command(flatten)]
    pub source: SourceArgs,
}

use super::radio::{LinkChange, RadioInside};

/// Time for all nodes to start before the first scan.
const BEGIN: Stamp = Stamp(500_000);
/// After the last scan, repairs may take at most this long, also where the machine is busy with other things.
const SETTLE_MAX: Duration = Duration::from_secs(60);
/// How often nodes are asked how they do.
const LOOK_EVERY: Duration = Duration::from_millis(250);

/// What a node reports while it runs. It is counted on the thread of the demo, so that counting costs the
/// nodes nothing.
enum Update {
    Scan {
        stamp: Stamp,
        report: ScanReport,
    },
    Event {
        now: Stamp,
        event: Event,
    },
    /// Where the robot is when it takes a scan; said ahead of it.
    Place {
        stamp: Stamp,
        place: [f64; 3],
    },
    SendResult {
        now: Stamp,
        bytes: usize,
        copies: u32,
    },
}

/// A robot of the demo.
struct Flyer {
    name: String,
    stream: Stream,
    measures: Measures,
    pictures: Vec<MapPicture>,
    last_scan: Stamp,
    /// Bytes that the paper's method and RACER's would have sent so far, for the view.
    rivals: [Arc<AtomicU64>; 2],
}

/// Runs the command. Whether everything arrived and every voxel is equal.
pub fn run(args: &DemoArgs) -> anyhow::Result<bool> {
    let base = args.map.robot(args.codec, args.source.seed)?;
    let sources = sources::open_scene(&args.scene, &args.source, args.map.range)?;
    let title = format!("demo: {}", sources.title);
    let seconds = sources.robots.iter().map(|s| s.seconds_expected).fold(0.0, f64::max);

    let clock = Clock::at(Stamp(0));
    let (updates, reported) = channel();
    let (sockets, radio) = connect(sources.robots.len(), args.radio, args.source.seed)?;
    let (mut flyers, nodes) =
        start(sources.robots, sockets, &base, clock, &updates, args.view.view.is_some())?;
    drop(updates);
    let server = args.view.view.map(|address| show(address, title.clone(), &nodes)).transpose()?;
    if server.is_none() {
        eprintln!("`flockmap demo --view` shows it live in a browser");
    }
    fly(&mut flyers, &nodes, clock, &reported, seconds);
    let arrived = settle(&mut flyers, &nodes, clock, &reported)?;
    if let Some(server) = &server {
        view::wait("the map", server);
    }
    for (flyer, node) in flyers.iter_mut().zip(&nodes) {
        flyer.pictures.extend(picture(node));
        node.stop();
    }
    let ended = nodes.into_iter().map(|node| node.join().context("a node ended with an error"));
    let ended = ended.collect::<anyhow::Result<Vec<_>>>()?;
    let radio = radio_in_words(args.radio, radio)?;
    reported.try_iter().for_each(|update| count(&mut flyers, update));

    let times = |of: fn(&Timings) -> &Histogram| {
        TimeSummary::of_histograms(ended.iter().map(|ended| of(&ended.status.timings)))
    };
    let times = [times(|t| &t.insert_scan), times(|t| &t.pack), times(|t| &t.receive_to_insert)];
    let last_scan = flyers.iter().map(|flyer| flyer.last_scan).max().unwrap_or_default();
    let members = flyers.into_iter().zip(ended).map(|(flyer, ended)| {
        let Flyer { name, measures, pictures, .. } = flyer;
        Member { name, robot: ended.robot, measures, pictures, scans_damaged: 0 }
    });
    let run = Run { members: members.collect(), last_scan, arrived, times };
    let report = Report::new(&run, title, Settings::new(&base, args.map.mapper, &radio))?;
    let document = report.document();
    document.print(false);
    document.write(&args.out, &report)?;
    Ok(report.is_good())
}

/// What the radio was, and how much it lost.
fn radio_in_words(figures: LinkChange, radio: Option<RadioInside>) -> anyhow::Result<String> {
    let Some(radio) = radio else {
        return Ok("UDP sockets on this machine, in real time, nothing between them".to_owned());
    };
    let passed = radio.end()?;
    Ok(format!(
        "{} ({} of {} lost), emulated between UDP sockets in real time",
        figures.in_words(),
        thousands(passed.lost),
        thousands(passed.lost + passed.received)
    ))
}

/// The map of a node as it is now; `None` if the node has ended.
fn picture(node: &NodeHandle) -> Option<MapPicture> {
    node.with_robot(|robot, now| MapPicture::take(robot, since_begin(now)))
}

type Updates = Sender<(usize, Update)>;

/// The sockets of all nodes, with a radio between them unless it would be perfect.
fn connect(
    robots: usize,
    figures: LinkChange,
    seed: u64,
) -> anyhow::Result<(Vec<UdpSockets>, Option<RadioInside>)> {
    let options = UdpOptions::new("127.0.0.1:0".parse()?);
    let mut sockets = (0..robots).map(|_| UdpSockets::bind(&options)).collect::<Result<Vec<_>, _>>()?;
    let addresses = sockets.iter().map(UdpSockets::local_addr).collect::<io::Result<Vec<SocketAddr>>>()?;
    let radio =
        (!figures.is_perfect()).then(|| RadioInside::start(addresses.clone(), seed, figures)).transpose()?;
    let appear = radio.as_ref().map_or(&addresses, |radio| &radio.ports);
    for (number, sockets) in sockets.iter_mut().enumerate() {
        let others = appear.iter().enumerate().filter(|(other, _)| *other != number);
        others.for_each(|(_, address)| sockets.add_peer(*address));
    }
    Ok((sockets, radio))
}

/// The page with the maps of all nodes.
fn show(address: SocketAddr, title: String, nodes: &[NodeHandle]) -> anyhow::Result<ViewServer> {
    let sources = nodes.iter().filter_map(NodeHandle::view_source).collect();
    view::start(address, Content { title, kind: Kind::Live, sources, metrics: None })
}

fn start(
    robots: Vec<sources::Source>,
    sockets: Vec<UdpSockets>,
    base: &RobotConfig,
    clock: Clock,
    updates: &Updates,
    is_seen: bool,
) -> anyhow::Result<(Vec<Flyer>, Vec<NodeHandle>)> {
    let (mut flyers, mut nodes) = (Vec::new(), Vec::new());
    for (number, (source, sockets)) in robots.into_iter().zip(sockets).enumerate() {
        let config = RobotConfig { id: RobotId(number as u16 + 1), ..base.clone() };
        let stream = Stream { origin: config.id, epoch: config.epoch };
        let mut options = NodeOptions::new(config);
        options.name.clone_from(&source.name);
        let rivals = [Arc::default(), Arc::default()];
        if is_seen {
            options.map_output = Some(MapOutput::default());
            options.counters_beside = vec![
                ("paper_bytes_out", Arc::clone(&rivals[0])),
                ("racer_bytes_out", Arc::clone(&rivals[1])),
            ];
        }
        options.clock = clock;
        let place = updates.clone();
        let frames = source.frames.map(move |mut frame| {
            let update = Update::Place { stamp: frame.scan.stamp, place: frame.pose.translation() };
            // The demo is over if nobody listens.
            let _ = place.send((number, update));
            // A node hears of team-mates over its socket; here the scans come without them.
            let masks = frame.masks();
            team::cut_out(&mut frame.scan, &frame.pose, &masks);
            Ok(flockmap_node::Frame { scan: frame.scan, t_map_sensor: frame.pose, points_dropped: 0 })
        });
        options.sensor = Sensor::Play {
            frames: flockmap_node::Frames::new(frames),
            submaps: flockmap_node::SubmapPoses::default(),
            speed: 1.0,
            skip: Duration::ZERO,
            begin: Some(BEGIN),
        };
        let observe = updates.clone();
        options.observer = Some(Box::new(move |now, _robot, observation| {
            let reported = match observation {
                Observation::Scan { scan, report } => {
                    Update::Scan { stamp: scan.stamp, report: report.clone() }
                }
                Observation::Event(event) => Update::Event { now, event: event.clone() },
                _ => return,
            };
            // The demo is over if nobody listens.
            let _ = observe.send((number, reported));
        }));
        let meter = updates.clone();
        let make = move || Ok(Metered { inner: sockets.into_transport()?, clock, number, updates: meter });
        nodes.push(Node::start(options, make)?);
        let (name, measures, pictures) = (source.name, Measures::default(), Vec::new());
        flyers.push(Flyer { name, stream, measures, pictures, last_scan: Stamp(0), rivals });
    }
    Ok((flyers, nodes))
}

/// Waits until the last robot has played its last scan, or until Ctrl-C.
fn fly(
    flyers: &mut [Flyer],
    nodes: &[NodeHandle],
    clock: Clock,
    reported: &Receiver<(usize, Update)>,
    seconds: f64,
) {
    let progress = Progress::new("flying", seconds.ceil() as u64);
    let mut moments = [seconds / 3.0, seconds * 2.0 / 3.0].into_iter().peekable();
    loop {
        let look_at = Instant::now() + LOOK_EVERY;
        while let Ok(update) = reported.recv_timeout(look_at.saturating_duration_since(Instant::now())) {
            count(flyers, update);
        }
        let flown = since_begin(clock.now()).seconds();
        if moments.next_if(|moment| *moment <= flown).is_some() {
            flyers.iter_mut().zip(nodes).for_each(|(flyer, node)| flyer.pictures.extend(picture(node)));
        }
        let copies = nodes.len() as u64 - 1;
        for Flyer { measures, rivals, .. } in flyers.iter() {
            for (sent, rival) in [&measures.paper, &measures.racer].into_iter().zip(rivals) {
                rival.store(sent.wire.total() * copies, Ordering::Relaxed);
            }
        }
        let statuses: Vec<_> = nodes.iter().filter_map(NodeHandle::status).collect();
        let bytes: u64 = flyers.iter().map(|flyer| flyer.measures.sent.wire.total()).sum();
        let voxels: usize = statuses.iter().map(|s| s.map_voxels.0 + s.map_voxels.1).max().unwrap_or(0);
        progress.say(format!(
            "flying ({:.1} KB/s, {:.2} million voxels known)",
            bytes as f64 / 1024.0 / flown.max(1.0),
            voxels as f64 / 1e6
        ));
        progress.set(flown.clamp(0.0, seconds) as u64);
        if stop::requested() || statuses.iter().all(|status| status.sensor_ended) {
            return;
        }
    }
}

/// Closes the last batches and waits until everything has arrived everywhere. When it had, counted from the
/// begin; `None` if it did not happen.
fn settle(
    flyers: &mut [Flyer],
    nodes: &[NodeHandle],
    clock: Clock,
    reported: &Receiver<(usize, Update)>,
) -> anyhow::Result<Option<Stamp>> {
    let began = Instant::now();
    for node in nodes {
        node.with_robot(|robot, now| robot.flush(now)).context(ENDED)?;
    }
    let streams: Vec<Stream> = flyers.iter().map(|flyer| flyer.stream).collect();
    while began.elapsed() < SETTLE_MAX {
        // The own packages of each robot, and how many it has received of each.
        let mut states = Vec::new();
        for node in nodes {
            let streams = streams.clone();
            let state = node.with_robot(move |robot, _| {
                let of = |s: &Stream| robot.session().received(*s).map_or(0, |set| u64::from(set.prefix()));
                (robot.counters().packages, streams.iter().map(of).collect::<Vec<_>>())
            });
            states.push(state.context(ENDED)?);
        }
        reported.try_iter().for_each(|update| count(flyers, update));
        let is_all =
            |received: &[u64]| received.iter().zip(&states).all(|(got, (packages, _))| got >= packages);
        if states.iter().all(|(_, received)| is_all(received)) {
            return Ok(Some(since_begin(clock.now())));
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    Ok(None)
}

const ENDED: &str = "a node has ended too early";

/// Counts what a node reported. It reports a scan before it sends what came of it, so the scan is always
/// counted first.
fn count(flyers: &mut [Flyer], (number, update): (usize, Update)) {
    // The age counts from the scan that the sender made the voxel of.
    if let Update::Event { now, event: Event::Merged { stream, changes, .. } } = &update
        && let Some(sender) = flyers.iter().position(|flyer| flyer.stream == *stream)
        && let Ok([receiver, sender]) = flyers.get_disjoint_mut([number, sender])
    {
        receiver.measures.ages.add(*now, changes, &sender.measures.onset);
    }
    let Some(flyer) = flyers.get_mut(number) else { return };
    match update {
        Update::Scan { stamp, report } => {
            flyer.measures.scan(&report, stamp);
            flyer.last_scan = flyer.last_scan.max(since_begin(stamp));
        }
        Update::Event { now, event } => flyer.measures.event(since_begin(now), &event),
        Update::Place { stamp, place } => flyer.measures.path.push((stamp, place)),
        Update::SendResult { now, bytes, copies } => {
            flyer.measures.datagram_sent(since_begin(now), bytes, u64::from(copies));
        }
    }
}

fn since_begin(now: Stamp) -> Stamp {
    Stamp(now.micros_since(BEGIN))
}

/// UDP sockets that report every datagram sent.
struct Metered<T> {
    inner: T,
    clock: Clock,
    number: usize,
    updates: Updates,
}

impl<T: Transport> Transport for Metered<T> {
    async fn receive(&mut self, buffer: &mut [u8]) -> io::Result<(usize, Path)> {
        self.inner.receive(buffer).await
    }

    fn set_paths(&mut self, paths: &[Path]) {
        self.inner.set_paths(paths);
    }

    async fn send(&mut self, transmit: &Transmit) -> SendResult {
        let sent = self.inner.send(transmit).await;
        let reported =
            Update::SendResult { now: self.clock.now(), bytes: transmit.bytes.len(), copies: sent.copies };
        // The demo is over if nobody listens.
        let _ = self.updates.send((self.number, reported));
        sent
    }
}
