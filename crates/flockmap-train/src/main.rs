//! The program `flockmap-train`: makes the tables of the codec `flock` from generated flights. Explained in
//! `docs/codec-training.md`.
#![forbid(unsafe_code)]
#![allow(unreachable_pub, reason = "a program has no outside")]

mod learning;
mod parallel;
mod progress;
mod recording;
mod scenes;

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use clap::Parser;
use flockmap_codec::training;

/// The shipped tables are not those that were made.
const EXIT_DIFFERENT: u8 = 1;
/// The work could not be done; the same code as for a wrong command line.
const EXIT_FAILED: u8 = 2;

/// Makes the tables of the codec `flock` from flights through generated worlds.
///
/// Flies robots through forests and offices, maps what they see, and learns from their cycles how likely each change is. The same source
/// gives the same bytes on every machine and with any number of threads. It takes a few minutes and needs a release build.
#[derive(Parser, Debug)]
#[command(name = "flockmap-train", version, arg_required_else_help = true, after_help = EXAMPLES)]
struct Args {
    /// Write the tables to this file
    #[arg(long, value_name = "FILE", required_unless_present = "check", conflicts_with = "check")]
    out: Option<PathBuf>,
    /// Compare with the tables that the codec ships; write nothing
    #[arg(long)]
    check: bool,
    /// Threads to use; as many as the machine has if not given
    #[arg(long, value_name = "N")]
    threads: Option<NonZeroUsize>,
}

const EXAMPLES: &str = "\
Examples:
  cargo run --release -p flockmap-train -- --out crates/flockmap-codec/src/flock/tables.bin
  cargo run --release -p flockmap-train -- --check

Robots with different tables cannot read each other's packages: ship new tables with a new version only.
Nothing is written before the end, so Ctrl-C leaves nothing behind.
Exit code 0: done, or the same; 1: the shipped tables differ; 2: failed.";

fn main() -> ExitCode {
    let args = Args::parse();
    match run(&args) {
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::from(EXIT_FAILED)
        }
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(EXIT_DIFFERENT),
    }
}

fn run(args: &Args) -> anyhow::Result<bool> {
    let threads =
        args.threads.or_else(|| std::thread::available_parallelism().ok()).map_or(1, NonZeroUsize::get);
    if let Some(path) = &args.out {
        check_folder(path)?;
    }
    let recordings = recording::record(scenes::SCENES, threads)?;
    let file = learning::tables(&recordings, threads);
    if let Some(path) = &args.out {
        std::fs::write(path, &file).with_context(|| format!("cannot write {}", path.display()))?;
        println!("{}: {} bytes", path.display(), file.len());
        return Ok(true);
    }
    let Some(differences) = differences(&file)? else {
        println!("the shipped tables are what this program makes, {} bytes", file.len());
        return Ok(true);
    };
    println!("{differences}");
    Ok(false)
}

/// Said before the minutes of work and not after.
fn check_folder(path: &Path) -> anyhow::Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    let is_there = folder.is_none_or(Path::is_dir);
    anyhow::ensure!(is_there, "cannot write {}: its folder is not there", path.display());
    Ok(())
}

/// In what the shipped tables differ from these; `None` if in nothing.
fn differences(made: &[u8]) -> anyhow::Result<Option<String>> {
    let shipped = training::shipped();
    if made == shipped {
        return Ok(None);
    }
    let [old, new] = [training::read(shipped)?, training::read(made)?];
    let mut sets = Vec::new();
    for (name, (old, new)) in training::SETS.iter().zip(old.iter().zip(&new)) {
        let different = old.iter().zip(new).filter(|(old, new)| old != new).count();
        sets.push(format!("{name}: {different} of {} bytes differ", new.len()));
    }
    let cause = if old == new {
        "The tables are equal, their compression is not: the zlib library has changed."
    } else {
        "The scenes, the simulator, the mapper or the model have changed since they were made."
    };
    Ok(Some(format!(
        "the shipped tables are not what this program makes ({})\n{cause} To make them anew:\n  \
         cargo run --release -p flockmap-train -- --out crates/flockmap-codec/src/flock/tables.bin\n\
         and look at what that does to sizes:\n  cargo run --release -- bench codecs forest",
        sets.join("; ")
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_check_says_in_which_set_tables_differ() {
        assert_eq!(differences(training::shipped()).expect("shipped tables can be read"), None);
        let mut sets = training::read(training::shipped()).expect("shipped tables can be read");
        sets[1][0] ^= 1;
        let said = differences(&training::file(&sets)).expect("a file of tables").expect("they differ");
        assert!(said.contains("dense: 0 of "), "{said}");
        assert!(said.contains("sparse: 1 of "), "{said}");
        assert!(differences(b"no tables").is_err());
    }

    #[test]
    fn one_of_out_and_check_must_be_given() {
        for wrong in
            [&[][..], &["--threads", "2"], &["--check", "--out", "file"], &["--check", "--threads", "0"]]
        {
            assert!(Args::try_parse_from(["flockmap-train"].iter().chain(wrong)).is_err(), "{wrong:?}");
        }
        assert!(Args::try_parse_from(["flockmap-train", "--check"]).is_ok());
    }
}
