//! A disk in memory, for tests and simulations: it fails where it is to, and forgets what was not safe when
//! its power is cut.

use std::collections::BTreeMap;
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
    /// Calls of [`Disk`] and [`DiskFile`], and reads and writes of files, that fail, by their number:
    /// [`MemoryDisk::calls`].
    pub calls: Range<u64>,
    /// Bytes that can still be written; then a write takes what fits, and the next one fails.
    pub room: Option<usize>,
    /// No file can be made safe.
    pub sync: bool,
    /// No file can be made.
    pub create: bool,
    /// No file can be removed.
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
    names: BTreeMap<String, SharedFile>,
    names_synced: BTreeMap<String, SharedFile>,
    faults: Faults,
    calls: u64,
    syncs: u64,
    bytes_most: usize,
}

/// A file, whatever its name is now. Locked after the disk, never before it.
type SharedFile = Arc<Mutex<Contents>>;

#[derive(Debug, Default)]
struct Contents {
    bytes: Vec<u8>,
    /// So many of them are safe.
    synced: usize,
}

impl Contents {
    fn truncate(&mut self, length: usize) {
        self.bytes.truncate(length);
        self.synced = self.bytes.len();
    }
}

impl MemoryDisk {
    /// A disk with these files, all of them safe.
    pub fn of(files: BTreeMap<String, Vec<u8>>) -> Self {
        let disk = Self::default();
        files.into_iter().for_each(|(name, bytes)| disk.put(&name, bytes));
        disk
    }

    /// A file that is there and safe; one of that name is replaced.
    pub fn put(&self, name: &str, bytes: Vec<u8>) {
        let mut state = self.state();
        let file = SharedFile::new(Mutex::new(Contents { synced: bytes.len(), bytes }));
        state.names.insert(name.to_owned(), Arc::clone(&file));
        state.names_synced.insert(name.to_owned(), file);
    }

    /// All files, as a program sees them.
    pub fn files(&self) -> BTreeMap<String, Vec<u8>> {
        let state = self.state();
        state.names.iter().map(|(name, file)| (name.clone(), locked(file).bytes.clone())).collect()
    }

    /// From now on these things fail, and no others.
    pub fn set_faults(&self, faults: Faults) {
        self.state().faults = faults;
    }

    /// Calls so far, failed ones too.
    pub fn calls(&self) -> u64 {
        self.state().calls
    }

    /// How often a file was made safe, or was to be.
    pub fn syncs(&self) -> u64 {
        self.state().syncs
    }

    /// Most bytes that all files had together.
    pub fn bytes_most(&self) -> usize {
        self.state().bytes_most
    }

    /// The power is cut and comes back: what was not safe is gone, as far as `cut` says. Who has a file open
    /// must not go on writing to it.
    pub fn cut_power(&self, cut: PowerCut) {
        let mut state = self.state();
        let State { names, names_synced, .. } = &mut *state;
        if cut.names_kept {
            names_synced.clone_from(names);
        } else {
            names.clone_from(names_synced);
        }
        for file in names.values() {
            let mut file = locked(file);
            let kept = file.synced.saturating_add(cut.bytes_kept);
            file.truncate(kept);
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        locked(&self.0)
    }

    /// A call begins; fails if it is to.
    fn call(&self) -> io::Result<MutexGuard<'_, State>> {
        let mut state = self.state();
        let number = state.calls;
        state.calls += 1;
        if state.faults.calls.contains(&number) { Err(broken()) } else { Ok(state) }
    }
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn broken() -> io::Error {
    io::Error::other("input/output error")
}

fn not_found() -> io::Error {
    io::ErrorKind::NotFound.into()
}

fn denied(is_denied: bool) -> io::Result<()> {
    if is_denied { Err(io::ErrorKind::PermissionDenied.into()) } else { Ok(()) }
}

impl State {
    fn file(&self, name: &str) -> io::Result<SharedFile> {
        self.names.get(name).cloned().ok_or_else(not_found)
    }
}

impl Disk for MemoryDisk {
    fn names(&self) -> io::Result<Vec<String>> {
        Ok(self.call()?.names.keys().cloned().collect())
    }

    fn length(&self, name: &str) -> io::Result<u64> {
        let file = self.call()?.file(name)?;
        Ok(locked(&file).bytes.len() as u64)
    }

    fn read(&self, name: &str) -> io::Result<Box<dyn Read>> {
        let file = self.call()?.file(name)?;
        Ok(Box::new(MemoryFile { disk: self.clone(), file, at: 0 }))
    }

    fn create(&self, name: &str) -> io::Result<Box<dyn DiskFile>> {
        let mut state = self.call()?;
        denied(state.faults.create)?;
        if state.names.contains_key(name) {
            return Err(io::ErrorKind::AlreadyExists.into());
        }
        let file = state.names.entry(name.to_owned()).or_default();
        Ok(Box::new(MemoryFile { disk: self.clone(), file: Arc::clone(file), at: 0 }))
    }

    fn rename(&self, from: &str, to: &str) -> io::Result<()> {
        let mut state = self.call()?;
        let file = state.names.remove(from).ok_or_else(not_found)?;
        state.names.insert(to.to_owned(), file);
        Ok(())
    }

    fn remove(&self, name: &str) -> io::Result<()> {
        let mut state = self.call()?;
        denied(state.faults.remove)?;
        state.names.remove(name).map(drop).ok_or_else(not_found)
    }

    fn cut(&self, name: &str, length: u64) -> io::Result<()> {
        let file = self.call()?.file(name)?;
        locked(&file).truncate(usize::try_from(length).unwrap_or(usize::MAX));
        Ok(())
    }

    fn sync_folder(&self) -> io::Result<()> {
        let mut state = self.call()?;
        state.names_synced = state.names.clone();
        Ok(())
    }
}

#[derive(Debug)]
struct MemoryFile {
    disk: MemoryDisk,
    file: SharedFile,
    /// Read up to here.
    at: usize,
}

impl Read for MemoryFile {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let state = self.disk.call()?;
        let file = locked(&self.file);
        let end = state.faults.readable.unwrap_or(usize::MAX).min(file.bytes.len());
        let mut rest = file.bytes.get(self.at..end).unwrap_or_default();
        if rest.is_empty() && end < file.bytes.len() {
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
        locked(&self.file).bytes.extend_from_slice(&bytes[..fitting]);
        let all = state.names.values().map(|file| locked(file).bytes.len()).sum();
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
        let mut file = locked(&self.file);
        file.synced = file.bytes.len();
        Ok(())
    }
}
