//! `flockmap sim table`: what a swarm costs, by its radio and the number of its robots.

use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use flockmap_netsim::swarm::{RadioPreset, table};

use crate::args_sim::SimTableArgs;
use crate::progress::Progress;
use crate::stop;

/// How often the progress is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// Runs the command. False if the file says something else.
pub fn run(args: &SimTableArgs) -> anyhow::Result<bool> {
    ensure!((2..=100).contains(&args.robots_max), "--robots-max must be 2 to 100");
    let counts = || table::ROBOTS.into_iter().filter(|robots| *robots <= args.robots_max);
    let cells: Vec<_> =
        RadioPreset::ALL.into_iter().flat_map(|radio| counts().map(move |robots| (radio, robots))).collect();
    let rows = fly_all(&cells)?;
    let Some(rows) = rows else { return Ok(false) };
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
    eprintln!(
        "{} says\n  {there}\nand this build gives\n  {here}\nIf that is meant: flockmap sim table --file {}",
        file.display(),
        file.display()
    );
    Ok(false)
}

/// The rows in order; `None` if Ctrl-C came first.
fn fly_all(cells: &[(RadioPreset, usize)]) -> anyhow::Result<Option<Vec<String>>> {
    // The big ones first, so that no core waits for one at the end.
    let mut order: Vec<usize> = (0..cells.len()).collect();
    order.sort_by_key(|number| core::cmp::Reverse(cells[*number].1));
    let (next, done) = (AtomicUsize::new(0), AtomicU64::new(0));
    let rows = Mutex::new(vec![None; cells.len()]);
    let mut progress = Progress::new("rows", cells.len() as u64);
    let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    std::thread::scope(|scope| {
        let work = || {
            while !stop::requested() {
                let Some(&number) = order.get(next.fetch_add(1, Ordering::Relaxed)) else { return };
                let (radio, robots) = cells[number];
                let row = table::row(radio, robots);
                if let Ok(mut rows) = rows.lock() {
                    rows[number] = Some(row);
                }
                done.fetch_add(1, Ordering::Relaxed);
            }
        };
        let workers: Vec<_> = (0..threads).map(|_| scope.spawn(work)).collect();
        while workers.iter().any(|worker| !worker.is_finished()) {
            progress.set(done.load(Ordering::Relaxed));
            std::thread::sleep(LOOK_EVERY);
        }
    });
    drop(progress);
    let rows = rows.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
    let mut all = Vec::new();
    for row in rows {
        match row {
            None => return Ok(None),
            Some(Ok(row)) => all.push(row),
            Some(Err(failure)) => bail!("a checker found something: {failure}"),
        }
    }
    Ok(Some(all))
}
