//! The files that a node leaves behind: looked at before it flies, and saved at its end, wherever that is
//! possible.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use flockmap_io::{ExportOptions, Unwritable, check_writable, export_map};

use crate::config::{ConfigError, value};
use crate::{Ended, Log, NodeConfig, OutputSection, RecordSection};

const MAP: &str = "[output] save_map_at_end";
const REPORT: &str = "[output] report_json";

/// Checks that both files can be written, and leaves everything as it was.
pub(crate) fn check(output: &OutputSection) -> Result<()> {
    if let Some(path) = &output.save_map_at_end {
        if !path.extension().is_some_and(|end| ["ply", "pcd", "bt"].iter().any(|known| end == *known)) {
            bail!(value(MAP, path.display(), "a file that ends in .ply, .pcd or .bt"));
        }
        if output.report_json.as_ref() == Some(path) {
            bail!(value(REPORT, path.display(), "another file than save_map_at_end, which is the same"));
        }
        check_file(MAP, path)?;
    }
    if let Some(path) = &output.report_json {
        check_file(REPORT, path)?;
    }
    Ok(())
}

/// Checks that the flight can be recorded, and leaves everything as it was.
pub(crate) fn check_record(record: &RecordSection) -> Result<()> {
    const KEY: &str = "[record] path";
    if let Some(path) = &record.path {
        if path.extension().is_none_or(|end| end != "mcap") {
            bail!(value(KEY, path.display(), "a file that ends in .mcap"));
        }
        check_file(KEY, path)?;
    }
    Ok(())
}

fn check_file(key: &str, path: &Path) -> Result<(), ConfigError> {
    check_writable(path).map_err(|error| match error {
        Unwritable::IsFolder => value(key, path.display(), "a file, and this is a folder"),
        Unwritable::NoFolder(folder) => {
            let expected = format!("a file in a folder that is there (mkdir -p {})", folder.display());
            value(key, path.display(), expected)
        }
        error => value(key, format!("{} ({error})", path.display()), "a file that this user may write"),
    })
}

/// When the summary is written.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Report {
    /// To stdout where no file is configured for it.
    Always,
    /// To a file that is configured for it.
    IfConfigured,
}

/// Saves what was asked for, the map first. What cannot be written where it was wanted goes to the folder for
/// temporary files, and to stdout if it is the summary and that fails too.
///
/// # Errors
/// What is not where it was wanted, and where it is. All has been tried then.
pub(crate) fn save(config: &NodeConfig, ended: &Ended, log: &Log, report: Report) -> Result<()> {
    let output = &config.output;
    let mut faults = Vec::new();
    if let Some(path) = &output.save_map_at_end {
        let map = ended.robot.map();
        let options = ExportOptions { free: output.save_free };
        let write = |path: &Path| export_map(path, map.resolution(), map.voxels(), &options);
        match write_somewhere(path, ended, write) {
            Ok(count) => log.info(format!("{count} voxels in {}", path.display())),
            Err(fault) => faults.push(format!("{MAP}: {fault}")),
        }
    }
    let json = serde_json::to_string_pretty(&ended.summary)?;
    if let Some(path) = &output.report_json {
        match write_somewhere(path, ended, |path| std::fs::write(path, format!("{json}\n"))) {
            Ok(()) => log.info(format!("summary in {}", path.display())),
            Err(fault) => {
                if fault.is_lost {
                    println!("{json}");
                }
                faults.push(format!("{REPORT}: {fault}"));
            }
        }
    } else if report == Report::Always {
        println!("{json}");
    }
    if faults.is_empty() { Ok(()) } else { bail!(faults.join("; ")) }
}

/// A file that is not where it was wanted.
struct Fault {
    text: String,
    is_lost: bool,
}

impl Display for Fault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.text)
    }
}

/// Writes a file, or one of the same kind in the folder for temporary files.
fn write_somewhere<T, E: Display>(
    path: &Path,
    ended: &Ended,
    write: impl Fn(&Path) -> Result<T, E>,
) -> Result<T, Fault> {
    let first = match write(path) {
        Ok(written) => return Ok(written),
        Err(error) => error.to_string(),
    };
    let why = if first.contains(&path.display().to_string()) {
        first
    } else {
        format!("cannot write {}: {first}", path.display())
    };
    let other = beside(path, ended);
    match write(&other) {
        Ok(_) => {
            let text = format!("{why}. It was written to {} in place of that", other.display());
            Err(Fault { text, is_lost: false })
        }
        Err(error) => {
            let text = format!("{why}. Nor could {} be written: {error}", other.display());
            Err(Fault { text, is_lost: true })
        }
    }
}

/// A file of the same name in the folder for temporary files, that no other robot or run has.
fn beside(path: &Path, ended: &Ended) -> PathBuf {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let own = ended.status.own;
    std::env::temp_dir().join(format!("flockmap-{}-{}-{name}", own.origin, own.epoch))
}
