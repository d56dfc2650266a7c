//! `flockmap plan-radio`: which radio carries how many robots of which kind.

mod kinds;
mod words;

use std::path::PathBuf;

use anyhow::{Context, ensure};
use clap::{ArgGroup, Args};
use flockmap_cli::radio_plan::{Plan, Question, Radio, RobotKind, Scene};
use flockmap_cli::{json_file, options, outputs};
use flockmap_netsim::swarm::RadioPreset;

/// Options that the table of several kinds has no use for.
const OF_ONE_PLAN: [&str; 9] = [
    "robots",
    "resolution",
    "range",
    "period",
    "obstacle_period",
    "scene",
    "map_bytes_per_s",
    "unicast",
    "json",
];

/// Which radio carries how many robots of which kind: its load, whether it fits, and what to change if not
#[derive(Args, Debug)]
#[command(group(ArgGroup::new("which").required(true).args(["radio", "rate_kb_s", "table"])), after_help = "\
Examples:
  flockmap plan-radio --radio lora --robots 10 --resolution 0.2 --range 7 --period 1
  flockmap plan-radio --radio wifi --robots 20 --resolution 0.1 --range 30 --obstacle-period 0.1
  flockmap plan-radio --rate-kb-s 6.25 --loss 0.05 --airtime-overhead-ms 10 --robots 4 --resolution 0.4
  flockmap plan-radio --radio wifi_congested --robots 5 --map-bytes-per-s 4000
  flockmap plan-radio --table                         several kinds of robots on all shared radios

What a robot maps was measured in generated worlds, between which it is interpolated; a figure of your own is better:
`flockmap replay YOUR_RECORD --cast broadcast --json replay.json`, own_package_bytes over record_s. What a swarm adds
to that is in tests/tables/swarms.txt. docs/radios.md says how true it is. Exit code 1 if the radio does not carry the
robots.")]
pub struct PlanRadioArgs {
    /// lan, wifi, wifi_lossy, wifi_congested, mesh_line, intermittent or lora (the radios of `sim table`)
    #[arg(long, value_name = "PRESET")]
    pub radio: Option<RadioPreset>,
    /// A radio of your own, which all robots share: kilobytes (1,024 bytes) that it carries in a second, IP and
    /// UDP headers counted
    #[arg(long, value_name = "B")]
    pub rate_kb_s: Option<f64>,
    /// Share of datagrams that it loses, 0 to 1
    #[arg(long, value_name = "P", default_value_t = 0.0, requires = "rate_kb_s", conflicts_with = "radio")]
    pub loss: f64,
    /// Time that each datagram takes on the air beside its bytes, in milliseconds
    #[arg(long, value_name = "D", default_value_t = 0.0, requires = "rate_kb_s", conflicts_with = "radio")]
    pub airtime_overhead_ms: f64,
    /// Robots, 2 to 1,000
    #[arg(long, value_name = "N", required_unless_present = "table")]
    pub robots: Option<usize>,
    /// Side of a voxel in metres
    #[arg(long, value_name = "M", default_value_t = 0.1)]
    pub resolution: f64,
    /// Range of the sensor in metres
    #[arg(long, value_name = "M", default_value_t = 7.0)]
    pub range: f64,
    /// A batch of mapping is sent after so many seconds
    #[arg(long, value_name = "S", default_value_t = 0.5, visible_alias = "publish-period")]
    pub period: f64,
    /// Obstacles are sent after so many seconds, ahead of free space [default: with everything else]
    #[arg(long, value_name = "S")]
    pub obstacle_period: Option<f64>,
    /// World in which robots were measured: forest or indoor [default: the one that costs more]
    #[arg(long, value_name = "NAME")]
    pub scene: Option<Scene>,
    /// What the map of one robot takes, in bytes a second, if you know it
    #[arg(long, value_name = "B")]
    pub map_bytes_per_s: Option<f64>,
    /// Every datagram goes to each other robot on its own, in place of once to all
    #[arg(long)]
    pub unicast: bool,
    /// How many robots of several kinds each shared radio carries, as a table of Markdown
    #[arg(long, conflicts_with_all = OF_ONE_PLAN)]
    pub table: bool,
    /// Write what is printed as JSON
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub json: Option<PathBuf>,
}

/// Runs the command. Whether the radio carries the robots.
pub fn run(args: &PlanRadioArgs) -> anyhow::Result<bool> {
    if args.table {
        print!("{}", kinds::table()?);
        return Ok(true);
    }
    let question = question(args)?;
    let plan = Plan::of(&question)?;
    let (most, changes) =
        (question.robots_most()?, if plan.fits() { Vec::new() } else { question.changes()? });
    print!("{}", words::text(&question, &plan, most, &changes)?);
    json_file::write_asked(args.json.as_deref(), &words::json(&question, &plan, most, &changes))?;
    Ok(plan.fits())
}

fn question(args: &PlanRadioArgs) -> anyhow::Result<Question> {
    let robots = args.robots.unwrap_or(0);
    ensure!(
        (2..=1_000).contains(&robots),
        "--robots is {robots}, expected 2 to 1,000: one alone has nobody to send to"
    );
    let radio = match (args.radio, args.rate_kb_s) {
        (Some(preset), _) => Radio::of_preset(preset),
        (None, rate) => {
            let rate = rate.context("--radio or --rate-kb-s says which radio")?;
            ensure!(
                (0.1..=4e6).contains(&rate),
                "--rate-kb-s is {rate}, expected 0.1 to 4,000,000 (kilobytes a second, not kilobits)"
            );
            let overhead = options::delay_micros("--airtime-overhead-ms", args.airtime_overhead_ms)?;
            let loss = options::share("--loss", args.loss)?;
            ensure!(loss < 1.0, "--loss is 1: a radio that loses everything carries no robots");
            Radio::of_figures(rate * 1024.0, loss, overhead as f64 / 1e6)
        }
    };
    let resolution_m = options::resolution("--resolution", args.resolution)?.metres();
    ensure!(
        args.range >= resolution_m && args.range <= 500.0 * resolution_m,
        "--range is {}, expected {resolution_m} to {} m (1 to 500 voxels)",
        args.range,
        500.0 * resolution_m
    );
    let seconds =
        |option: &str, value: f64| options::milliseconds(option, value).map(|ms| f64::from(ms) / 1e3);
    if let Some(bytes) = args.map_bytes_per_s {
        ensure!(
            (1.0..=1e9).contains(&bytes),
            "--map-bytes-per-s is {bytes}, expected 1 to 1,000,000,000 bytes a second"
        );
    }
    let kind = RobotKind {
        scene: args.scene,
        resolution_m,
        range_m: args.range,
        period_s: seconds("--period", args.period)?,
        obstacle_period_s: args
            .obstacle_period
            .map(|value| seconds("--obstacle-period", value))
            .transpose()?,
    };
    Ok(Question { radio, robots, kind, map_bytes_per_s: args.map_bytes_per_s, is_unicast: args.unicast })
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;
    use flockmap_cli::program;

    #[derive(Parser, Debug)]
    struct Line {
        #[command(flatten)]
        args: PlanRadioArgs,
    }

    fn asked(line: &str) -> anyhow::Result<Question> {
        let words = std::iter::once("plan-radio").chain(line.split_whitespace());
        question(&program::try_parse::<Line>(words)?.args)
    }

    fn said(line: &str) -> String {
        let question = asked(line).unwrap();
        let (plan, most) = (Plan::of(&question).unwrap(), question.robots_most().unwrap());
        let changes = question.changes().unwrap();
        // Lines are wrapped, sentences are compared.
        words::text(&question, &plan, most, &changes)
            .unwrap()
            .split_whitespace()
            .collect::<Vec<_>>()
            .join(" ")
    }

    #[test]
    fn it_says_whether_a_radio_carries_the_robots() {
        let good = said("--radio wifi --robots 5 --resolution 0.2 --range 7 --period 1");
        assert!(good.contains("It fits:") && good.contains("Ages to expect"), "{good}");
        assert!(!good.contains("What to change"), "{good}");
        let bad = said("--radio lora --robots 50 --resolution 0.1 --range 30");
        assert!(bad.contains("It does not fit:") && bad.contains("behind"), "{bad}");
        assert!(bad.contains("coarser voxels") && bad.contains("shorter range"), "{bad}");
        assert!(bad.contains("extrapolated"), "50 robots are more than the table has: {bad}");
    }

    #[test]
    fn it_says_where_its_figures_come_from() {
        let own = said("--rate-kb-s 6.25 --loss 0.05 --airtime-overhead-ms 10 --robots 2 --resolution 0.4");
        assert!(own.contains("most like lora"), "{own}");
        let lossy = said("--rate-kb-s 600 --loss 0.4 --robots 2 --resolution 0.4");
        assert!(lossy.contains("loses more"), "{lossy}");
        let fine = said("--radio wifi --robots 2 --resolution 0.05");
        assert!(fine.contains("Not measured: voxels of 0.05 m"), "{fine}");
        let given = said("--radio wifi --robots 2 --map-bytes-per-s 777");
        assert!(given.contains("777") && given.contains("your figure"), "{given}");
        let unicast = said("--radio wifi --robots 4 --unicast");
        assert!(unicast.contains("3 copies") && unicast.contains("by broadcast"), "{unicast}");
    }

    #[test]
    fn what_it_prints_for_programs_says_the_same() {
        let question = asked("--radio lora --robots 10 --resolution 0.1 --range 7").unwrap();
        let (plan, most) = (Plan::of(&question).unwrap(), question.robots_most().unwrap());
        let changes = question.changes().unwrap();
        let json = words::json(&question, &plan, most, &changes);
        assert_eq!(json["fits"], plan.fits());
        assert_eq!(json["load"], plan.load);
        assert_eq!(json["robots_most"], most);
        assert_eq!(json["changes"].as_array().unwrap().len(), changes.len());
    }

    #[test]
    fn nonsense_is_named() {
        let wrong = |line: &str, expected: &str| {
            let error = format!("{:#}", asked(line).unwrap_err());
            assert!(error.contains(expected), "{line}: {error}");
        };
        wrong("--radio lora --robots 0", "--robots is 0, expected 2 to 1,000");
        wrong("--radio lora --robots 1", "nobody to send to");
        wrong("--radio lora --robots -3", "--robots");
        wrong("--radio lara --robots 3", "wifi_congested");
        wrong("--robots 3", "--radio");
        wrong("--radio lora", "--robots");
        wrong("--radio lora --loss 0.1 --robots 3", "--loss");
        wrong("--rate-kb-s 0 --robots 3", "--rate-kb-s is 0");
        wrong("--rate-kb-s 5 --loss 1 --robots 3", "--loss is 1");
        wrong("--rate-kb-s 5 --loss 20 --robots 3", "--loss is 20");
        wrong("--radio lora --robots 3 --resolution 0", "--resolution is 0");
        wrong("--radio lora --robots 3 --range -7", "--range is -7");
        wrong("--radio lora --robots 3 --period 0", "--period is 0");
        wrong("--radio lora --robots 3 --obstacle-period -1", "--obstacle-period is -1");
        wrong("--radio lora --robots 3 --map-bytes-per-s 0", "--map-bytes-per-s is 0");
        wrong("--radio lora --robots 3 --table", "--table");
    }
}
