//! `flockmap sim swarm`: the sync protocol in virtual time under everything that a seed can do.

use flockmap_cli::outputs;
use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use clap::{Args, Parser};
use flockmap::Cast;
use flockmap_cli::document::DataTable;
use flockmap_cli::json_file;
use flockmap_cli::numbers::thousands;
use flockmap_cli::options::named;
use flockmap_cli::parallel::{cores, in_parallel};
use flockmap_cli::program::command_line;
use flockmap_cli::progress::Progress;
use flockmap_netsim::swarm::{BUDGET_MIN, Report, SwarmOptions, describe, fly};
use serde_json::{Value, json};

/// Fly the sync protocol of a whole swarm in virtual time, under everything that a seed can do, with checkers
/// at every event
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap sim swarm --seed 7
  flockmap sim swarm --seed 1 --seeds 10000
  flockmap sim swarm --seed 3 --robots 5 --radio wifi_lossy --seconds 20 --cast broadcast
  flockmap sim swarm --file tests/seeds/once-failed.txt

One seed decides everything: number of robots, who hears whom, loss, bursts, delay, reordering, duplication, flipped bits, rates and queues,
partitions, half-open links, clocks (also such that step, repeat and rewind), crashes, restarts by the hundred, disks that fail, keys and an outsider,
faulty senders, budgets, limits. What was drawn is printed before the first event. An option takes the place of what would be drawn.
Each robot is a real one, with a mapper, codec, session and fused map, in a small world. Mapping ends, links heal, and then all must agree.

Checkers: voxel (a layer holds only what its origin reported), layer (nothing older than what is held), packed (packages say what a batch
changed), fused (the fused map follows from the layers), memory, in_flight (stated limits), twice (nothing twice within a round trip),
budget (bytes of any second), quiet (nothing but requests when nothing is missing), agreement (equal maps in time), still (time goes on),
nonce and key (sealed datagrams), identity (no run twice), path (an address is used after it has answered), work (what a datagram can cost),
crash (no panic). A failure names the checker, the robot, the time, and the one command that repeats it; the exit code is 1 then.")]
pub struct SimSwarmArgs {
    /// Decides everything that is random
    #[arg(long, value_name = "S", default_value_t = 1)]
    pub seed: u64,
    /// Fly so many seeds, from --seed on, and sum up
    #[arg(long, value_name = "N")]
    pub seeds: Option<u64>,
    /// Fly what a file says: options of this command on each line, what follows a # is for people
    #[arg(long, value_name = "FILE", conflicts_with_all = ["seed", "seeds", "robots", "radio", "seconds", "cast", "budget", "calm", "json"])]
    pub file: Option<PathBuf>,
    /// Robots, 2 to 200 [default: drawn, 2 to 6]
    #[arg(long, value_name = "N")]
    pub robots: Option<usize>,
    /// lan, wifi, wifi_lossy, wifi_congested, mesh_line, intermittent or lora [default: drawn]
    #[arg(long, value_name = "PRESET")]
    pub radio: Option<flockmap_netsim::swarm::RadioPreset>,
    /// Seconds of mapping before links heal [default: drawn, 2 to 8]
    #[arg(long, value_name = "T")]
    pub seconds: Option<f64>,
    /// unicast: to each peer on its own; broadcast: to all at once [default: drawn]
    #[arg(long, value_name = "CAST", value_parser = named::<Cast>)]
    pub cast: Option<Cast>,
    /// Bytes that each robot may send in a second, 20 or more [default: drawn]
    #[arg(long, value_name = "BYTES_PER_S")]
    pub budget: Option<u32>,
    /// No crashes, partitions, half-open links, tight limits or mixed settings: only the radio
    #[arg(long)]
    pub calm: bool,
    /// Threads that fly several seeds; what happens never depends on it [default: as many as there are cores]
    #[arg(long, value_name = "N")]
    pub threads: Option<usize>,
    /// Write what the table shows as JSON
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub json: Option<PathBuf>,
}

/// Of many seeds, failures shown in full.
const FAILURES_SHOWN: usize = 5;

/// A line of a file of flights.
#[derive(Parser, Debug)]
#[command(no_binary_name = true)]
struct Line {
    #[command(flatten)]
    args: SimSwarmArgs,
}

/// Runs the command. False if a checker found something.
pub fn run(args: &SimSwarmArgs) -> anyhow::Result<bool> {
    match &args.file {
        None => run_line(args),
        Some(path) => from_file(path, args.threads),
    }
}

fn run_line(args: &SimSwarmArgs) -> anyhow::Result<bool> {
    ensure!(args.robots.is_none_or(|n| (2..=200).contains(&n)), "--robots must be 2 to 200");
    let seconds_fit = args.seconds.is_none_or(|s| (0.1..=3_600.0).contains(&s));
    ensure!(seconds_fit, "--seconds must be 0.1 to 3,600");
    ensure!(args.threads.is_none_or(|n| (1..=1_000).contains(&n)), "--threads must be 1 to 1,000");
    ensure!(args.budget.is_none_or(|n| n >= BUDGET_MIN), "--budget must be {BUDGET_MIN} or more");
    ensure!(args.seeds.is_none_or(|n| n > 0), "--seeds must be 1 or more");
    match args.seeds {
        None => one(args),
        Some(seeds) => many(args, seeds),
    }
}

fn options(args: &SimSwarmArgs, seed: u64) -> SwarmOptions {
    SwarmOptions {
        robots: args.robots,
        radio: args.radio,
        seconds: args.seconds,
        cast: args.cast,
        budget_bytes_per_s: args.budget,
        is_calm: args.calm,
        ..SwarmOptions::new(seed)
    }
}

/// Flies the flights of a file. Every line is read before the first one is flown.
fn from_file(path: &Path, threads: Option<usize>) -> anyhow::Result<bool> {
    let text = std::fs::read_to_string(path).with_context(|| format!("{} cannot be read", path.display()))?;
    let mut flights = Vec::new();
    for (number, line) in (1..).zip(text.lines()) {
        let place = || format!("{}, line {number}", path.display());
        let options = line.split('#').next().unwrap_or("").trim();
        if options.is_empty() {
            continue;
        }
        let Line { args } = Line::try_parse_from(options.split_whitespace()).with_context(place)?;
        ensure!(args.file.is_none(), "{}: a file of flights names no other", place());
        let args = SimSwarmArgs { threads: args.threads.or(threads), ..args };
        flights.push((args, line.to_owned()));
    }
    let mut failed = Vec::new();
    for (args, line) in &flights {
        let is_good = match args.seeds {
            Some(_) => run_line(args)?,
            None => quietly(args),
        };
        if !is_good {
            failed.push(line.as_str());
        }
    }
    for line in &failed {
        println!("  failed: {line}");
    }
    println!("  {} of {} lines failed", failed.len(), flights.len());
    Ok(failed.is_empty())
}

/// Flies one, and says of it only what is wrong. What was drawn stands before that, whatever becomes of the
/// flight.
fn quietly(args: &SimSwarmArgs) -> bool {
    let options = options(args, args.seed);
    println!("{}", options.command());
    let _ = std::io::stdout().flush();
    let report = fly(&options);
    print!("{}", failed(&report));
    report.is_good()
}

fn one(args: &SimSwarmArgs) -> anyhow::Result<bool> {
    let options = options(args, args.seed);
    println!("{}\n", options.command());
    describe(&options).iter().for_each(|line| println!("  {line}"));
    // It is there even where the flight never ends.
    let _ = std::io::stdout().flush();
    let report = fly(&options);
    print!("{}", account(&report));
    json_file::write_asked(args.json.as_deref(), &one_as_json(&report))?;
    Ok(report.is_good())
}

/// What of many flights is kept.
#[derive(Default)]
struct Sum {
    flights: u64,
    agreement_s: Vec<f64>,
    robots: u64,
    steps: u64,
    flown_s: f64,
    seen: BTreeMap<&'static str, (u64, u64)>,
    failures: Vec<(u64, Report)>,
}

impl Sum {
    fn add(&mut self, seed: u64, report: Report) {
        self.flights += 1;
        self.agreement_s.extend(report.agreement_s);
        self.robots += report.robots.len() as u64;
        self.steps += report.steps;
        self.flown_s += report.flown_s;
        for (name, count) in &report.seen {
            let (flights, all) = self.seen.entry(name).or_default();
            *flights += u64::from(*count > 0);
            *all += count;
        }
        if !report.is_good() {
            self.failures.push((seed, report));
        }
    }
}

fn many(args: &SimSwarmArgs, seeds: u64) -> anyhow::Result<bool> {
    let threads = args.threads.unwrap_or_else(cores).min(seeds as usize);
    let sum = Mutex::new(Sum::default());
    let began = Instant::now();
    let progress = Progress::new("flights", seeds);
    in_parallel(threads, 0..seeds, |number| {
        let seed = args.seed.wrapping_add(number);
        let report = fly(&options(args, seed));
        sum.lock().unwrap_or_else(PoisonError::into_inner).add(seed, report);
        progress.step();
    });
    drop(progress);
    let mut sum = sum.into_inner().unwrap_or_else(PoisonError::into_inner);
    sum.failures.sort_by_key(|(seed, _)| *seed);
    print!("{}", summary(&mut sum, began.elapsed(), threads));
    json_file::write_asked(args.json.as_deref(), &many_as_json(args, &sum))?;
    Ok(sum.failures.is_empty())
}

fn account(report: &Report) -> String {
    let mut text = "\n".to_owned();
    for (at, what) in &report.events {
        text += &format!("  {at:>9.3} s  {what}\n");
    }
    let table = DataTable::of_text(
        &report.robots,
        &[
            ("robot", &|r| format!("{}{}", r.id, if r.is_alive { "" } else { " (gone)" })),
            ("runs", &|r| r.runs.to_string()),
            ("packages", &|r| thousands(r.packages)),
            ("their bytes", &|r| thousands(r.package_bytes)),
            ("sent bytes", &|r| thousands(r.bytes)),
            ("requests", &|r| thousands(r.requests)),
            ("their bytes", &|r| thousands(r.request_bytes)),
            ("air s", &|r| format!("{:.3}", r.airtime_s)),
            ("merged", &|r| thousands(r.merged)),
            ("age 50 % s", &|r| format!("{:.3}", r.age_median_s)),
            ("99 % s", &|r| format!("{:.3}", r.age_99_s)),
        ],
    );
    text += &format!("\n{table}\n");
    let seen = report.seen.iter().filter(|(_, count)| **count > 0);
    let seen: Vec<String> = seen.map(|(name, count)| format!("{name} {}", thousands(*count))).collect();
    text += &format!("  seen: {}\n\n", seen.join(", "));
    if let (None, Some(agreement)) = (&report.failure, report.agreement_s) {
        text += &format!(
            "  all maps equal {agreement:.2} s after links healed (within {:.1} s), then quiet; {:.1} s of virtual time\n",
            report.agreement_within_s, report.flown_s
        );
    }
    text + &failed(report)
}

/// What a checker found, and how to see it again.
fn failed(report: &Report) -> String {
    let again = &report.command;
    let failure = report.failure.as_ref();
    failure.map_or_else(String::new, |failure| format!("FAILED: {failure}\n  again:    {again}\n"))
}

fn summary(sum: &mut Sum, took: Duration, threads: usize) -> String {
    let mut text = String::new();
    let seen = sum.seen.iter();
    let seen = seen.map(|(name, (flights, all))| [(*name).to_owned(), thousands(*flights), thousands(*all)]);
    text += &format!("{}\n", DataTable::unnamed(["seen", "in flights", "in all"], seen));
    sum.failures.iter().take(FAILURES_SHOWN).for_each(|(_, report)| text += &failed(report));
    let mut by_checker = BTreeMap::<&str, Vec<u64>>::new();
    for (seed, report) in &sum.failures {
        by_checker.entry(report.failure.as_ref().map_or("", |f| f.checker)).or_default().push(*seed);
    }
    for (checker, seeds) in &by_checker {
        let first: Vec<String> = seeds.iter().take(12).map(u64::to_string).collect();
        let more = if seeds.len() > first.len() { " …" } else { "" };
        text += &format!("  checker {checker}: {} flights, seeds {}{more}\n", seeds.len(), first.join(" "));
    }
    sum.agreement_s.sort_by(f64::total_cmp);
    let at = |share: f64| {
        let last = sum.agreement_s.len().saturating_sub(1) as f64;
        sum.agreement_s.get((last * share).round() as usize).copied().unwrap_or(0.0)
    };
    text += &format!(
        "  {} flights of {} robots, {} inputs, {:.0} s of virtual time in {:.1} s on {threads} threads\n",
        thousands(sum.flights),
        thousands(sum.robots),
        thousands(sum.steps),
        sum.flown_s,
        took.as_secs_f64()
    );
    text += &format!(
        "  agreement after links healed: median {:.2} s, 99 % {:.2} s, longest {:.2} s\n",
        at(0.5),
        at(0.99),
        at(1.0)
    );
    text += &format!("  {} of {} flights failed\n", sum.failures.len(), thousands(sum.flights));
    text
}

fn one_as_json(report: &Report) -> Value {
    let robots = report.robots.iter().map(|robot| {
        json!({
            "robot": robot.id, "runs": robot.runs, "alive": robot.is_alive, "packages": robot.packages,
            "package_bytes": robot.package_bytes, "datagrams": robot.datagrams, "bytes": robot.bytes,
            "requests": robot.requests, "request_bytes": robot.request_bytes, "airtime_s": robot.airtime_s,
            "merged": robot.merged, "age_median_s": robot.age_median_s, "age_99_s": robot.age_99_s,
        })
    });
    let events = report.events.iter().map(|(at, what)| json!({"at_s": at, "what": what}));
    json!({
        "command": report.command, "settings": report.settings, "events": events.collect::<Value>(),
        "robots": robots.collect::<Value>(), "mapping_s": report.mapping_s, "agreement_s": report.agreement_s,
        "agreement_within_s": report.agreement_within_s, "seen": report.seen, "flown_s": report.flown_s,
        "steps": report.steps, "failure": report.failure.as_ref().map(ToString::to_string),
    })
}

fn many_as_json(args: &SimSwarmArgs, sum: &Sum) -> Value {
    let failures = sum.failures.iter().map(|(seed, report)| {
        let failure = report.failure.as_ref().map(ToString::to_string);
        json!({"seed": seed, "command": report.command, "failure": failure})
    });
    let seen = sum.seen.iter();
    let seen = seen.map(|(name, (flights, all))| (*name, json!({"flights": flights, "all": all})));
    json!({
        "command": command_line(), "seed": args.seed, "flights": sum.flights, "robots": sum.robots,
        "steps": sum.steps, "flown_s": sum.flown_s, "agreement_s": sum.agreement_s,
        "seen": seen.collect::<BTreeMap<_, _>>(), "failures": failures.collect::<Value>(),
    })
}
