//! `flockmap radio`: a bad radio on a desk. Real robots talk through it over UDP.

mod air;
mod args;
mod command;

use std::io::{BufRead, ErrorKind};
use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, ensure};
use flockmap::Stamp;
use flockmap_cli::document::DataTable;
use flockmap_cli::numbers::thousands;
use flockmap_cli::program::command_line;
use flockmap_cli::{json_file, stop};
use serde_json::json;

use air::Air;

pub use args::RadioArgs;
use command::{RadioCommand, Timed};

/// Datagrams that were read and wait to be put on the air; of more, the system drops some.
const WAITING_MAX: usize = 4_096;

/// A robot whose queue is full for so long loses the datagram.
const SEND_WAIT_MAX: Duration = Duration::from_millis(2);

/// Ctrl-C is looked for so often.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// Longer datagrams than any of Flockmap pass too, up to here.
const BUFFER_BYTES: usize = 65_536;

/// Most robots: 4,032 links.
const ROBOTS_MAX: usize = 64;

/// What wakes the radio.
enum Input {
    /// A datagram from an address to the port of a robot.
    Datagram { from: SocketAddr, to: usize, bytes: Vec<u8> },
    /// A line of standard input.
    Line(String),
}

/// The radio at work.
struct Radio {
    air: Air,
    robots: Vec<SocketAddr>,
    /// At which each robot appears to the others.
    sockets: Vec<Arc<UdpSocket>>,
    began: Instant,
    has_ended: bool,
    /// Datagrams from an address that is no robot's.
    from_strangers: u64,
    /// Datagrams that the system did not take.
    send_failed: u64,
}

/// Runs the radio until `end`, Ctrl-C or --seconds.
///
/// # Errors
/// A robot that does not exist is named, a port cannot be opened.
pub fn run(args: &RadioArgs) -> anyhow::Result<bool> {
    let (mut radio, inputs) = Radio::open(args)?;
    for number in 1..=radio.robots.len() {
        let others = (1..=radio.robots.len()).filter(|other| *other != number);
        let peers: Vec<String> = others
            .map(|other| Ok(format!("\"{}\"", appears_at(args.listen, other)?)))
            .collect::<anyhow::Result<_>>()?;
        println!("robot {number} at {}: peers = [{}]", radio.robots[number - 1], peers.join(", "));
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
        let mut sockets = Vec::with_capacity(count);
        for number in 1..=count {
            let address = appears_at(args.listen, number)?;
            let socket = UdpSocket::bind(address)
                .with_context(|| format!("cannot open {address} for robot {number}; another --listen?"))?;
            socket.set_write_timeout(Some(SEND_WAIT_MAX))?;
            let socket = Arc::new(socket);
            read_datagrams(Arc::clone(&socket), number, sender.clone())?;
            sockets.push(socket);
        }
        read_lines(sender)?;
        let rate = args.rate_kb_s.map(|kb| (kb * 1_024.0) as u32);
        let radio = Self {
            air: Air::new(count, args.seed, rate, args.figures),
            robots: args.robots.clone(),
            sockets,
            began: Instant::now(),
            has_ended: false,
            from_strangers: 0,
            send_failed: 0,
        };
        Ok((radio, inputs))
    }

    fn work(&mut self, args: &RadioArgs, inputs: &Receiver<Input>) {
        let mut timed: Vec<&Timed> = args.at.iter().collect();
        timed.sort_by(|a, b| b.at_s.total_cmp(&a.at_s));
        let end = args.seconds.map(|seconds| stamp(Duration::from_secs_f64(seconds.clamp(0.0, 1e9))));
        let due_at = |timed: &Timed| stamp(Duration::from_secs_f64(timed.at_s));
        while !self.has_ended && !stop::requested() {
            let now = stamp(self.began.elapsed());
            while let Some(next) = timed.pop_if(|next| due_at(next) <= now) {
                self.command(&next.command);
            }
            while let Some(delivery) = self.air.deliver_due(now) {
                let [from, to] = [delivery.from, delivery.to].map(|id| usize::from(id.0) - 1);
                let is_sent = sends(&self.sockets[from], &delivery.bytes, self.robots[to]);
                self.send_failed += u64::from(!is_sent);
            }
            if end.is_some_and(|end| end <= now) {
                break;
            }
            let next = [self.air.next_due(), timed.last().map(|next| due_at(next)), end];
            let until_next = next.into_iter().flatten().min().map(|due| due.micros_since(now).max(0) as u64);
            let wait = until_next.map_or(LOOK_EVERY, |micros| Duration::from_micros(micros).min(LOOK_EVERY));
            match inputs.recv_timeout(wait) {
                Ok(input) => self.take(input),
                Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {}
            }
        }
    }

    fn take(&mut self, input: Input) {
        match input {
            Input::Datagram { from, to, bytes } => {
                match self.robots.iter().position(|robot| *robot == from).map(|at| at + 1) {
                    Some(robot) if robot != to => {
                        let now = stamp(self.began.elapsed());
                        self.air.send(now, robot, to, &bytes);
                    }
                    _ => {
                        self.from_strangers += 1;
                        if self.from_strangers == 1 {
                            eprintln!(
                                "warning: a datagram from {from} to the port of robot {to} is from none of the others: is that the \
                                 address that its robot was given with here? It is dropped, and so are more of the kind"
                            );
                        }
                    }
                }
            }
            Input::Line(line) if line.trim().is_empty() => {}
            Input::Line(line) => {
                let command =
                    line.parse().and_then(|command: RadioCommand| command.checked(self.robots.len()));
                match command {
                    Ok(command) => self.command(&command),
                    Err(error) => eprintln!("{error}"),
                }
            }
        }
    }

    fn command(&mut self, command: &RadioCommand) {
        println!("{:.1} s: {command:?}", self.began.elapsed().as_secs_f64());
        match command {
            RadioCommand::Status => println!("{}", self.table()),
            RadioCommand::End => self.has_ended = true,
            _ => self.air.command(command),
        }
    }

    fn table(&self) -> String {
        let rows = (1..=self.robots.len()).map(|number| {
            let (traffic, flipped) = self.air.traffic(number);
            let kb = |bytes: u64| thousands(bytes.div_ceil(1_024));
            [
                format!("{number} at {}", self.robots[number - 1]),
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
            self.began.elapsed().as_secs_f64(),
            thousands(self.from_strangers),
            thousands(self.send_failed)
        );
        format!("{table}{rest}")
    }

    fn report(&self) -> serde_json::Value {
        let robots = (1..=self.robots.len()).map(|number| {
            let (traffic, flipped) = self.air.traffic(number);
            json!({
                "robot": number,
                "address": self.robots[number - 1].to_string(),
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
            "seconds": self.began.elapsed().as_secs_f64(),
            "robots": robots.collect::<Vec<_>>(),
            "from_strangers": self.from_strangers,
            "send_failed": self.send_failed,
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

/// Whether the system took the datagram. That an earlier one found nobody is reported here too, and is no
/// fault of this one.
fn sends(socket: &UdpSocket, bytes: &[u8], to: SocketAddr) -> bool {
    (0..2).any(|_| socket.send_to(bytes, to).is_ok())
}

/// Reads what arrives at the port of a robot, for as long as the program runs.
fn read_datagrams(socket: Arc<UdpSocket>, to: usize, sender: SyncSender<Input>) -> std::io::Result<()> {
    let read = move || {
        let mut buffer = vec![0; BUFFER_BYTES];
        loop {
            match socket.recv_from(&mut buffer) {
                Ok((length, from)) => {
                    let bytes = buffer[..length].to_vec();
                    if sender.send(Input::Datagram { from, to, bytes }).is_err() {
                        return;
                    }
                }
                // A robot that is off: the system reports it of an earlier datagram.
                Err(error) if error.kind() == ErrorKind::ConnectionRefused => {}
                Err(_) => std::thread::sleep(Duration::from_millis(1)),
            }
        }
    };
    std::thread::Builder::new().name(format!("robot {to}")).spawn(read).map(drop)
}

/// Reads commands until standard input ends.
fn read_lines(sender: SyncSender<Input>) -> std::io::Result<()> {
    let read = move || {
        let mut lines = std::io::stdin().lock().lines().map_while(Result::ok);
        lines.try_for_each(|line| sender.send(Input::Line(line)))
    };
    std::thread::Builder::new().name("commands".into()).spawn(read).map(drop)
}

fn stamp(since_start: Duration) -> Stamp {
    Stamp(i64::try_from(since_start.as_micros()).unwrap_or(i64::MAX))
}
