//! Where results are written: checked while the command line is read, so that no work is lost for want of a
//! folder.
//!
//! Both are clap value parsers, so an error names its option: `value_parser = outputs::file()`.

use std::ffi::OsString;
use std::fs::OpenOptions;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};

use clap::builder::{OsStringValueParser, TypedValueParser};

/// A file that can be written: it is there and may be changed, or its folder is there and takes new files.
pub fn file() -> impl TypedValueParser<Value = PathBuf> {
    OsStringValueParser::new().try_map(|path: OsString| {
        let path = PathBuf::from(path);
        check_file(&path).map(|()| path)
    })
}

/// A folder that is there and takes new files, or can be made.
pub fn folder() -> impl TypedValueParser<Value = PathBuf> {
    OsStringValueParser::new().try_map(|path: OsString| {
        let path = PathBuf::from(path);
        check_folder(&path).map(|()| path)
    })
}

/// Whether a file can be written; else what is in the way and what to do.
///
/// # Errors
/// That, in words.
pub fn check_file(path: &Path) -> Result<(), String> {
    if path.is_dir() {
        return Err("it is a folder, and a file is written".to_owned());
    }
    if path.exists() {
        let opened = OpenOptions::new().append(true).open(path);
        return opened.map(drop).map_err(|error| format!("it cannot be written: {}", reason(&error)));
    }
    let folder =
        path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or_else(|| Path::new("."));
    if !folder.is_dir() {
        return Err(format!("there is no folder {0}: make it first (mkdir -p {0})", folder.display()));
    }
    takes_files(folder)
}

fn check_folder(path: &Path) -> Result<(), String> {
    if path.as_os_str().is_empty() {
        return Err("expected a folder".to_owned());
    }
    let there = path.ancestors().find(|part| part.exists()).unwrap_or_else(|| Path::new("."));
    if !there.is_dir() {
        return Err(format!("{} is a file, and a folder is made there", there.display()));
    }
    takes_files(there)
}

/// Makes a file that is gone at once.
fn takes_files(folder: &Path) -> Result<(), String> {
    let made = tempfile::tempfile_in(folder);
    made.map(drop)
        .map_err(|error| format!("the folder {} takes no new files: {}", folder.display(), reason(&error)))
}

fn reason(error: &io::Error) -> String {
    match error.kind() {
        ErrorKind::PermissionDenied => "you may not write there".to_owned(),
        ErrorKind::ReadOnlyFilesystem => "it is read-only".to_owned(),
        ErrorKind::StorageFull => "the disk is full".to_owned(),
        _ => error.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_needs_a_folder_that_is_there_and_leaves_nothing_behind() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("result.json");
        assert_eq!(check_file(&file), Ok(()));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        std::fs::write(&file, "kept").unwrap();
        assert_eq!(check_file(&file), Ok(()));
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "kept");
        assert!(check_file(folder.path()).unwrap_err().contains("is a folder"));
        assert!(check_file(&folder.path().join("a/b.json")).unwrap_err().contains("mkdir -p"));
        assert!(check_file(&file.join("b.json")).is_err());
    }

    #[test]
    fn a_folder_may_be_there_or_be_made() {
        let folder = tempfile::tempdir().unwrap();
        for fine in [folder.path().to_owned(), folder.path().join("a/b/c")] {
            assert_eq!(check_folder(&fine), Ok(()));
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        let file = folder.path().join("file");
        std::fs::write(&file, "").unwrap();
        assert!(check_folder(&file.join("a")).unwrap_err().contains("is a file"));
        assert!(check_folder(Path::new("")).is_err());
    }
}
