//! The maps of swarms beyond their radio, over Zenoh. `docs/fleet.md` is the manual.

mod answers;
mod asked;
mod bus;
mod catch_up;
mod claims;
mod clocks;
mod counters;
mod face;
mod held;
mod holders;
mod keys;
mod link;
mod members;
mod newcomers;
mod puts;
mod question;
mod run;
mod takes;

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Parser, Subcommand};

/// The maps of Flockmap swarms beyond their radio: at a ground station, in an archive, at the next site.
///
/// A gateway stands on the radio of a swarm and puts each package that it merges on Zenoh, under
/// flockmap/SWARM/VERSION/ROBOT-RUN/INDEX. Archives and ground stations take what is put, and ask gateways and archives
/// for what they lack, so that whoever comes late, or was away, has the whole map soon. Zenoh needs TCP, TLS or QUIC
/// below it: it is not for the radio.
#[derive(Parser)]
#[command(
    version,
    after_help = "Five minutes, with a router on the laptop (zenohd, or any program that has one):
  zenohd --listen tcp/[::]:7447
  flockmap-zenoh gateway --config robot9.toml --connect tcp/LAPTOP:7447      on a robot, or beside the radio
  flockmap-zenoh station --connect tcp/LAPTOP:7447 --view 127.0.0.1:7781     on the laptop
  flockmap-zenoh archive --connect tcp/LAPTOP:7447 --store maps              where there is a disk

docs/fleet.md has TLS and access control, joined sites, what each piece keeps, and how it scales."
)]
struct Options {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// A robot on the radio of its swarm, with a sensor or without: puts what it merges, and answers who asks for more
    Gateway(Gateway),
    /// Keeps the maps of swarms on disk, and answers whoever asks for them
    Archive(Archive),
    /// Maps of swarms without a radio: for planners, a browser, and files
    Station(Station),
    /// Joins a swarm to another one far away, over the repair protocol at a given rate
    Join(Join),
}

/// How Zenoh is reached.
#[derive(Args, Clone)]
pub(crate) struct Bus {
    /// Where to connect: tcp/ROUTER:7447, tls/ROUTER:7447, quic/ROUTER:7447. May be given several times
    #[arg(long, value_name = "ENDPOINT")]
    connect: Vec<String>,
    /// Be reached here, without a router: tcp/[::]:7447. May be given several times
    #[arg(long, value_name = "ENDPOINT")]
    listen: Vec<String>,
    /// A configuration of Zenoh's own (JSON5), for TLS, users and the rest. What it does not say is as in Zenoh
    #[arg(long, value_name = "FILE")]
    zenoh: Option<PathBuf>,
    /// By what others find it: letters, digits, -, _ and . Default: what it is, and Zenoh's id
    #[arg(long)]
    name: Option<String>,
    /// How often it looks what others hold, in seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 10.0)]
    period_s: f64,
}

#[derive(Args)]
pub(crate) struct Gateway {
    /// Configuration of the node, as of `flockmap node`
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// Take packages from Zenoh too, and send them on over the radio: for a swarm that is joined to another one.
    /// Whoever may put packages there can then change the maps of the robots
    #[arg(long)]
    take: bool,
    #[command(flatten)]
    bus: Bus,
}

#[derive(Args)]
pub(crate) struct Archive {
    /// The folder for the stores, one for each swarm in it; made if need be
    #[arg(long, value_name = "FOLDER")]
    store: PathBuf,
    /// Bytes that the store of a swarm may take on disk. From half of it on it is replaced by snapshots. Default 4 GiB
    #[arg(long, value_name = "BYTES", default_value_t = 4 << 30)]
    bytes_max: u64,
    #[command(flatten)]
    swarms: Swarms,
    #[command(flatten)]
    bus: Bus,
}

/// Which swarms, and how their nodes are.
#[derive(Args)]
pub(crate) struct Swarms {
    /// The number of a swarm. May be given several times. Default: all that are found, up to 16
    #[arg(long, value_name = "NUMBER")]
    swarm: Vec<u16>,
    /// A configuration as of `flockmap node`, whose values count for the node of each swarm: alignments, muted robots,
    /// limits. `[network]` does not count. `{swarm}` in --map and --save is the number
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// The id that it has, which no robot of the swarm may have
    #[arg(long, default_value_t = u16::MAX)]
    id: u16,
    /// Serve counters as Prometheus text here, those of the next swarm at the next port, and so on
    #[arg(long, value_name = "ADDRESS")]
    metrics: Option<SocketAddr>,
    /// The summary is written here as JSON at the end. Default: stdout
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    /// End after so long, in seconds
    #[arg(long, value_name = "SECONDS")]
    end_after_s: Option<f64>,
}

#[derive(Args)]
pub(crate) struct Station {
    /// Show the map of the first swarm in a browser here; that of the next one at the next port, and so on
    #[arg(long, value_name = "ADDRESS")]
    view: Option<SocketAddr>,
    /// Give the map to planners over this Unix socket; `{swarm}` in it is the number of the swarm
    #[arg(long, value_name = "SOCKET")]
    map: Option<String>,
    /// Save the map here at the end, .ply, .pcd or .bt; `{swarm}` in it is the number of the swarm
    #[arg(long, value_name = "FILE")]
    save: Option<String>,
    #[command(flatten)]
    swarms: Swarms,
    #[command(flatten)]
    bus: Bus,
}

#[derive(Args)]
pub(crate) struct Join {
    /// The swarm of this site, whose packages go to the other site, and the other way round
    #[arg(long, value_name = "NUMBER")]
    swarm: u16,
    /// The id that it has, which no robot of either swarm may have, nor the other end
    #[arg(long)]
    id: u16,
    /// By what the ends of a link find each other
    #[arg(long, value_name = "NAME")]
    link: String,
    /// KiB that may go to the other sites in a second, all counted that Zenoh adds to a datagram
    #[arg(long, value_name = "KIB")]
    rate_kb_s: f64,
    /// Where the link is reached, if not where the packages of this site are
    #[arg(long, value_name = "ENDPOINT")]
    link_connect: Vec<String>,
    /// Be reached here for the link
    #[arg(long, value_name = "ENDPOINT")]
    link_listen: Vec<String>,
    /// A configuration of Zenoh's own for the link
    #[arg(long, value_name = "FILE")]
    link_zenoh: Option<PathBuf>,
    /// A configuration as of `flockmap node`, whose values count for the node that is the end of the link
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Serve counters as Prometheus text here
    #[arg(long, value_name = "ADDRESS")]
    metrics: Option<SocketAddr>,
    /// The summary is written here as JSON at the end. Default: stdout
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    #[command(flatten)]
    bus: Bus,
}

impl Swarms {
    fn wanted(&self) -> BTreeSet<u16> {
        self.swarm.iter().copied().collect()
    }
}

fn main() -> ExitCode {
    let result = match Options::parse().command {
        Command::Gateway(options) => run::gateway(&options),
        Command::Archive(options) => run::archive(&options),
        Command::Station(options) => run::station(options),
        Command::Join(options) => run::join(&options),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}
