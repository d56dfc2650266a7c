//! `flockmap-bench train`: makes the tables of the codec `flock` from generated flights. Explained in
//! `docs/codec-training.md`.

mod learning;
mod recording;
mod scenes;

use flockmap_cli::outputs;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use flockmap_cli::parallel::cores;
use flockmap_codec::training;

/// Make the tables that the codec `flock` ships, from flights through generated worlds
///
/// Flies robots through forests and offices, maps what they see, and learns from their batches how likely
/// each change is. The same source gives the same bytes on every machine and with any number of threads. It
/// takes a few minutes and needs a release build.
#[derive(Args, Debug)]
#[command(
    arg_required_else_help = true,
    after_help = "\
Examples:
  flockmap-bench train --out crates/flockmap-codec/src/flock/tables.bin
  flockmap-bench train --check

Robots with different tables cannot read each other's packages: ship new tables with a new version only.
Nothing is written before the end, so Ctrl-C leaves nothing behind.
Exit code 0: done, or the same; 1: the shipped tables differ; 2: failed."
)]
pub struct TrainArgs {
    /// Write the tables to this file
    #[arg(long, value_name = "FILE", required_unless_present = "check", conflicts_with = "check", value_parser = outputs::file())]
    pub out: Option<PathBuf>,
    /// Compare with the tables that the codec ships; write nothing
    #[arg(long)]
    pub check: bool,
    /// Threads to use; as many as the machine has if not given
    #[arg(long, value_name = "N")]
    pub threads: Option<NonZeroUsize>,
}

/// Runs the command. Whether the tables were written, or are the shipped ones.
pub fn run(args: &TrainArgs) -> anyhow::Result<bool> {
    let threads = args.threads.map_or_else(cores, NonZeroUsize::get);
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
        println!("the shipped tables are what this command makes, {} bytes", file.len());
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
        "The tables are equal, their compression is not: `zopfli` has changed."
    } else {
        "The scenes, the simulator, the mapper or the model have changed since they were made."
    };
    Ok(Some(format!(
        "the shipped tables are not what this command makes ({})\n{cause} To make them anew:\n  \
         cargo run --release -p flockmap-bench -- train --out crates/flockmap-codec/src/flock/tables.bin\n\
         and look at what that does to sizes:\n  cargo run --release -p flockmap-bench -- codecs forest",
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
}
