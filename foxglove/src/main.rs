//! The map of a running node, live in the Foxglove app. `docs/flights.md` is its manual.

mod apps;
mod channels;
mod follow;
mod run;

use std::net::SocketAddr;
use std::process::ExitCode;

use clap::Parser;
use flockmap_feed::Address;

/// Show the map of a running node in the Foxglove app, live
///
/// Follows the map that the node gives out (`[map_output]` of its configuration), and serves it with robots, paths,
/// counters and links to the app: `Open connection`, `Foxglove WebSocket`, the address of --listen. Connects to the node
/// again by itself. Ends with Ctrl-C.
#[derive(Parser, Clone, Debug)]
#[command(
    version,
    after_help = "\
Examples:
  flockmap-foxglove 127.0.0.1:7780
  flockmap-foxglove unix:/run/flockmap/map.sock --origins --scans
  flockmap-foxglove robot1.local:7780 --listen 127.0.0.1:8766    a second robot beside the first

Whoever reaches the address of --listen can read the map: there is no password. From another machine, a tunnel is safer
than an open address: ssh -L 8765:127.0.0.1:8765 robot1.local. docs/flights.md has the topics."
)]
struct Options {
    /// Where the node gives its map out: `unix:PATH` or `HOST:PORT`
    #[arg(value_name = "ADDRESS")]
    address: Address,
    /// Where the app connects: an IP address and a port; port 0 takes a free one
    #[arg(long, value_name = "IP:PORT", default_value = "127.0.0.1:8765")]
    listen: SocketAddr,
    /// Colour the map by the robot that saw each voxel last; the node pays for that
    #[arg(long)]
    origins: bool,
    /// Show what the sensor sees: up to 2,048 points of a scan, ten times a second
    #[arg(long)]
    scans: bool,
}

fn main() -> ExitCode {
    match run::run(&Options::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}
