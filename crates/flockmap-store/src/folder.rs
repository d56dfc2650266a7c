//! A folder of a real file system. What is in it only its owner can read: it is the map, beside a radio that
//! is sealed.

use std::fs::{DirBuilder, File, OpenOptions};
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use crate::{Disk, DiskFile, StoreError};

/// A real folder. Made with mode 700 if need be; its files have mode 600.
#[derive(Debug)]
pub struct Folder {
    path: PathBuf,
    warning: Option<String>,
    /// Held for as long as this lives.
    _lock: Option<File>,
}

/// The file that is locked. The lock goes with the process, however it ends.
const LOCK: &str = "lock";

impl Folder {
    /// The folder of a store, locked for as long as this lives: no second node can open it.
    ///
    /// # Errors
    /// [`StoreError::InUse`] if another node has it, [`StoreError::Disk`] if it cannot be made or locked.
    pub fn open(path: impl Into<PathBuf>) -> Result<Self, StoreError> {
        let path = path.into();
        let fail = |error| StoreError::Disk { what: format!("open the folder {}", path.display()), error };
        let is_new = make(&path).map_err(fail)?;
        let lock = options().create(true).truncate(false).open(path.join(LOCK)).map_err(fail)?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(std::fs::TryLockError::WouldBlock) => return Err(StoreError::InUse(path)),
            Err(std::fs::TryLockError::Error(error)) => return Err(fail(error)),
        }
        let warning = (!is_new && others_may(&path, 0o077)).then(|| {
            let path = path.display();
            format!(
                "other users of this machine can look into {path}, which has the map in it: chmod 700 {path}"
            )
        });
        Ok(Self { path, warning, _lock: Some(lock) })
    }

    /// A folder that several robots of a machine may have, each with files of its own: that of their epochs.
    ///
    /// # Errors
    /// The folder cannot be made.
    pub fn shared(path: impl Into<PathBuf>) -> io::Result<Self> {
        let path = path.into();
        make(&path)?;
        Ok(Self { path, warning: None, _lock: None })
    }

    /// What should be changed about it, if something should: it was there before, and others can look into it.
    pub fn warning(&self) -> Option<&str> {
        self.warning.as_deref()
    }
}

impl Disk for Folder {
    fn names(&self) -> io::Result<Vec<String>> {
        names(&self.path)
    }

    fn length(&self, name: &str) -> io::Result<u64> {
        Ok(std::fs::metadata(self.path.join(name))?.len())
    }

    fn read(&self, name: &str) -> io::Result<Box<dyn Read>> {
        Ok(Box::new(File::open(self.path.join(name))?))
    }

    fn create(&self, name: &str) -> io::Result<Box<dyn DiskFile>> {
        Ok(Box::new(options().create_new(true).open(self.path.join(name))?))
    }

    fn rename(&self, from: &str, to: &str) -> io::Result<()> {
        std::fs::rename(self.path.join(from), self.path.join(to))
    }

    fn remove(&self, name: &str) -> io::Result<()> {
        std::fs::remove_file(self.path.join(name))
    }

    fn cut(&self, name: &str, length: u64) -> io::Result<()> {
        let file = OpenOptions::new().write(true).open(self.path.join(name))?;
        file.set_len(length)?;
        file.sync_all()
    }

    #[cfg(unix)]
    fn sync_folder(&self) -> io::Result<()> {
        File::open(&self.path)?.sync_all()
    }

    /// Other systems keep names in order by themselves, and have no call for it.
    #[cfg(not(unix))]
    fn sync_folder(&self) -> io::Result<()> {
        Ok(())
    }
}

impl DiskFile for File {
    fn sync(&mut self) -> io::Result<()> {
        self.sync_data()
    }
}

/// The names of the files in a folder; what is no text is not ours.
pub(crate) fn names(path: &Path) -> io::Result<Vec<String>> {
    let mut names = Vec::new();
    for entry in std::fs::read_dir(path)? {
        names.extend(entry?.file_name().into_string());
    }
    Ok(names)
}

/// Makes the folder, and those that it is in, unless it is there. Returns whether it was not.
fn make(path: &Path) -> io::Result<bool> {
    let is_new = !path.is_dir();
    let mut builder = DirBuilder::new();
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    builder.recursive(true).create(path)?;
    Ok(is_new)
}

/// How files are written.
fn options() -> OpenOptions {
    let mut options = OpenOptions::new();
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    options.write(true);
    options
}

/// Whether a file or folder gives others than its owner one of these permissions.
#[cfg(unix)]
pub fn others_may(path: &Path, permissions: u32) -> bool {
    use std::os::unix::fs::PermissionsExt;
    std::fs::metadata(path).is_ok_and(|there| there.permissions().mode() & permissions != 0)
}

/// Other systems have no such permissions.
#[cfg(not(unix))]
pub const fn others_may(_: &Path, _: u32) -> bool {
    false
}
