//! `flockmap replay`: records, or simulated flights, through the whole stack in virtual time.

use flockmap_cli::outputs;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::ensure;
use clap::Args;
use flockmap::{Cast, Codec, RobotConfig, RobotId, SessionConfig};
use flockmap_cli::options::{MapArgs, SourceArgs, budget, delay_micros, named, share};
use flockmap_cli::report::{Report, Settings};
use flockmap_cli::sources::Sources;
use flockmap_cli::view::{Recorder, ViewArgs};
use flockmap_cli::{json_file, sources, swarm, view};
use flockmap_netsim::{Link, RadioConfig};
use flockmap_view::{Content, Kind, Source, ViewServer};

/// Put records through the whole stack in virtual time: map, pack, send, lose, repair, merge
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap replay robot1.mcap robot2.mcap --resolution 0.2 --range 30
  flockmap replay robot1.mcap robot2.mcap --resolution 0.2 --range 30 --loss 0.2 --delay-ms 50 --json out.json
  flockmap replay kaist03/ --resolution 0.2 --range 40
  flockmap replay rosbag2_2026_11_23/ --resolution 0.2 --range 30
  flockmap replay two_robots/ --points-topic /robot1/points --points-topic /robot2/points
  flockmap replay flight.mcap --resolution 0.2 --range 30 --submaps-topic /slam/submaps    (docs/submaps.md)
  flockmap replay fr_079.bt --robots 3 --seconds 30 --out report/
  flockmap replay forest --loss 0.3 --budget-kb-s 40
  flockmap replay forest --loss 0.2 --view           (in a browser, with pause and back in time)

A RECORD is an .mcap (PointCloud2 with odometry or tf), a rosbag2 folder with such files, or a folder with Scans/*.pcd,
a KITTI pose file and times.txt. Each record is one robot. A single record is cut by time into --robots robots; with
--points-topic given several times, each topic is one robot (`flockmap info` shows the topics). In place of records one world can be named: forest, indoor, or a .bt, .pcd, .ply, .las or .laz file;
then --robots simulated robots fly through it. The same command gives the same bytes every time.
Exit code 1 if any two robots disagree on a voxel, or packages are missing at the end.")]
pub struct ReplayArgs {
    /// Records, one for each robot; or one world: forest, indoor, or a .bt .pcd .ply .las .laz file
    #[arg(value_name = "RECORD", required = true)]
    pub records: Vec<PathBuf>,
    /// Share of datagrams that the radio loses, 0 to 1
    #[arg(long, value_name = "P", default_value_t = 0.0)]
    pub loss: f64,
    /// Delay of the radio in milliseconds
    #[arg(long, value_name = "D", default_value_t = 0.0)]
    pub delay_ms: f64,
    /// Each datagram is late by up to so many milliseconds more, so that they overtake each other
    #[arg(long, value_name = "J", default_value_t = 0.0)]
    pub jitter_ms: f64,
    /// Share of datagrams that arrive twice, 0 to 1
    #[arg(long, value_name = "P", default_value_t = 0.0)]
    pub duplication: f64,
    /// Most kilobytes (1,024 bytes) that a robot sends in a second, IP and UDP headers counted; at least
    /// 0.02. Below 1.96 it holds on average, with one datagram of 1,228 bytes at once [default: 1,953]
    #[arg(long, value_name = "B")]
    pub budget_kb_s: Option<f64>,
    /// unicast: to each robot on its own, every copy counts; broadcast: once for all, as on a shared radio
    #[arg(long, value_name = "NAME", value_parser = named::<Cast>, default_value = "unicast")]
    pub cast: Cast,
    /// Codec of the packages: flock, paper, nested-zlib, raw or racer
    #[arg(long, value_name = "NAME", default_value_t = Codec::Flock)]
    pub codec: Codec,
    /// The session behaves as in the paper: packages on request only, oldest first, everyone answers
    #[arg(long)]
    pub paper_session: bool,
    /// Topic in an .mcap or bag with the poses of the robot's submaps (PoseArray, T_map_submap of each), for all or
    /// once for each robot: a submap begins where a pose is new, and all lie as the newest poses say
    #[arg(long, value_name = "TOPIC", help_heading = "Records", conflicts_with = "submap_length")]
    pub submaps_topic: Vec<String>,
    /// Records keep their own time in place of all starting together
    #[arg(long)]
    pub real_stamps: bool,
    /// Write what the table shows as JSON
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub json: Option<PathBuf>,
    /// Write report.html and report.json to this folder
    #[arg(long, value_name = "DIR", value_parser = outputs::folder())]
    pub out: Option<PathBuf>,
    #[command(flatten)]
    pub view: ViewArgs,
    #[command(flatten)]
    pub map: MapArgs,
    #[command(flatten)]
    pub source: SourceArgs,
}

/// Runs the command. Whether everything arrived and every voxel is equal.
pub fn run(args: &ReplayArgs) -> anyhow::Result<bool> {
    let link = Link {
        loss: share("--loss", args.loss)?,
        delay_micros: delay_micros("--delay-ms", args.delay_ms)?,
        jitter_micros: delay_micros("--jitter-ms", args.jitter_ms)?,
        duplication: share("--duplication", args.duplication)?,
        ..Link::default()
    };
    let mut session = if args.paper_session { SessionConfig::paper() } else { SessionConfig::default() };
    session.cast = args.cast;
    session.radio_bytes_per_s = args.budget_kb_s.map(budget).transpose()?.or(session.radio_bytes_per_s);
    let base = RobotConfig { session, ..args.map.robot(args.codec, args.source.seed)? };
    base.session.validate()?;
    if let [world] = args.records.as_slice() {
        ensure!(
            !args.real_stamps || !sources::is_world(world),
            "--real-stamps is for records, and {} is a world",
            world.display()
        );
        ensure!(
            args.submaps_topic.is_empty() || !sources::is_world(world),
            "--submaps-topic is for records, and {} is a world",
            world.display()
        );
    }
    let source = SourceArgs { submaps_topic: args.submaps_topic.clone(), ..args.source.clone() };
    let sources = match args.records.as_slice() {
        // A single robot has nobody to sync with.
        [record]
            if !sources::is_world(record) && args.source.robots > 1 && args.source.points_topic.len() < 2 =>
        {
            sources::open_parts(record, &source)?
        }
        records => sources::open(records, &source, args.map.range, args.real_stamps)?,
    };
    let radio = RadioConfig { seed: args.source.seed, link, ..RadioConfig::default() };
    let title = format!("replay of {}", sources.title);
    let view = args.view.view.map(|address| show(address, &sources, &base)).transpose()?;
    let (server, recorders) = view.unzip();
    let config = |id| RobotConfig { id, ..base.clone() };
    let run = swarm::run_recorded(sources.robots, config, radio, recorders.unwrap_or_default())?;
    let settings = Settings::new(&base, args.map.mapper, &radio_in_words(args));
    let report = Report::new(&run, title, settings)?;
    let document = report.document();
    document.print(false);
    let json = json_file::write_asked(args.json.as_deref(), &report);
    // Whatever became of the other one.
    let page = args.out.as_ref().map_or(Ok(()), |folder| document.write(folder, &report));
    json.and(page)?;
    if let Some(server) = server {
        view::wait("the replay", &server);
    }
    Ok(report.is_good())
}

/// The page of a replay, and what records it.
fn show(
    address: SocketAddr,
    sources: &Sources,
    base: &RobotConfig,
) -> anyhow::Result<(ViewServer, Vec<Recorder>)> {
    let copies = match base.session.cast {
        Cast::Broadcast => 1,
        Cast::Unicast => sources.robots.len() as u64 - 1,
    };
    let recorder = |(source, number): (&sources::Source, u16)| {
        Recorder::new(RobotId(number), &source.name, base.mapper.resolution, copies)
    };
    let recorders = sources.robots.iter().zip(1..).map(recorder).collect::<std::io::Result<Vec<_>>>()?;
    let content = Content {
        title: format!("replay of {}", sources.title),
        kind: Kind::Playback,
        sources: recorders.iter().map(|recorder| Arc::new(recorder.recording()) as Arc<dyn Source>).collect(),
        metrics: None,
    };
    Ok((view::start(address, content)?, recorders))
}

fn radio_in_words(args: &ReplayArgs) -> String {
    let mut words =
        vec![format!("{} % of datagrams lost", args.loss * 100.0), format!("{} ms delay", args.delay_ms)];
    if args.jitter_ms > 0.0 {
        words.push(format!("up to {} ms jitter", args.jitter_ms));
    }
    if args.duplication > 0.0 {
        words.push(format!("{} % arrive twice", args.duplication * 100.0));
    }
    if let Some(kb) = args.budget_kb_s {
        words.push(format!("at most {kb} KB/s a robot"));
    }
    words.join(", ")
}
