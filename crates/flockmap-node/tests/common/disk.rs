//! A disk in memory that fails when it is told to.

use std::collections::BTreeMap;
use std::io::{self, Cursor, Read, Write};
use std::sync::{Arc, Mutex, MutexGuard};

use flockmap_node::store::{Disk, DiskFile};

/// Clones are the same disk.
#[derive(Clone, Debug, Default)]
pub(crate) struct MemoryDisk(Arc<Mutex<State>>);

#[derive(Debug, Default)]
pub(crate) struct State {
    pub(crate) files: BTreeMap<String, Vec<u8>>,
    /// Bytes that can still be written; then a write takes what fits, and the next one fails.
    pub(crate) room: Option<usize>,
    pub(crate) sync_fails: bool,
    pub(crate) create_fails: bool,
    pub(crate) remove_fails: bool,
    /// Reading fails behind so many bytes of a file.
    pub(crate) readable: Option<usize>,
    /// Most bytes that all files had together.
    pub(crate) bytes_most: usize,
    pub(crate) syncs: usize,
}

impl MemoryDisk {
    /// A disk with these files.
    pub(crate) fn of(files: BTreeMap<String, Vec<u8>>) -> Self {
        Self(Arc::new(Mutex::new(State { files, ..State::default() })))
    }

    pub(crate) fn state(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap()
    }

    pub(crate) fn files(&self) -> BTreeMap<String, Vec<u8>> {
        self.state().files.clone()
    }
}

fn not_found() -> io::Error {
    io::ErrorKind::NotFound.into()
}

impl Disk for MemoryDisk {
    fn names(&self) -> io::Result<Vec<String>> {
        Ok(self.state().files.keys().cloned().collect())
    }

    fn length(&self, name: &str) -> io::Result<u64> {
        self.state().files.get(name).map(|file| file.len() as u64).ok_or_else(not_found)
    }

    fn read(&self, name: &str) -> io::Result<Box<dyn Read>> {
        let state = self.state();
        let file = state.files.get(name).ok_or_else(not_found)?.clone();
        Ok(match state.readable {
            Some(readable) => {
                Box::new(Cursor::new(file).take(readable as u64).chain(Broken("input/output error")))
            }
            None => Box::new(Cursor::new(file)),
        })
    }

    fn create(&self, name: &str) -> io::Result<Box<dyn DiskFile>> {
        let mut state = self.state();
        if state.create_fails {
            return Err(io::ErrorKind::PermissionDenied.into());
        }
        if state.files.insert(name.to_owned(), Vec::new()).is_some() {
            return Err(io::ErrorKind::AlreadyExists.into());
        }
        Ok(Box::new(MemoryFile { disk: self.clone(), name: name.to_owned() }))
    }

    fn rename(&self, from: &str, to: &str) -> io::Result<()> {
        let mut state = self.state();
        let file = state.files.remove(from).ok_or_else(not_found)?;
        state.files.insert(to.to_owned(), file);
        Ok(())
    }

    fn remove(&self, name: &str) -> io::Result<()> {
        let mut state = self.state();
        if state.remove_fails {
            return Err(io::ErrorKind::PermissionDenied.into());
        }
        state.files.remove(name).map(drop).ok_or_else(not_found)
    }

    fn cut(&self, name: &str, length: u64) -> io::Result<()> {
        self.state().files.get_mut(name).ok_or_else(not_found)?.truncate(length as usize);
        Ok(())
    }

    fn sync_folder(&self) -> io::Result<()> {
        Ok(())
    }
}

struct MemoryFile {
    disk: MemoryDisk,
    name: String,
}

impl Write for MemoryFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut state = self.disk.state();
        let fitting = state.room.unwrap_or(bytes.len()).min(bytes.len());
        if fitting == 0 && !bytes.is_empty() {
            return Err(io::ErrorKind::StorageFull.into());
        }
        if let Some(room) = &mut state.room {
            *room -= fitting;
        }
        state.files.get_mut(&self.name).ok_or_else(not_found)?.extend_from_slice(&bytes[..fitting]);
        let all = state.files.values().map(Vec::len).sum();
        state.bytes_most = state.bytes_most.max(all);
        Ok(fitting)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl DiskFile for MemoryFile {
    fn sync(&mut self) -> io::Result<()> {
        let mut state = self.disk.state();
        state.syncs += 1;
        if state.sync_fails { Err(io::Error::other("input/output error")) } else { Ok(()) }
    }
}

struct Broken(&'static str);

impl Read for Broken {
    fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
        Err(io::Error::other(self.0))
    }
}
