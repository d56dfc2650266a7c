//! The arguments of `flockmap radio`.

use flockmap_cli::outputs;
use std::net::SocketAddr;
use std::path::PathBuf;

use clap::Args;

use super::command::{LinkChange, Timed, within};

/// A bad radio on a desk: robots talk through it, and it loses, delays, doubles and damages what they send
#[derive(Args, Debug)]
#[command(after_help = HELP)]
pub struct RadioArgs {
    /// Where each robot listens (its `bind`, as others reach it), in the order of their numbers: 1, 2, 3 …
    #[arg(value_name = "ADDRESS:PORT", required = true, num_args = 2..)]
    pub robots: Vec<SocketAddr>,
    /// Robot N appears to the others at this address, N ports higher
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:7800")]
    pub listen: SocketAddr,
    /// The figures that all links begin with.
    #[command(flatten)]
    pub figures: LinkChange,
    /// Most kilobytes (1,024 bytes) a second that each robot can send, IP and UDP headers counted; what comes
    /// faster waits, up to 256 KiB of it [default: no limit]
    #[arg(long, value_name = "B", value_parser = |text: &str| within(text, 0.1, 4_000_000.0))]
    pub rate_kb_s: Option<f64>,
    /// Seed of all that is random
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
    /// Carry out a command so many seconds after the start; may be given many times
    #[arg(long, value_name = "\"S COMMAND\"")]
    pub at: Vec<Timed>,
    /// End after so many seconds [default: run until Ctrl-C or `end`]
    #[arg(long, value_name = "S")]
    pub seconds: Option<f64>,
    /// Write what the table at the end shows as JSON
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub json: Option<PathBuf>,
}

const HELP: &str = "\
Examples:
  flockmap radio 127.0.0.1:7701 127.0.0.1:7702 --loss 0.3 --delay-ms 40
  flockmap radio 10.0.0.1:7700 10.0.0.2:7700 10.0.0.3:7700 --listen 10.0.0.9:7800 --at \"20 split 1,2/3\" --at \"40 heal\"
  flockmap radio 127.0.0.1:7701 127.0.0.1:7702 --jitter-ms 30 --duplication 0.02 --bit-flips 0.01 --at \"0 link 1>2 loss=0.5\"

Stands between robots (`flockmap node`) and does to their datagrams what a bad radio would. Robot N appears to the others at the port of
--listen plus N. In the configuration of each robot give the addresses of the others there, and no other path: what to write is
printed at the start. A datagram counts for the link from the robot whose address it comes from to the robot at whose port it arrives;
what comes from elsewhere is dropped and counted.

Commands, on standard input or with --at:
  split 1,2/3,4     only robots of one group hear each other; one that is not named hears nobody
  cut LINKS         nothing passes; LINKS is 1-2 (both directions), 1>2 (one direction), 1 (all of robot 1) or all
  join LINKS        it passes again
  heal              everything passes again
  link LINKS loss=P delay-ms=D jitter-ms=J duplication=P bit-flips=P
  status            the table so far
  end               the table, and the end

docs/bad-radio.md shows it step by step.";
