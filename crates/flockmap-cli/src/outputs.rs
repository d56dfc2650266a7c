//! Where results are written: checked while the command line is read, so that no work is lost for want of a
//! folder.
//!
//! Both are clap value parsers, so an error names its option: `value_parser = outputs::file()`.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use clap::builder::{OsStringValueParser, TypedValueParser};
use flockmap_io::{Unwritable, check_writable};

/// A file that can be written: it is there and may be changed, or its folder is there and takes new files.
pub fn file() -> impl TypedValueParser<Value = PathBuf> {
    OsStringValueParser::new().try_map(|path: OsString| {
        let path = PathBuf::from(path);
        check_writable(&path).map(|()| path)
    })
}

/// A folder that is there and takes new files, or can be made.
pub fn folder() -> impl TypedValueParser<Value = PathBuf> {
    OsStringValueParser::new().try_map(|path: OsString| {
        let path = PathBuf::from(path);
        check_folder(&path).map(|()| path)
    })
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
    made.map(drop).map_err(|error| format!("the folder {}: {}", folder.display(), Unwritable::System(error)))
}

#[cfg(test)]
mod tests {
    use super::*;

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
