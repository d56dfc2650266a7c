//! Files as a whole: their ending, their name, their bytes.

use std::path::Path;

use crate::error::{Fault, Place, ReadError};

/// The ending of a path in small letters; empty where there is none.
pub(crate) fn ending(path: &Path) -> String {
    path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default()
}

/// The name of a file or folder without its ending.
pub(crate) fn name_of(path: &Path) -> String {
    let path = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let name = if path.is_dir() { path.file_name() } else { path.file_stem() };
    let name = name.map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    // Of one that is packed as a whole.
    name.strip_suffix(".mcap").map(str::to_owned).unwrap_or(name)
}

/// Reads a whole file of at most `bytes_max` bytes.
pub(crate) fn read_whole(path: &Path, bytes_max: u64) -> Result<Vec<u8>, ReadError> {
    let read = || {
        let length = std::fs::metadata(path).map_err(|e| Fault::io(&e))?.len();
        if length > bytes_max {
            return Err(Fault::too_large(Place::Whole, "the file in bytes", length, bytes_max));
        }
        std::fs::read(path).map_err(|e| Fault::io(&e))
    };
    read().map_err(|fault| fault.in_file(path))
}

/// A file with an ending that nothing reads.
pub(crate) fn unknown_ending(path: &Path, expected: &str) -> ReadError {
    Fault::foreign(Place::Whole, expected, "a file with another ending").in_file(path)
}
