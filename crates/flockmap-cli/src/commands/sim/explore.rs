//! `flockmap sim explore`: a swarm that explores on its own, written as one record a robot.

use flockmap_cli::outputs;
use std::path::PathBuf;
use std::sync::Arc;

use clap::Args;
use flockmap::{Codec, SessionConfig};
use flockmap_autonomy::{Ended, ExploreOptions, Explorer};
use flockmap_cli::document::DataTable;
use flockmap_cli::numbers::{kb, thousands};
use flockmap_cli::options::{MapArgs, OF_RECORDS, SourceArgs, as_given, budget, delay_micros, share};
use flockmap_cli::parallel::cores;
use flockmap_cli::program::command_line;
use flockmap_cli::robot_record::{self, RecordFacts};
use flockmap_cli::{explore, json_file, sources, stop};
use flockmap_netsim::{IP_UDP_BYTES, Link, RadioConfig, Traffic};
use serde_json::{Value, json};

/// Let a swarm explore a world on its own until nothing is left to see, and write what each robot saw
#[derive(Args, Debug)]
#[command(
    after_help = "\
Examples:
  flockmap sim explore --scene forest --robots 2 --out explored
  flockmap sim explore --scene cubicle_office.pcd --robots 5 --lidar mid360 --out office --json office.json
  flockmap sim explore --scene indoor --robots 3 --loss 0.3 --delay-ms 100 --budget-kb-s 20
  flockmap sim explore --scene indoor --robots 3 --no-sync

Each robot looks for frontiers in its own fused map, which holds what came over the radio: a slow or lossy radio costs time, and without one
(--no-sync) everybody sees everything. Five robots had seen the indoor scene after 136 s: five minutes of work for two
cores, and 0.9 GB of files. The files are as those of `sim fly`, with pictures of the fused map.",
    mut_args(crate::commands::hidden::hide(&[&OF_RECORDS, &["see_team_mates", "seconds", "moving_obstacles"]]))
)]
pub struct SimExploreArgs {
    /// forest, indoor, or a world file (.bt .pcd .ply .las .laz)
    #[arg(long, value_name = "SCENE", default_value = "forest")]
    pub scene: PathBuf,
    /// Folder for the files robot1.mcap, robot2.mcap …
    #[arg(long, value_name = "DIR", default_value = "flockmap-exploration", value_parser = outputs::folder())]
    pub out: PathBuf,
    /// The exploration ends after so many seconds of flight at the latest
    #[arg(long, value_name = "S", default_value_t = 600.0)]
    pub seconds_max: f64,
    /// Share of datagrams that the radio loses, 0 to 1
    #[arg(long, value_name = "P", default_value_t = 0.0)]
    pub loss: f64,
    /// Delay of the radio in milliseconds
    #[arg(long, value_name = "D", default_value_t = 0.0)]
    pub delay_ms: f64,
    /// Most kilobytes (1,024 bytes) that a robot sends in a second, IP and UDP headers counted [default: 1,953]
    #[arg(long, value_name = "B")]
    pub budget_kb_s: Option<f64>,
    /// No radio: every robot has only what it sees itself
    #[arg(long, conflicts_with_all = ["loss", "delay_ms", "budget_kb_s"])]
    pub no_sync: bool,
    /// Codec of the packages: flock, paper, nested-zlib, raw or racer
    #[arg(long, value_name = "NAME", default_value_t = Codec::Flock)]
    pub codec: Codec,
    /// Leave out the pictures of map and track
    #[arg(long)]
    pub no_view: bool,
    /// Threads on which robots scan, map and plan; what happens never depends on it [default: as many as
    /// there are cores]
    #[arg(long, value_name = "N")]
    pub threads: Option<usize>,
    /// Write what the table shows as JSON
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub json: Option<PathBuf>,
    #[command(flatten)]
    pub map: MapArgs,
    #[command(flatten)]
    pub source: SourceArgs,
}

/// Runs the command.
pub fn run(args: &SimExploreArgs) -> anyhow::Result<bool> {
    sources::check_scene(&args.scene)?;
    let options = options(args)?;
    eprintln!("making the world ...");
    let world = Arc::new(sources::open_world(&args.scene, &args.source)?);
    let Some(mut explorer) = explore::prepare(world, options)? else { return Ok(true) };
    let records = explore::record(&mut explorer, &args.out, !args.no_view, "exploring: seconds")?;
    robot_record::print_table(&records);
    print_outcome(&explorer, args);
    json_file::write_asked(args.json.as_deref(), &facts(&explorer, args, &records))?;
    Ok(true)
}

fn options(args: &SimExploreArgs) -> anyhow::Result<ExploreOptions> {
    let SimExploreArgs { map, source, .. } = args;
    let mut session = SessionConfig::default();
    session.radio_bytes_per_s = args.budget_kb_s.map(budget).transpose()?.or(session.radio_bytes_per_s);
    let link = Link {
        loss: if args.no_sync { 1.0 } else { share("--loss", args.loss)? },
        delay_micros: delay_micros("--delay-ms", args.delay_ms)?,
        ..Link::default()
    };
    let mut limits = ExploreOptions::default().limits;
    limits.speed_m_s = source.speed.unwrap_or(limits.speed_m_s);
    let options = ExploreOptions {
        robots: source.robots,
        seed: source.seed,
        resolution: map.resolution()?,
        range_m: map.range()?,
        lidar: source.lidar,
        scan: sources::scan_options(source, map.range)?,
        seconds_max: args.seconds_max,
        limits,
        radio: RadioConfig { link, ..RadioConfig::default() },
        batch: map.batch()?,
        codec: args.codec,
        session,
        threads: args.threads.unwrap_or_else(|| cores().min(64)),
        ..ExploreOptions::default()
    };
    options.check().map_err(as_given)?;
    Ok(options)
}

/// What robots sent over the radio; nothing if there was none.
fn sent(explorer: &Explorer, args: &SimExploreArgs) -> Vec<Traffic> {
    let of = |robot: &flockmap::Robot| explorer.radio().traffic(robot.own_stream().origin);
    explorer.robots().map(|robot| if args.no_sync { Traffic::default() } else { of(robot) }).collect()
}

fn print_outcome(explorer: &Explorer, args: &SimExploreArgs) {
    let outcome = explorer.outcome();
    let seconds = outcome.seconds.max(0.1);
    let robots: Vec<_> = outcome.path_m.iter().zip(sent(explorer, args)).zip(1..).collect();
    let table = DataTable::of_text(
        &robots,
        &[
            ("robot", &|(_, number)| format!("robot{number}")),
            ("metres", &|((path_m, _), _)| format!("{path_m:.1}")),
            ("sent KB", &|((_, traffic), _)| kb(traffic.sent_bytes as f64)),
            ("KB/s", &|((_, traffic), _)| kb(traffic.sent_bytes as f64 / seconds)),
            ("datagrams", &|((_, traffic), _)| thousands(traffic.sent)),
        ],
    );
    print!("\n{table}");
    let ended = match outcome.ended {
        _ if stop::requested() => "ended by Ctrl-C",
        Ended::Done => "nothing is left to see",
        Ended::TimeOut => "the time was over",
    };
    println!(
        "\n  {:.1} s: {ended}; {:.2} % of {} voxels that can be seen were seen, each by {:.2} robots",
        outcome.seconds,
        outcome.seen_share * 100.0,
        thousands(outcome.seeable_voxels),
        outcome.overlap,
    );
}

fn facts(explorer: &Explorer, args: &SimExploreArgs, records: &[RecordFacts]) -> Value {
    let outcome = explorer.outcome();
    let traffic = sent(explorer, args);
    let datagrams: u64 = traffic.iter().map(|t| t.sent).sum();
    json!({
        "command": command_line(),
        "seed": args.source.seed,
        "sync": !args.no_sync,
        "loss": args.loss,
        "delay_ms": args.delay_ms,
        "budget_kb_s": args.budget_kb_s,
        "ended": if stop::requested() { "interrupted" } else { match outcome.ended { Ended::Done => "done", Ended::TimeOut => "time-out" } },
        "seconds": outcome.seconds,
        "seen_share": outcome.seen_share,
        "seeable_voxels": outcome.seeable_voxels,
        "overlap": outcome.overlap,
        "path_m": outcome.path_m,
        "total_bytes": traffic.iter().map(|t| t.sent_bytes).sum::<u64>(),
        "ip_udp_bytes": datagrams * IP_UDP_BYTES as u64,
        "datagrams": datagrams,
        "sent_bytes": traffic.iter().map(|t| t.sent_bytes).collect::<Vec<_>>(),
        "robots": records,
    })
}
