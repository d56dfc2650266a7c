//! `flockmap-bench application`: a leader that looks backwards crosses a thicket on its follower's map (the
//! paper's Sec. V-B), over seeds and radios.

use flockmap_cli::outputs;
use std::path::PathBuf;

use anyhow::{Context, ensure};
use clap::Args;
use flockmap::Resolution;
use flockmap::codec::Codec;
use flockmap_autonomy::application::{
    self, ApplicationOptions, ApplicationOutcome, Course, Ending, MapSync, RobotTraffic, Series,
    SeriesOptions,
};
use flockmap_cli::document::DataTable;
use flockmap_cli::measure::KB;
use flockmap_cli::options::milliseconds;
use flockmap_cli::program::command_line;
use flockmap_cli::progress::Progress;
use flockmap_cli::{json_file, stop};
use serde::Serialize;
use serde_json::{Value, json};

use crate::paper::figures::TABLE_THREE;

/// A leader that looks backwards crosses a thicket on its follower's map: the paper's Sec. V-B
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap-bench application --quick
  flockmap-bench application --seeds 20 --json application.json
  flockmap-bench application --rates 2,10 --losses 0 --obstacles-first 2

Every seed is a thicket of its own, flown without sync, with sync over a radio without limit, and with each budget and loss. Who
touches what is judged in the world as it is. The same command gives the same flights every time.")]
pub struct ApplicationArgs {
    /// Courses, each flown once with every radio [default: 20; with --quick 4]
    #[arg(long, value_name = "N")]
    pub seeds: Option<u64>,
    /// Four seeds, budgets of 5 and 25 KB/s, losses of 0 and 40 %
    #[arg(long)]
    pub quick: bool,
    /// Budgets of a robot in KB/s, separated by commas; 28 bytes of IP and UDP count for each datagram
    /// [default: 1,5,25,100]
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub rates: Vec<f64>,
    /// Shares of datagrams that the radio loses, separated by commas [default: 0,0.2,0.4]
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub losses: Vec<f64>,
    /// Budgets in KB/s of further series in which obstacles go out after --publish-period and free space
    /// after 2 s, separated by commas; 0 for none [default: 1,5; with --quick 5]
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub obstacles_first: Vec<f64>,
    /// Delay of the radio in milliseconds
    #[arg(long, value_name = "D", default_value_t = 20)]
    pub delay_ms: u32,
    /// Side of a voxel in metres
    #[arg(long, value_name = "M", default_value_t = 0.1)]
    pub resolution: f64,
    /// A batch of mapping is sent after so many seconds
    #[arg(long, value_name = "S", default_value_t = 0.2)]
    pub publish_period: f64,
    /// Codec of the packages
    #[arg(long, value_name = "NAME", default_value_t = Codec::Paper)]
    pub codec: Codec,
    /// Highest speed in m/s
    #[arg(long, value_name = "M_S", default_value_t = 1.5)]
    pub speed: f64,
    /// Threads that fly at once; no result depends on it
    #[arg(long, value_name = "N", default_value_t = 2)]
    pub threads: usize,
    /// Write the table and every flight as JSON
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub json: Option<PathBuf>,
}

/// All flights with one radio.
#[derive(Serialize, Clone, Debug)]
pub struct Row {
    /// What the radio does.
    pub name: String,
    /// `None`: no limit, or no sync.
    pub rate_kb_s: Option<f64>,
    /// `None`: no sync.
    pub loss: Option<f64>,
    /// Obstacles go out after the publish period, free space after 2 s.
    pub obstacles_first: bool,
    pub flights: usize,
    pub successes: usize,
    pub leader_hits: usize,
    pub follower_hits: usize,
    pub robots_touched: usize,
    pub time_outs: usize,
    /// Of the flights that reached the goal; `None` if none did.
    pub seconds: Option<f64>,
    /// How far the leader flew towards the goal: mean over all flights, in metres.
    pub leader_path_m: f64,
    /// Payload that the leader sent a second, mean over all flights; IP and UDP headers not counted, here and
    /// below.
    pub leader_sent_kb_s: f64,
    pub leader_received_kb_s: f64,
    /// Most in any second of any flight.
    pub leader_sent_kb_s_max: f64,
    pub leader_received_kb_s_max: f64,
    pub follower_sent_kb_s: f64,
    /// Age of obstacles when they come into the leader's map: means of the flights' medians and of their 99 %
    /// values.
    pub obstacle_age_median_s: Option<f64>,
    pub obstacle_age_p99_s: Option<f64>,
    /// Every flight, by seed from 1 on.
    pub outcomes: Vec<Value>,
}

#[derive(Serialize)]
struct Output<'a> {
    command: String,
    seeds: u64,
    resolution_m: f64,
    publish_period_s: f64,
    codec: String,
    speed_m_s: f64,
    delay_ms: u32,
    rows: &'a [Row],
}

/// Runs the command.
pub fn run(args: &ApplicationArgs) -> anyhow::Result<bool> {
    let options = options(args)?;
    let rows = measure(&options)?;
    println!(
        "Two robots cross a thicket of 30 m, the leader's LiDAR faces backwards; {} seeds, {} m voxels, publish period {} s, {} m/s\n",
        options.seeds, args.resolution, args.publish_period, args.speed
    );
    print!("{}", table(&rows));
    println!("\n{NOTES}");
    let [(_, tx, tx_max), (_, rx, rx_max)] = TABLE_THREE;
    println!(
        "  The paper's robot 1 in a real forest (Table III), KB/s: TX average {tx}, RX average {rx}, TX max {tx_max}, RX max {rx_max}."
    );
    let output = Output {
        command: command_line(),
        seeds: options.seeds,
        resolution_m: args.resolution,
        publish_period_s: args.publish_period,
        codec: args.codec.to_string(),
        speed_m_s: args.speed,
        delay_ms: args.delay_ms,
        rows: &rows,
    };
    json_file::write_asked(args.json.as_deref(), &output)?;
    Ok(true)
}

/// What the table means.
pub const NOTES: &str = "  \
  Success: the leader is at the goal and neither robot came within 0.2 m of anything solid, or within 0.4 m of the other, in the world
  as it is. KB of 1,024 bytes of UDP payload, mean over flights; max is the largest second of any flight. Age: from the scan that saw
  an obstacle to its presence in the leader's map. Obstacles first: free space waits for 2 s. Poses and the leader's next 2 m of path are taken as shared; their bytes are not counted.";

/// Which flights the command line asks for.
fn options(args: &ApplicationArgs) -> anyhow::Result<SeriesOptions> {
    let seeds = args.seeds.unwrap_or(if args.quick { 4 } else { 20 });
    ensure!((1..=10_000).contains(&seeds), "--seeds is {seeds}, expected 1 to 10,000");
    ensure!((1..=256).contains(&args.threads), "--threads is {}, expected 1 to 256", args.threads);
    ensure!(
        args.speed > 0.0 && args.speed <= 10.0,
        "--speed is {}, expected more than 0 and at most 10",
        args.speed
    );
    ensure!(args.delay_ms <= 60_000, "--delay-ms is {}, expected at most 60,000", args.delay_ms);
    let or_else = |given: &[f64], quick: &[f64], all: &[f64]| match given {
        [] if args.quick => quick.to_vec(),
        [] => all.to_vec(),
        given => given.to_vec(),
    };
    let rates = or_else(&args.rates, &[5.0, 25.0], &[1.0, 5.0, 25.0, 100.0]);
    let losses = or_else(&args.losses, &[0.0, 0.4], &[0.0, 0.2, 0.4]);
    let mut obstacles_first = or_else(&args.obstacles_first, &[5.0], &[1.0, 5.0]);
    if obstacles_first == [0.0] {
        obstacles_first.clear();
    }
    for rate in rates.iter().chain(&obstacles_first) {
        ensure!(
            (0.5..=100_000.0).contains(rate),
            "--rates or --obstacles-first has {rate}, expected 0.5 to 100,000 KB/s"
        );
    }
    for loss in &losses {
        ensure!((0.0..=1.0).contains(loss), "--losses has {loss}, expected 0 to 1");
    }
    let resolution = Resolution::from_metres(args.resolution)
        .filter(|_| (0.05..=0.2).contains(&args.resolution))
        .with_context(|| format!("--resolution is {}, expected 0.05 to 0.2 m", args.resolution))?;
    let bytes = |rates: &[f64]| rates.iter().map(|rate| (rate * KB).round() as u32).collect();
    Ok(SeriesOptions {
        seeds,
        rates_bytes_per_s: bytes(&rates),
        losses,
        obstacles_first_rates_bytes_per_s: bytes(&obstacles_first),
        delay_ms: args.delay_ms,
        threads: args.threads,
        application: ApplicationOptions {
            resolution,
            publish_period_ms: milliseconds("--publish-period", args.publish_period)?,
            codec: args.codec,
            speed_m_s: args.speed,
            ..ApplicationOptions::default()
        },
    })
}

/// Flies all flights, with progress shown. Ctrl-C ends it with the flights made so far.
pub fn measure(options: &SeriesOptions) -> anyhow::Result<Vec<Row>> {
    for seed in 1..=options.seeds {
        ensure!(Course::thicket(seed).is_passable(), "nothing passes through the thicket of seed {seed}");
    }
    let progress = Progress::new("flights", options.flights());
    let flown = || {
        progress.step();
        !stop::requested()
    };
    Ok(application::series(options, flown)?.iter().map(Row::new).collect())
}

impl Row {
    fn new(series: &Series) -> Self {
        let (mut name, rate_kb_s, loss) = match series.sync {
            MapSync::None => ("no sync".to_owned(), None, None),
            MapSync::Radio { rate_bytes_per_s: None, loss, .. } => {
                (format!("no limit, loss {:.0} %", loss * 100.0), None, Some(loss))
            }
            MapSync::Radio { rate_bytes_per_s: Some(rate), loss, .. } => {
                let rate = f64::from(rate) / KB;
                (format!("{rate} KB/s, loss {:.0} %", loss * 100.0), Some(rate), Some(loss))
            }
        };
        if series.obstacles_first {
            name += ", obstacles first";
        }
        let kb_s = |bytes: fn(&ApplicationOutcome) -> u64| {
            series.mean(|outcome| bytes(outcome) as f64 / KB / outcome.seconds.max(0.1))
        };
        let largest = |bytes: fn(&RobotTraffic) -> u64| {
            series.outcomes.iter().map(|outcome| bytes(&outcome.leader)).max().unwrap_or(0) as f64 / KB
        };
        let heard = series.outcomes.iter().any(|outcome| outcome.obstacle_age_p99_s > 0.0);
        let successes = series.count(Ending::Goal);
        Self {
            name,
            rate_kb_s,
            loss,
            obstacles_first: series.obstacles_first,
            flights: series.outcomes.len(),
            successes,
            leader_hits: series.count(Ending::LeaderHit),
            follower_hits: series.count(Ending::FollowerHit),
            robots_touched: series.count(Ending::RobotsTouched),
            time_outs: series.count(Ending::TimeOut),
            seconds: (successes > 0).then(|| series.mean_of_successes(|outcome| outcome.seconds)),
            leader_path_m: series.mean(|outcome| outcome.leader_path_m),
            leader_sent_kb_s: kb_s(|outcome| outcome.leader.sent_bytes),
            leader_received_kb_s: kb_s(|outcome| outcome.leader.received_bytes),
            leader_sent_kb_s_max: largest(|traffic| traffic.sent_bytes_per_s_max),
            leader_received_kb_s_max: largest(|traffic| traffic.received_bytes_per_s_max),
            follower_sent_kb_s: kb_s(|outcome| outcome.follower.sent_bytes),
            obstacle_age_median_s: heard.then(|| series.mean(|outcome| outcome.obstacle_age_median_s)),
            obstacle_age_p99_s: heard.then(|| series.mean(|outcome| outcome.obstacle_age_p99_s)),
            outcomes: series.outcomes.iter().map(flight).collect(),
        }
    }
}

/// One flight.
fn flight(outcome: &ApplicationOutcome) -> Value {
    json!({
        "ending": match outcome.ending {
            Ending::Goal => "goal",
            Ending::LeaderHit => "leader-hit",
            Ending::FollowerHit => "follower-hit",
            Ending::RobotsTouched => "robots-touched",
            Ending::TimeOut => "time-out",
        },
        "seconds": outcome.seconds,
        "leader_at_m": outcome.leader_at,
        "leader_path_m": outcome.leader_path_m,
        "leader_sent_bytes": outcome.leader.sent_bytes,
        "leader_sent_datagrams": outcome.leader.sent_datagrams,
        "follower_sent_bytes": outcome.follower.sent_bytes,
        "follower_sent_datagrams": outcome.follower.sent_datagrams,
        "obstacle_age_median_s": outcome.obstacle_age_median_s,
        "obstacle_age_p99_s": outcome.obstacle_age_p99_s,
    })
}

fn table(rows: &[Row]) -> DataTable {
    let optional =
        |value: Option<f64>, digits: usize| value.map_or_else(|| "–".to_owned(), |v| format!("{v:.digits$}"));
    DataTable::of_text(
        rows,
        &[
            ("sync", &|row| row.name.clone()),
            ("success", &|row| format!("{}/{}", row.successes, row.flights)),
            ("leader hit", &|row| row.leader_hits.to_string()),
            ("follower hit", &|row| row.follower_hits.to_string()),
            ("touched", &|row| row.robots_touched.to_string()),
            ("time-out", &|row| row.time_outs.to_string()),
            ("seconds", &|row| optional(row.seconds, 1)),
            ("path m", &|row| format!("{:.1}", row.leader_path_m)),
            ("TX KB/s", &|row| format!("{:.1}", row.leader_sent_kb_s)),
            ("RX KB/s", &|row| format!("{:.1}", row.leader_received_kb_s)),
            ("TX max", &|row| format!("{:.1}", row.leader_sent_kb_s_max)),
            ("RX max", &|row| format!("{:.1}", row.leader_received_kb_s_max)),
            ("age s", &|row| optional(row.obstacle_age_median_s, 2)),
            ("99 % s", &|row| optional(row.obstacle_age_p99_s, 2)),
        ],
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_counts_every_flight_once() {
        let quick = SeriesOptions {
            seeds: 1,
            rates_bytes_per_s: vec![5 * 1024],
            losses: vec![0.2],
            obstacles_first_rates_bytes_per_s: vec![5 * 1024],
            application: ApplicationOptions { seconds_max: 0.3, ..ApplicationOptions::default() },
            ..SeriesOptions::default()
        };
        let rows = measure(&quick).unwrap();
        let names: Vec<&str> = rows.iter().map(|row| row.name.as_str()).collect();
        assert_eq!(
            names,
            ["no sync", "no limit, loss 0 %", "5 KB/s, loss 20 %", "5 KB/s, loss 20 %, obstacles first",]
        );
        for row in &rows {
            let all =
                row.successes + row.leader_hits + row.follower_hits + row.robots_touched + row.time_outs;
            assert_eq!((all, row.flights, row.time_outs), (1, 1, 1));
        }
        assert!(table(&rows).to_string().contains("5 KB/s, loss 20 %"));
    }
}
