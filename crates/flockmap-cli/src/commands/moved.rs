//! `flockmap bench`: went to a program of its own.

use anyhow::bail;
use clap::Args;

#[derive(Args, Debug)]
#[command(disable_help_flag = true)]
pub struct BenchArgs {
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    words: Vec<String>,
}

/// Says where it is.
pub fn run(args: &BenchArgs) -> anyhow::Result<bool> {
    let words = args.words.join(" ");
    bail!("benchmarks are in a program of their own: cargo run --release -p flockmap-bench -- {words}")
}
