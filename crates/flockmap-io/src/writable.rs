//! Whether a file can be written: looked at before the work whose result it is for.

use std::fs::OpenOptions;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};

/// Why a file cannot be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Unwritable {
    /// There is a folder of this name.
    #[error("it is a folder, and a file is written")]
    IsFolder,
    /// The folder of the file is not there.
    #[error("there is no folder {path}: make it first (mkdir -p {path})", path = .0.display())]
    NoFolder(PathBuf),
    /// The operating system refuses.
    #[error("it cannot be written: {}", in_words(.0))]
    System(io::Error),
}

/// Whether a file can be written at a path. A file that is there stays as it is; else one is made and removed
/// again. Devices and pipes are not tried.
///
/// # Errors
/// What is in the way.
pub fn check_writable(path: &Path) -> Result<(), Unwritable> {
    match std::fs::metadata(path) {
        Ok(there) if there.is_dir() => return Err(Unwritable::IsFolder),
        Ok(there) if there.is_file() => {
            return OpenOptions::new().append(true).open(path).map(drop).map_err(Unwritable::System);
        }
        Ok(_) => return Ok(()),
        Err(_) => {}
    }
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    if let Some(folder) = folder.filter(|folder| !folder.is_dir()) {
        return Err(Unwritable::NoFolder(folder.to_owned()));
    }
    let made = OpenOptions::new().append(true).create_new(true).open(path);
    made.and_then(|_| std::fs::remove_file(path)).map_err(Unwritable::System)
}

fn in_words(error: &io::Error) -> String {
    match error.kind() {
        ErrorKind::PermissionDenied => "you may not write there".to_owned(),
        ErrorKind::ReadOnlyFilesystem => "it is read-only".to_owned(),
        ErrorKind::StorageFull => "the disk is full".to_owned(),
        _ => error.to_string(),
    }
}
