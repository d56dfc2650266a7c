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
    if let Some(file) = args.file.as_ref().filter(|_| !args.check) {
        check_writable(file).map_err(|error| anyhow!("--file {}: {error}", file.display()))?;
    }
    let counts = || table::ROBOTS.into_iter().filter(|robots| *robots <= args.robots_max);
    let cells: Vec<_> =
        RadioPreset::ALL.into_iter().flat_map(|radio| counts().map(move |robots| (radio, robots))).collect();
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
    // The big ones first, so that no core waits for one at the end.
    let mut order: Vec<usize> = (0..cells.len()).collect();
    order.sort_by_key(|number| core::cmp::Reverse(cells[*number].1));
    let progress = Progress::new("rows", cells.len() as u64);
    let mut rows = in_parallel(cores(), order, |number| {
        let (radio, robots) = cells[number];
        let row = table::row(radio, robots);
        progress.step();
        (number, row)
    });
    if rows.len() < cells.len() {
        return Ok(None);
    }
    rows.sort_by_key(|(number, _)| *number);
    let row = |(_, row): (usize, Result<String, _>)| {
        row.map_err(|failure| anyhow!("a checker found something: {failure}"))
    };
    rows.into_iter().map(row).collect::<anyhow::Result<_>>().map(Some)
}
