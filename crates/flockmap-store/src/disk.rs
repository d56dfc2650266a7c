//! The few things that a store wants of a file system, so that tests can let each of them fail.

use std::fmt;
use std::io::{self, Read, Write};

/// A folder with files in it. Names are plain file names.
pub trait Disk: fmt::Debug + Send + Sync {
    /// The names of all files.
    fn names(&self) -> io::Result<Vec<String>>;
    /// Bytes of a file.
    fn length(&self, name: &str) -> io::Result<u64>;
    /// A file from its beginning; [`io::ErrorKind::NotFound`] if there is none.
    fn read(&self, name: &str) -> io::Result<Box<dyn Read>>;
    /// A new, empty file that only its owner can read; an error if there is one of that name.
    fn create(&self, name: &str) -> io::Result<Box<dyn DiskFile>>;
    /// Gives a file another name, in one step that either happens or does not. A file of that name is replaced.
    fn rename(&self, from: &str, to: &str) -> io::Result<()>;
    /// Takes a file away.
    fn remove(&self, name: &str) -> io::Result<()>;
    /// Cuts a file to `length` bytes, for good.
    fn cut(&self, name: &str, length: u64) -> io::Result<()>;
    /// Returns when all new, renamed and removed names are on the disk.
    fn sync_folder(&self) -> io::Result<()>;
}

/// A file that is being written.
pub trait DiskFile: Write + fmt::Debug + Send {
    /// Returns when all that was written is on the disk.
    fn sync(&mut self) -> io::Result<()>;
}
