//! `flockmap sim table`: what a swarm costs, by its radio and the number of its robots.

use flockmap_io::check_writable;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, ensure};
use clap::Args;
use flockmap_cli::parallel::{cores, in_parallel};
use flockmap_cli::progress::Progress;
use flockmap_netsim::swarm::{RadioPreset, table};

/// What a swarm costs by its radio and the number of its robots: bytes, airtime, age, time to agreement
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap sim table --robots-max 20
  flockmap sim table --file tests/tables/swarms.txt
  flockmap sim table --robots-max 20 --file tests/tables/swarms.txt --check

Broadcast, without crashes and partitions; the same on every machine. With --check nothing is written: the rows are held against
those of the file, and a row that differs is shown, with exit code 1. All checkers of `sim swarm` watch these flights too.")]
pub struct SimTableArgs {
    /// Rows for up to so many robots, 2 to 100
    #[arg(long, value_name = "N", default_value_t = 100)]
    pub robots_max: usize,
    /// Rows of this number of robots alone, 2 to 100
    #[arg(long, value_name = "N", conflicts_with = "robots_max")]
    pub robots: Option<usize>,
    /// Rows of this radio alone
    #[arg(long, value_name = "RADIO")]
    pub radio: Option<RadioPreset>,
    /// Write the table to this file
    #[arg(long, value_name = "FILE")]
    pub file: Option<PathBuf>,
    /// Hold the rows against those of --file
    #[arg(long, requires = "file")]
    pub check: bool,
}

/// Runs the command. False if the file says something else.
pub fn run(args: &SimTableArgs) -> anyhow::Result<bool> {
    ensure!((2..=100).contains(&args.robots_max), "--robots-max must be 2 to 100");
    ensure!(args.robots.is_none_or(|robots| (2..=100).contains(&robots)), "--robots must be 2 to 100");
    if let Some(file) = args.file.as_ref().filter(|_| !args.check) {
        check_writable(file).map_err(|error| anyhow!("--file {}: {error}", file.display()))?;
    }
    let up_to = table::ROBOTS.into_iter().filter(|robots| *robots <= args.robots_max).collect();
    let counts: Vec<usize> = args.robots.map_or(up_to, |robots| vec![robots]);
    let radios = RadioPreset::ALL.into_iter().filter(|radio| args.radio.is_none_or(|only| only == *radio));
    let cells: Vec<_> = radios.flat_map(|radio| counts.iter().map(move |robots| (radio, *robots))).collect();
    let Some(rows) = fly_all(&cells)? else { return Ok(false) };
    let text = table::head() + &rows.concat();
    print!("{text}");
    match (&args.file, args.check) {
        (Some(file), true) => check(file, &rows),
        (Some(file), false) => {
            std::fs::write(file, text).with_context(|| format!("cannot write {}", file.display()))?;
            Ok(true)
        }
        (None, _) => Ok(true),
    }
}

fn check(file: &Path, rows: &[String]) -> anyhow::Result<bool> {
    let old = std::fs::read_to_string(file).with_context(|| format!("cannot read {}", file.display()))?;
    let Some((there, here)) = table::difference(&old, rows) else { return Ok(true) };
    let file = file.display();
    eprintln!(
        "{file} says\n  {there}\nand this build gives\n  {here}\nIf that is meant: flockmap sim table --file {file}"
    );
    Ok(false)
}

/// The rows in order; `None` if Ctrl-C came first.
fn fly_all(cells: &[(RadioPreset, usize)]) -> anyhow::Result<Option<Vec<String>>> {
    let flights = cells.iter().flat_map(|cell| (1..=table::SEEDS).map(|seed| (*cell, seed)));
    // The big ones first, so that no core waits for one at the end.
    let mut order: Vec<_> = flights.enumerate().collect();
    order.sort_by_key(|(_, ((_, robots), _))| core::cmp::Reverse(*robots));
    let count = order.len();
    let progress = Progress::new("flights", count as u64);
    let mut flown = in_parallel(cores(), order, |(number, ((radio, robots), seed))| {
        let report = table::flight(radio, robots, seed);
        progress.step();
        (number, report)
    });
    if flown.len() < count {
        return Ok(None);
    }
    flown.sort_by_key(|(number, _)| *number);
    let flown: Vec<_> = flown.into_iter().map(|(_, report)| report).collect();
    let rows = cells.iter().zip(flown.chunks(table::SEEDS as usize)).map(|(&(radio, robots), flights)| {
        table::row(radio, robots, flights).map_err(|failure| anyhow!("a checker found something: {failure}"))
    });
    rows.collect::<anyhow::Result<_>>().map(Some)
}
