//! `flockmap key`: a new swarm key.

use std::fs::OpenOptions;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, bail};
use clap::Args;
use flockmap::sync::SwarmKey;

/// Make a new swarm key: with it, robots believe only each other, and nobody else can read what they send
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap key --out swarm.key      a new file that only its owner can read
  flockmap key                      to the terminal

The key is 32 random bytes as 64 hex digits. Copy the file to every robot and name it in its configuration:
  [session]
  swarm_key_file = \"swarm.key\"
Or put the digits there as swarm_key, or into the environment variable FLOCKMAP_SWARM_KEY. docs/key.md says what a key
covers and what it does not.")]
pub struct KeyArgs {
    /// New file for the key [default: the terminal]
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
}

pub fn run(args: &KeyArgs) -> anyhow::Result<bool> {
    let mut bytes = [0; SwarmKey::BYTES];
    getrandom::fill(&mut bytes).map_err(|error| anyhow!("this machine gives no random bytes: {error}"))?;
    let text: String = bytes.iter().map(|byte| format!("{byte:02x}")).chain(["\n".to_owned()]).collect();
    match &args.out {
        Some(path) => write_new(path, &text)?,
        None => print!("{text}"),
    }
    Ok(true)
}

/// A file that only its owner can read. One that is there stays: robots may be using its key.
fn write_new(path: &Path, text: &str) -> anyhow::Result<()> {
    let mut options = OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    let mut file = match options.open(path) {
        Err(error) if error.kind() == ErrorKind::AlreadyExists => {
            bail!("{} is there already: give another name, or remove it first", path.display())
        }
        opened => opened.with_context(|| format!("cannot write {}", path.display()))?,
    };
    file.write_all(text.as_bytes()).with_context(|| format!("cannot write {}", path.display()))?;
    eprintln!("a new swarm key in {}, for the owner's eyes only: copy it to every robot", path.display());
    Ok(())
}
