//! `flockmap view`: a map, a record or a running node in a browser.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use clap::Args;
use flockmap::grid::Changes;
use flockmap::{RobotConfig, RobotId};
use flockmap_cli::options::{MapArgs, OF_BATCHES, SourceArgs};
use flockmap_cli::sources::ending;
use flockmap_cli::view::{self, Flight, Forwarded, Recorder};
use flockmap_cli::{sources, stop, swarm};
use flockmap_feed::{Address, Block, Client, ClientError, Event, Mirror};
use flockmap_netsim::RadioConfig;
use flockmap_view::{Content, Kind, Recording, Source, Step};

use super::voxels_of::voxels_of;

/// For a node to say who it is.
const HELLO_TIME: Duration = Duration::from_secs(5);

/// See a map, a record, or the map of a running node in a browser
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap view map.bt
  flockmap view robot1.mcap --resolution 0.2 --range 30     (with pause and back in time)
  flockmap view flight.mcap                                 (what a node recorded: [record] of its configuration)
  flockmap view robot1.local:7780                           (where its [map_output] listens)
  flockmap view unix:/run/flockmap/map.sock --listen 127.0.0.1:8000

It prints what to open, and serves it until Ctrl-C. A record is mapped with the mapper options while it is looked
at; the record of a flight holds the maps. A node may have a page of its own, `[view]` of its configuration; several records in
one swarm are `flockmap replay --view`.",
mut_args(super::hidden::hide(&[&OF_BATCHES])))]
pub struct ViewFileArgs {
    /// A map or a point cloud (.bt .pcd .ply .las .laz), a record, or the address of a node: `unix:PATH` or `HOST:PORT`
    #[arg(value_name = "FILE|ADDRESS")]
    pub what: PathBuf,
    /// Where the page is served. Beyond the loopback only with the token that is printed
    #[arg(long, value_name = "ADDRESS", default_value = view::ADDRESS)]
    pub listen: SocketAddr,
    #[command(flatten)]
    pub map: MapArgs,
    #[command(flatten)]
    pub source: SourceArgs,
}

/// Runs the command until Ctrl-C.
pub fn run(args: &ViewFileArgs) -> anyhow::Result<bool> {
    let name = args.what.to_string_lossy();
    match (args.what.exists(), name.parse::<Address>()) {
        (false, Ok(address)) => {
            let why = format!("is for files, and {address} is a node");
            args.map.given.refuse_all(&why)?;
            args.source.given.refuse_all(&why)?;
            follow(address, args.listen)?;
        }
        _ => match ending(&args.what).as_deref() {
            Some("bt" | "pcd" | "ply" | "las" | "laz") => show_map(args)?,
            Some("mcap") => match Flight::open(&args.what)? {
                Some(flight) => show_flight(args, flight)?,
                None => show_record(args)?,
            },
            _ => show_record(args)?,
        },
    }
    Ok(true)
}

/// A map that stands still.
fn show_map(args: &ViewFileArgs) -> anyhow::Result<()> {
    let (resolution, voxels) = voxels_of(&args.what, &args.map, &args.source)?;
    let changes = Changes::from_voxels(voxels);
    let block = |(index, states): &(_, _)| Block { index: *index, states: *states, origins: Vec::new() };
    let blocks = changes.blocks().iter().map(block).collect();
    let title = title_of(&args.what);
    let recording = Recording::new(RobotId(0), &title, resolution, "map")?;
    recording.push(Step { blocks, ..Step::default() });
    recording.finish();
    let recording: Arc<dyn Source> = Arc::new(Arc::new(recording));
    let content = Content { title, kind: Kind::Playback, sources: vec![recording], metrics: None };
    let server = view::start(args.listen, content)?;
    view::wait("the map", &server);
    Ok(())
}

/// What a node knew while it flew.
fn show_flight(args: &ViewFileArgs, flight: Flight) -> anyhow::Result<()> {
    let why =
        format!("is for records that are mapped, and {} holds the map of a flight", args.what.display());
    args.map.given.refuse_all(&why)?;
    args.source.given.refuse_all(&why)?;
    let content = Content {
        title: title_of(&args.what),
        kind: Kind::Playback,
        sources: vec![Arc::new(flight.recording())],
        metrics: None,
    };
    let server = view::start(args.listen, content)?;
    flight.read()?;
    view::wait("the flight", &server);
    Ok(())
}

/// A record, mapped by one robot.
fn show_record(args: &ViewFileArgs) -> anyhow::Result<()> {
    ensure!(
        args.source.points_topic.len() <= 1,
        "--points-topic is given {} times, and this is the map of one robot: `flockmap replay --view` shows several",
        args.source.points_topic.len()
    );
    let base = args.map.robot(flockmap::Codec::Flock, args.source.seed)?;
    let mut sources = sources::open(std::slice::from_ref(&args.what), &args.source, args.map.range, false)?;
    sources.robots.truncate(1);
    let title = sources.title;
    let recorders = sources
        .robots
        .iter()
        .map(|source| Recorder::new(RobotId(1), &source.name, base.mapper.resolution, 0));
    let recorders = recorders.collect::<std::io::Result<Vec<_>>>()?;
    let content = Content {
        title,
        kind: Kind::Playback,
        sources: recorders.iter().map(|recorder| Arc::new(recorder.recording()) as Arc<dyn Source>).collect(),
        metrics: None,
    };
    let server = view::start(args.listen, content)?;
    let config = |id| RobotConfig { id, ..base.clone() };
    swarm::run_recorded(sources.robots, config, RadioConfig::default(), recorders)?;
    view::wait("the record", &server);
    Ok(())
}

/// The feed of a node, passed on.
fn follow(address: Address, listen: SocketAddr) -> anyhow::Result<()> {
    let mut client = Client::new(address.clone(), Mirror::default());
    let began = Instant::now();
    let (id, name) = loop {
        match client.next(Duration::from_millis(50)) {
            Ok(Some(Event::Hello)) => {
                let node = client.mirror().node().context("a hello without a node")?;
                break (node.robot.0, node.name.clone());
            }
            Ok(_) if began.elapsed() < HELLO_TIME && !stop::requested() => {}
            Ok(_) => bail!("{address}: nothing came within {} s", HELLO_TIME.as_secs()),
            Err(error @ (ClientError::Feed(_) | ClientError::Ended(_))) => {
                return Err(error).with_context(|| address.to_string());
            }
            Err(error) => bail!(
                "{address}: {error}: expected a file, or a node that gives its map out there; it says so in its log when it starts with [map_output]"
            ),
        }
    };
    drop(client);
    let title = format!("{name} at {address}");
    let source: Arc<dyn Source> = Arc::new(Forwarded { id, name, address });
    let content = Content { title, kind: Kind::Live, sources: vec![source], metrics: None };
    let server = view::start(listen, content)?;
    view::wait("the map", &server);
    Ok(())
}

fn title_of(path: &Path) -> String {
    path.file_name().map_or_else(|| path.display().to_string(), |name| name.to_string_lossy().into_owned())
}
