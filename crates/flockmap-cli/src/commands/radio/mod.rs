//! `flockmap radio`: a bad radio on a desk. Real robots talk through it over UDP.

mod air;
mod args;
mod command;
mod inside;
mod relay;

use std::io::BufRead as _;
use std::net::SocketAddr;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::time::Duration;

use anyhow::{Context, anyhow, ensure};
use flockmap_cli::document::DataTable;
use flockmap_cli::numbers::thousands;
use flockmap_cli::program::command_line;
use flockmap_cli::{json_file, stop};
use serde_json::json;

use air::Air;

pub use args::RadioArgs;
pub use command::LinkChange;
use command::{RadioCommand, Timed};
pub use inside::RadioInside;
use relay::{Datagram, Relay, WAITING_MAX, stamp};

/// Most robots: 4,032 links.
const ROBOTS_MAX: usize = 64;

/// What wakes the radio.
enum Input {
    Datagram(Datagram),
    /// A line of standard input.
    Line(String),
}

impl From<Datagram> for Input {
    fn from(datagram: Datagram) -> Self {
        Self::Datagram(datagram)
    }
}

/// The radio at work.
struct Radio {
    relay: Relay,
    has_ended: bool,
}

/// Runs the radio until `end`, Ctrl-C or --seconds.
///
/// # Errors
/// A robot that does not exist is named, a port cannot be opened.
pub fn run(args: &RadioArgs) -> anyhow::Result<bool> {
    let (mut radio, inputs) = Radio::open(args)?;
    let robots = &radio.relay.robots;
    for number in 1..=robots.len() {
        let others = (1..=robots.len()).filter(|other| *other != number);
        let peers: Vec<String> = others
            .map(|other| Ok(format!("\"{}\"", appears_at(args.listen, other)?)))
            .collect::<anyhow::Result<_>>()?;
        println!("robot {number} at {}: peers = [{}]", robots[number - 1], peers.join(", "));
    }
    println!("the radio is on");
    radio.work(args, &inputs);
    println!("{}", radio.table());
    json_file::write_asked(args.json.as_deref(), &radio.report())?;
    Ok(true)
}

impl Radio {
    fn open(args: &RadioArgs) -> anyhow::Result<(Self, Receiver<Input>)> {
        let count = args.robots.len();
        ensure!(count <= ROBOTS_MAX, "{count} robots; at most {ROBOTS_MAX} expected");
        for (at, robot) in args.robots.iter().enumerate() {
            let is_new = !args.robots[..at].contains(robot);
            ensure!(is_new, "{robot} is given twice: every robot has an address or port of its own");
            let is_reached = !robot.ip().is_unspecified() && robot.port() != 0;
            ensure!(
                is_reached,
                "{robot} is no address to send to: give the one at which the robot is reached"
            );
        }
        for timed in &args.at {
            let checked = timed.command.clone().checked(count);
            checked.map_err(|error| anyhow!("--at \"{} …\": {error}", timed.at_s))?;
        }
        let (sender, inputs) = sync_channel(WAITING_MAX);
        let ports: Vec<SocketAddr> =
            (1..=count).map(|number| appears_at(args.listen, number)).collect::<anyhow::Result<_>>()?;
        let rate = args.rate_kb_s.map(|kb| (kb * 1_024.0) as u32);
        let air = Air::new(count, args.seed, rate, args.figures);
        let relay = Relay::open(args.robots.clone(), &ports, air, &sender)?;
        read_lines(sender)?;
        Ok((Self { relay, has_ended: false }, inputs))
    }

    fn work(&mut self, args: &RadioArgs, inputs: &Receiver<Input>) {
        let mut timed: Vec<&Timed> = args.at.iter().collect();
        timed.sort_by(|a, b| b.at_s.total_cmp(&a.at_s));
        let end = args.seconds.map(|seconds| stamp(Duration::from_secs_f64(seconds.clamp(0.0, 1e9))));
        let due_at = |timed: &Timed| stamp(Duration::from_secs_f64(timed.at_s));
        while !self.has_ended && !stop::requested() {
            let now = stamp(self.relay.elapsed());
            while let Some(next) = timed.pop_if(|next| due_at(next) <= now) {
                self.command(&next.command);
            }
            self.relay.deliver_due();
            if end.is_some_and(|end| end <= now) {
                break;
            }
            let until = [timed.last().map(|next| due_at(next)), end].into_iter().flatten().min();
            match inputs.recv_timeout(self.relay.wait(until)) {
                Ok(input) => self.take(input),
                Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {}
            }
        }
    }

    fn take(&mut self, input: Input) {
        match input {
            Input::Datagram(datagram) => self.relay.take(datagram),
            Input::Line(line) if line.trim().is_empty() => {}
            Input::Line(line) => {
                let command =
                    line.parse().and_then(|command: RadioCommand| command.checked(self.relay.robots.len()));
                match command {
                    Ok(command) => self.command(&command),
                    Err(error) => eprintln!("{error}"),
                }
            }
        }
    }

    fn command(&mut self, command: &RadioCommand) {
        println!("{:.1} s: {command:?}", self.relay.elapsed().as_secs_f64());
        match command {
            RadioCommand::Status => println!("{}", self.table()),
            RadioCommand::End => self.has_ended = true,
            _ => self.relay.air.command(command),
        }
    }

    fn table(&self) -> String {
        let rows = (1..=self.relay.robots.len()).map(|number| {
            let (traffic, flipped) = self.relay.air.traffic(number);
            let kb = |bytes: u64| thousands(bytes.div_ceil(1_024));
            [
                format!("{number} at {}", self.relay.robots[number - 1]),
                thousands(traffic.sent),
                kb(traffic.sent_bytes),
                thousands(traffic.dropped),
                thousands(traffic.received),
                kb(traffic.received_bytes),
                thousands(traffic.lost),
                thousands(flipped),
            ]
        });
        let headings = ["robot", "sent", "KB", "dropped", "received", "KB", "lost", "wrong bit"];
        let table = DataTable::unnamed(headings, rows);
        let rest = format!(
            "  {:.1} s; {} datagrams from strangers, {} that the system did not take",
            self.relay.elapsed().as_secs_f64(),
            thousands(self.relay.from_strangers),
            thousands(self.relay.send_failed)
        );
        format!("{table}{rest}")
    }

    fn report(&self) -> serde_json::Value {
        let robots = (1..=self.relay.robots.len()).map(|number| {
            let (traffic, flipped) = self.relay.air.traffic(number);
            json!({
                "robot": number,
                "address": self.relay.robots[number - 1].to_string(),
                "sent": traffic.sent,
                "sent_bytes": traffic.sent_bytes,
                "dropped": traffic.dropped,
                "received": traffic.received,
                "received_bytes": traffic.received_bytes,
                "lost": traffic.lost,
                "wrong_bit": flipped,
            })
        });
        json!({
            "command": command_line(),
            "seconds": self.relay.elapsed().as_secs_f64(),
            "robots": robots.collect::<Vec<_>>(),
            "from_strangers": self.relay.from_strangers,
            "send_failed": self.relay.send_failed,
        })
    }
}

/// Where a robot appears to the others.
fn appears_at(listen: SocketAddr, robot: usize) -> anyhow::Result<SocketAddr> {
    let port = usize::from(listen.port()) + robot;
    let port = u16::try_from(port)
        .with_context(|| format!("robot {robot} would be at port {port}; a lower port in --listen"))?;
    Ok(SocketAddr::new(listen.ip(), port))
}

/// Reads commands until standard input ends.
fn read_lines(sender: SyncSender<Input>) -> std::io::Result<()> {
    let read = move || {
        let mut lines = std::io::stdin().lock().lines().map_while(Result::ok);
        lines.try_for_each(|line| sender.send(Input::Line(line)))
    };
    std::thread::Builder::new().name("commands".into()).spawn(read).map(drop)
}
