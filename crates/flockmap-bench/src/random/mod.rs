//! `flockmap-bench random`: what changes drawn at random cost, as in the paper's Fig. 5.

mod draw;
mod figure;

use flockmap_cli::outputs;
use std::path::PathBuf;

use anyhow::ensure;
use clap::Args;
use flockmap_cli::document::{Document, Verdict};
use flockmap_cli::{json_file, stop};
use serde_json::json;

pub use draw::{Figure, Plan, measure};
use figure::TABLE;
pub use figure::section;

/// More draws than anybody needs.
const DRAWS_MAX: u32 = 10_000;

/// Changes drawn at random, beside the entropy limit: the paper's Fig. 5
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap-bench random --quick
  flockmap-bench random --out fig5/ --csv fig5.csv

Four maps whose voxels need addresses of 2, 3, 3 and 4 bytes, shares of 0.0001 to 1, ten draws each.
Exit code 1 if any codec gets a voxel wrong.")]
pub struct RandomArgs {
    /// Draws for each size and ratio [default: 10, as in the paper; with --quick 2]
    #[arg(long, value_name = "N")]
    pub draws: Option<u32>,
    /// One ratio a decade and two draws each: seconds in place of minutes
    #[arg(long)]
    pub quick: bool,
    /// Seed of the draws
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
    /// Write every point as JSON
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub json: Option<PathBuf>,
    /// Write every point as CSV
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub csv: Option<PathBuf>,
    /// Write report.html with four charts, report.json and CSV files to this folder
    #[arg(long, value_name = "DIR", value_parser = outputs::folder())]
    pub out: Option<PathBuf>,
}

/// Runs the command.
pub fn run(args: &RandomArgs) -> anyhow::Result<bool> {
    let mut plan = Plan::new(args.quick, args.seed);
    if let Some(draws) = args.draws {
        ensure!((1..=DRAWS_MAX).contains(&draws), "--draws is {draws}, expected 1 to {DRAWS_MAX}");
        plan.draws = draws;
    }
    let figure = measure(&plan)?;
    let document = Document {
        title: format!("Changes drawn at random ({} draws a point, seed {})", plan.draws, plan.seed),
        verdicts: verdicts(&figure),
        sections: vec![section(&figure, &plan)],
        facts: json!({
            "seed": plan.seed, "draws": plan.draws, "header_bytes_max": figure.header_bytes_max,
            "interrupted": stop::requested(), "maps": figure.maps,
        }),
        ..Document::default()
    };
    document.print(true);
    json_file::write_asked(args.json.as_deref(), &document.json())?;
    if let Some(path) = &args.csv {
        document.write_csv(TABLE, path)?;
    }
    if let Some(folder) = &args.out {
        document.write(folder, &document.json())?;
    }
    Ok(document.is_good())
}

/// Whether all is well, as text.
fn verdicts(figure: &Figure) -> Vec<Verdict> {
    let mut verdicts = Vec::new();
    if stop::requested() {
        let words = "Partial: ended by Ctrl-C. Points that were not reached are missing.";
        verdicts.push(Verdict::Note(words.to_owned()));
    }
    verdicts.push(lossless(figure));
    verdicts
}

/// Whether the codecs keep their promise.
pub fn lossless(figure: &Figure) -> Verdict {
    let words = if figure.lossless {
        "Every codec gives back every voxel of changes drawn at random (first draw of each point decoded)."
    } else {
        "A codec does not give back changes drawn at random: a fault of flockmap, please report it."
    };
    Verdict::good_if(figure.lossless, words)
}
