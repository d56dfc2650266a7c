//! `flockmap mirror`: the map of a running node, followed.

use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, bail, ensure};
use clap::Args;
use flockmap::MapView;
use flockmap_cli::numbers::{kb, thousands};
use flockmap_cli::sources::ending;
use flockmap_cli::{outputs, stop};
use flockmap_feed::{Address, Client, ClientError, Event, Mirror, MirrorOptions};
use flockmap_io::{ExportOptions, export_map};
use hdrhistogram::Histogram;

/// Ctrl-C is looked for this often.
const WAIT: Duration = Duration::from_millis(50);

/// The status is said so often, on a terminal and elsewhere.
const STATUS_EVERY: [Duration; 2] = [Duration::from_millis(500), Duration::from_secs(5)];

/// A state that is older than this when it comes is not one whose way is measured: the clocks differ.
const LATENCY_MAX: Duration = Duration::from_secs(3_600);

/// Follow the map of a running node
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap mirror unix:/run/flockmap/map.sock
  flockmap mirror 127.0.0.1:7780 --once --out map.ply
  flockmap mirror robot1.local:7780 --for 60 --out map.bt

The node gives its map out where `[map_output]` of its configuration says. When the connection breaks, it is made again
and goes on from what is there. It ends with Ctrl-C, with the node, or as the options say; then it says what it has, and
how long it took from a change of the node's map until it was here. That means something where both have the same clock.")]
pub struct MirrorArgs {
    /// Where the node gives its map out: `unix:PATH` or `HOST:PORT`
    #[arg(value_name = "ADDRESS")]
    pub address: Address,
    /// At the end, write the map here: a path that ends in .ply, .pcd or .bt
    #[arg(long, value_name = "MAP", value_parser = outputs::file())]
    pub out: Option<PathBuf>,
    /// Write free voxels too (a .bt always holds them)
    #[arg(long, requires = "out")]
    pub free: bool,
    /// End when the whole map is here
    #[arg(long)]
    pub once: bool,
    /// End after so many seconds
    #[arg(long = "for", value_name = "SECONDS", value_parser = seconds)]
    pub for_s: Option<f64>,
    /// Ask who saw each voxel last, and count by robot at the end
    #[arg(long)]
    pub origins: bool,
    /// Read no more than so many bytes in a second
    #[arg(long, value_name = "BYTES_PER_S", value_parser = clap::value_parser!(u32).range(1..))]
    pub rate_max: Option<u32>,
    /// Most blocks of 8³ voxels to hold; each takes 350 bytes, and up to 1.1 kB more with --origins
    #[arg(long, value_name = "N", default_value_t = MirrorOptions::default().blocks_max)]
    pub blocks_max: usize,
}

fn seconds(text: &str) -> Result<f64, String> {
    let number: f64 = text.parse().map_err(|_| "not a number".to_owned())?;
    if (0.0..=1e9).contains(&number) { Ok(number) } else { Err("0 to 1,000,000,000 expected".to_owned()) }
}

/// Follows the map until the end; whether it was complete then, if that was asked for.
pub fn run(args: &MirrorArgs) -> anyhow::Result<bool> {
    if let Some(path) = &args.out {
        let is_known = matches!(ending(path).as_deref(), Some("ply" | "pcd" | "bt"));
        ensure!(is_known, "--out {}: expected a path that ends in .ply, .pcd or .bt", path.display());
    }
    let mirror = Mirror::new(MirrorOptions {
        origins: args.origins,
        blocks_max: args.blocks_max,
        ..MirrorOptions::default()
    });
    let mut client = Client::new(args.address.clone(), mirror);
    if let Some(rate) = args.rate_max {
        client = client.at_most(rate);
    }
    let mut followed = Followed::new();
    let until = args.for_s.map(|seconds| followed.began + Duration::from_secs_f64(seconds));
    while !stop::requested() && until.is_none_or(|until| Instant::now() < until) {
        match client.next(WAIT) {
            Ok(Some(event)) => followed.note(event, client.mirror()),
            Ok(None) => {}
            Err(ClientError::Ended(reason)) if followed.connections > 0 => {
                followed.line.say(&format!("{}: {reason}", args.address));
                break;
            }
            Err(error @ (ClientError::Feed(_) | ClientError::Ended(_))) => {
                return Err(error).with_context(|| args.address.to_string());
            }
            Err(error) if followed.connections == 0 => bail!(
                "{}: {error}: expected a node that gives its map out there; it says so in its log when it starts with [map_output]",
                args.address
            ),
            Err(error) => followed.line.say(&format!("{}: {error}; connecting again", args.address)),
        }
        if args.once && client.mirror().is_complete() {
            break;
        }
        followed.say_status(&client);
    }
    followed.line.end();
    finish(args, &followed, &client)
}

fn finish(args: &MirrorArgs, followed: &Followed, client: &Client) -> anyhow::Result<bool> {
    let mirror = client.mirror();
    let (Some(map), Some(node)) = (mirror.map(), mirror.node()) else {
        bail!("{}: nothing came", args.address);
    };
    let (free, occupied) = map.count();
    println!(
        "{} (robot {}), frame {}, voxels of {} m: {} blocks, {} free, {} occupied",
        node.name,
        node.robot,
        node.frame,
        map.resolution().metres(),
        thousands(map.block_count() as u64),
        thousands(free as u64),
        thousands(occupied as u64)
    );
    let state = match mirror.behind() {
        _ if mirror.is_complete() => "complete".to_owned(),
        0 => "not complete".to_owned(),
        behind => format!("not complete: {} changes behind", thousands(behind)),
    };
    println!(
        "version {} of the node's map, {state}; {} KB in {:.1} s, {} connection(s)",
        mirror.have().map_or(0, |have| have.upto),
        kb(client.bytes_in() as f64),
        followed.began.elapsed().as_secs_f64(),
        followed.connections
    );
    if !followed.latency.is_empty() {
        let ms = |share: f64| followed.latency.value_at_quantile(share) as f64 / 1e3;
        println!(
            "from merge to mirror: median {:.1} ms, 99 % {:.1} ms, {} states",
            ms(0.5),
            ms(0.99),
            thousands(followed.latency.len())
        );
    }
    for robot in mirror.robots() {
        let [x, y, z] = robot.position;
        let age = robot.age.as_secs_f64();
        println!("robot {} at {x:.2} {y:.2} {z:.2} m, {age:.1} s before that was said", robot.stream.origin);
    }
    if args.origins {
        let mut counted = std::collections::BTreeMap::<_, u64>::new();
        for robot in map.voxels().filter_map(|(voxel, _)| mirror.origin(voxel)) {
            *counted.entry(robot).or_default() += 1;
        }
        for (robot, voxels) in counted {
            println!("robot {robot} saw {} voxels last", thousands(voxels));
        }
    }
    if let Some(path) = &args.out {
        let count = export_map(path, map.resolution(), map.voxels(), &ExportOptions { free: args.free })?;
        println!("{}: {} voxels", path.display(), thousands(count));
    }
    Ok(!args.once || mirror.is_complete())
}

/// What was seen of the feed.
struct Followed {
    began: Instant,
    connections: u64,
    /// From a change of the node's map until the mirror has it, in microseconds.
    latency: Histogram<u64>,
    /// The newest version of which that was measured, in this run of the node.
    measured: u64,
    line: StatusLine,
}

impl Followed {
    fn new() -> Self {
        let latency = Histogram::new_with_max(LATENCY_MAX.as_micros() as u64, 3);
        Self {
            began: Instant::now(),
            connections: 0,
            latency: latency.expect("three digits and an hour are allowed"),
            measured: 0,
            line: StatusLine::new(),
        }
    }

    fn note(&mut self, event: Event, mirror: &Mirror) {
        match event {
            Event::Hello => self.connections += 1,
            Event::Anew => self.measured = mirror.newest(),
            // What was there before the mirror came is not new.
            Event::Blocks(_) if self.measured == 0 => self.measured = mirror.newest(),
            Event::Blocks(_) if mirror.is_complete() && mirror.newest() > self.measured => {
                self.measured = mirror.newest();
                let age = now_micros().saturating_sub(mirror.stamp().0);
                if let Ok(age) = u64::try_from(age)
                    && age < LATENCY_MAX.as_micros() as u64
                {
                    self.latency.saturating_record(age);
                }
            }
            _ => {}
        }
    }

    fn say_status(&mut self, client: &Client) {
        let Some(seconds) = self.line.due() else { return };
        let mirror = client.mirror();
        let Some(map) = mirror.map() else { return };
        let rate = (client.bytes_in() - self.line.bytes_before) as f64 / seconds;
        self.line.bytes_before = client.bytes_in();
        let (free, occupied) = counted(map);
        let age = (now_micros() - mirror.stamp().0) as f64 / 1e6;
        let state = if client.is_connected() { "" } else { " | NO CONNECTION" };
        self.line.show(&format!(
            "{} blocks | {free} free {occupied} occupied | version {} behind {} | changed {age:.1} s ago | {} KB/s{state}",
            thousands(map.block_count() as u64),
            mirror.have().map_or(0, |have| have.upto),
            mirror.behind(),
            kb(rate)
        ));
    }
}

fn counted(map: &MapView) -> (String, String) {
    let (free, occupied) = map.count();
    (thousands(free as u64), thousands(occupied as u64))
}

/// What this machine's clock shows, in microseconds since 1970.
fn now_micros() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_micros()).unwrap_or(i64::MAX)
}

/// A line on stderr that is written anew, or from time to time where there is no terminal.
struct StatusLine {
    is_terminal: bool,
    is_shown: bool,
    last: Instant,
    bytes_before: u64,
}

impl StatusLine {
    fn new() -> Self {
        let is_terminal = std::io::stderr().is_terminal();
        Self { is_terminal, is_shown: false, last: Instant::now(), bytes_before: 0 }
    }

    /// Whether it is time, and after how many seconds.
    fn due(&mut self) -> Option<f64> {
        let elapsed = self.last.elapsed();
        (elapsed >= STATUS_EVERY[usize::from(!self.is_terminal)]).then(|| {
            self.last = Instant::now();
            elapsed.as_secs_f64()
        })
    }

    fn show(&mut self, text: &str) {
        let (before, after) = if self.is_terminal { ("\r\x1b[K", "") } else { ("", "\n") };
        let mut out = std::io::stderr().lock();
        // There is nowhere else to complain.
        let _ = write!(out, "{before}{text}{after}").and_then(|()| out.flush());
        self.is_shown = self.is_terminal;
    }

    /// Says something that stays.
    fn say(&mut self, text: &str) {
        self.end();
        eprintln!("{text}");
    }

    fn end(&mut self) {
        if std::mem::take(&mut self.is_shown) {
            eprintln!();
        }
    }
}
