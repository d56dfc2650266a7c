//! A disk in memory, for tests and simulations: it fails when it is told to, and forgets what was not safe when its power is cut.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Read, Write};
use std::ops::Range;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::{Disk, DiskFile};

/// A disk in memory. Clones are the same disk.
#[derive(Clone, Debug, Default)]
pub struct MemoryDisk(Arc<Mutex<State>>);

/// What a disk refuses.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Faults {
    /// Calls of [`Disk`] and [`DiskFile`], and reads and writes of files, that fail, by their number: [`MemoryDisk::calls`].
    pub calls: Range<u64>,
    /// Bytes that can still be written; then a write takes what fits, and the next one fails.
    pub room: Option<usize>,
    /// No file can be made safe.
    pub sync: bool,
    /// No file can be made.
    pub create: bool,
    /// No file can be taken away.
    pub remove: bool,
    /// Reading fails behind so many bytes of a file.
    pub readable: Option<usize>,
}

/// What is on the disk when the power is back, of that which was not safe yet.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct PowerCut {
    /// So many of the bytes of each file that were not synced.
    pub bytes_kept: usize,
    /// Whether names that were not synced are as they were last, or as they were synced.
    pub names_kept: bool,
}

#[derive(Debug, Default)]
struct State {
    /// Each file by the order in which it was created, whatever its name is now.
    files: BTreeMap<u64, Contents>,
    names: BTreeMap<String, u64>,
    names_synced: BTreeMap<String, u64>,
    created: u64,
    faults: Faults,
    calls: u64,
    syncs: u64,
    bytes_most: usize,
}

#[derive(Debug, Default)]
struct Contents {
    bytes: Vec<u8>,
    /// So many of them are safe.
    synced: usize,
}

impl MemoryDisk {
    /// A disk with these files, all of them safe.
    pub fn of(files: BTreeMap<String, Vec<u8>>) -> Self {
        let disk = Self::default();
        for (name, bytes) in files {
            disk.put(&name, bytes);
        }
        disk
    }

    /// A file that is there and safe; one of that name is replaced.
    pub fn put(&self, name: &str, bytes: Vec<u8>) {
        let mut state = self.state();
        let place = state.add(name, Contents { synced: bytes.len(), bytes });
        state.names_synced.insert(name.to_owned(), place);
    }

    /// All files, as a program sees them.
    pub fn files(&self) -> BTreeMap<String, Vec<u8>> {
        let state = self.state();
        state.names.iter().map(|(name, place)| (name.clone(), state.files[place].bytes.clone())).collect()
    }

    /// From now on these things fail, and no others.
    pub fn set_faults(&self, faults: Faults) {
        self.state().faults = faults;
    }

    /// Calls so far, failed ones too.
    pub fn calls(&self) -> u64 {
        self.state().calls
    }

    /// Times that a file was made safe, or was to be.
    pub fn syncs(&self) -> u64 {
        self.state().syncs
    }

    /// Most bytes that all files had together.
    pub fn bytes_most(&self) -> usize {
        self.state().bytes_most
    }

    /// The power is cut and comes back: what was not safe is gone, as far as `cut` says. Who has a file open must not go on writing to it.
    pub fn cut_power(&self, cut: PowerCut) {
        let mut state = self.state();
        let State { files, names, names_synced, .. } = &mut *state;
        if cut.names_kept {
            names_synced.clone_from(names);
        } else {
            names.clone_from(names_synced);
        }
        for file in files.values_mut() {
            file.bytes.truncate(file.synced.saturating_add(cut.bytes_kept));
            file.synced = file.bytes.len();
        }
        state.forget_nameless();
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A call begins; fails if it is to.
    fn call(&self) -> io::Result<MutexGuard<'_, State>> {
        let mut state = self.state();
        let number = state.calls;
        state.calls += 1;
        if state.faults.calls.contains(&number) { Err(broken()) } else { Ok(state) }
    }
}

fn broken() -> io::Error {
    io::Error::other("input/output error")
}

fn not_found() -> io::Error {
    io::ErrorKind::NotFound.into()
}

impl State {
    fn place(&self, name: &str) -> io::Result<u64> {
        self.names.get(name).copied().ok_or_else(not_found)
    }

    fn add(&mut self, name: &str, file: Contents) -> u64 {
        let place = self.created;
        self.created += 1;
        self.files.insert(place, file);
        self.names.insert(name.to_owned(), place);
        place
    }

    /// An open file is one of a name as well, unless it was taken away.
    fn file(&mut self, place: u64) -> io::Result<&mut Contents> {
        self.files.get_mut(&place).ok_or_else(not_found)
    }

    fn forget_nameless(&mut self) {
        let Self { files, names, names_synced, .. } = self;
        let named: BTreeSet<u64> = names.values().chain(names_synced.values()).copied().collect();
        files.retain(|place, _| named.contains(place));
    }
}

impl Disk for MemoryDisk {
    fn names(&self) -> io::Result<Vec<String>> {
        Ok(self.call()?.names.keys().cloned().collect())
    }

    fn length(&self, name: &str) -> io::Result<u64> {
        let state = self.call()?;
        Ok(state.files[&state.place(name)?].bytes.len() as u64)
    }

    fn read(&self, name: &str) -> io::Result<Box<dyn Read>> {
        let place = self.call()?.place(name)?;
        Ok(Box::new(MemoryFile { disk: self.clone(), place, at: 0 }))
    }

    fn create(&self, name: &str) -> io::Result<Box<dyn DiskFile>> {
        let mut state = self.call()?;
        if state.faults.create {
            return Err(io::ErrorKind::PermissionDenied.into());
        }
        if state.names.contains_key(name) {
            return Err(io::ErrorKind::AlreadyExists.into());
        }
        let place = state.add(name, Contents::default());
        Ok(Box::new(MemoryFile { disk: self.clone(), place, at: 0 }))
    }

    fn rename(&self, from: &str, to: &str) -> io::Result<()> {
        let mut state = self.call()?;
        let place = state.names.remove(from).ok_or_else(not_found)?;
        state.names.insert(to.to_owned(), place);
        Ok(())
    }

    fn remove(&self, name: &str) -> io::Result<()> {
        let mut state = self.call()?;
        if state.faults.remove {
            return Err(io::ErrorKind::PermissionDenied.into());
        }
        state.names.remove(name).map(drop).ok_or_else(not_found)
    }

    fn cut(&self, name: &str, length: u64) -> io::Result<()> {
        let mut state = self.call()?;
        let place = state.place(name)?;
        let file = state.file(place)?;
        file.bytes.truncate(usize::try_from(length).unwrap_or(usize::MAX));
        file.synced = file.bytes.len();
        Ok(())
    }

    fn sync_folder(&self) -> io::Result<()> {
        let mut state = self.call()?;
        state.names_synced = state.names.clone();
        state.forget_nameless();
        Ok(())
    }
}

#[derive(Debug)]
struct MemoryFile {
    disk: MemoryDisk,
    place: u64,
    /// Read up to here.
    at: usize,
}

impl Read for MemoryFile {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let mut state = self.disk.call()?;
        let readable = state.faults.readable.unwrap_or(usize::MAX);
        let bytes = &state.file(self.place)?.bytes;
        let end = readable.min(bytes.len());
        let mut rest = bytes.get(self.at..end).unwrap_or_default();
        if rest.is_empty() && end < bytes.len() {
            return Err(broken());
        }
        let read = rest.read(buffer)?;
        self.at += read;
        Ok(read)
    }
}

impl Write for MemoryFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut state = self.disk.call()?;
        let fitting = state.faults.room.unwrap_or(bytes.len()).min(bytes.len());
        if fitting == 0 && !bytes.is_empty() {
            return Err(io::ErrorKind::StorageFull.into());
        }
        if let Some(room) = &mut state.faults.room {
            *room -= fitting;
        }
        state.file(self.place)?.bytes.extend_from_slice(&bytes[..fitting]);
        let all = state.names.values().map(|place| state.files[place].bytes.len()).sum();
        state.bytes_most = state.bytes_most.max(all);
        Ok(fitting)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl DiskFile for MemoryFile {
    fn sync(&mut self) -> io::Result<()> {
        let mut state = self.disk.call()?;
        state.syncs += 1;
        if state.faults.sync {
            return Err(broken());
        }
        let file = state.file(self.place)?;
        file.synced = file.bytes.len();
        Ok(())
    }
}
