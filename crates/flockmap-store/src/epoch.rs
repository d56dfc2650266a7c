//! The epoch of a run: higher than those of all runs before, as far as a disk or a clock knows them.
//! `docs/store.md` has the bytes of the file.

use std::io::{self, Read};
use std::sync::Arc;

use flockmap::RobotId;
use flockmap_mutation::{self as mutation, Mutation};

use crate::Disk;

/// The epoch of a new run: in the high 32 bits `seconds`, the time since 1970, or one more than `last` has
/// there, whichever is more; in the low 32 bits `random`, so that not even runs that a clock and a disk have
/// forgotten have the same one. A time before 1970 or after 2106 is not believed, and counts as 0.
///
/// Where the high bits are exhausted, which no clock can bring about, the low ones rise, by a part of 65,536
/// of what is left of them.
///
/// # Errors
/// [`EpochsExhausted`] if there is none higher than `last`.
pub fn next_epoch(last: Option<u64>, seconds: u64, random: u32) -> Result<u64, EpochsExhausted> {
    if mutation::is(Mutation::EpochRepeated) {
        return Ok(1 << 32);
    }
    let above = last.map_or(Some(0), |last| last.checked_add(1)).ok_or(EpochsExhausted)?;
    let believed = if seconds < u64::from(u32::MAX) { seconds } else { 0 };
    let high = last.map_or(believed, |last| believed.max((last >> 32) + 1));
    if high < u64::from(u32::MAX) {
        return Ok(flockmap::epoch(high as u32, random));
    }
    let lowest = above.max(u64::from(u32::MAX) << 32);
    let step = ((u64::MAX - lowest) >> 16).max(1);
    Ok(lowest + u64::from(random) % step)
}

/// Epoch 2⁶⁴ − 1 was used: there is no higher one.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
#[error("the last run had epoch {}, and there is no higher one", u64::MAX)]
pub struct EpochsExhausted;

const MAGIC: &[u8; 8] = b"FLKEPOCH";
const VERSION: u8 = 1;
const FILE_BYTES: usize = 28;

/// The file that keeps the epoch of the newest run of one robot in one swarm. Robots of a machine may have
/// theirs in one folder.
#[derive(Debug)]
pub struct EpochFile {
    disk: Arc<dyn Disk>,
    swarm: u16,
    robot: RobotId,
    last: Option<u64>,
}

/// What is wrong with an epoch file. Never a reason not to fly.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EpochFault {
    /// It does not say what such a file says.
    #[error("{name} {what}: it is not believed, and written anew")]
    Damaged {
        /// The file.
        name: String,
        /// How that shows.
        what: &'static str,
    },
    /// The system refused something.
    #[error("cannot {what} {name}: {error}")]
    Disk {
        /// What was asked of it.
        what: &'static str,
        /// The file.
        name: String,
        /// Its answer.
        error: io::Error,
    },
}

impl EpochFile {
    /// Looks at what the file says, if there is one. A file that cannot be read, or is damaged, is as good as
    /// none, and reported.
    pub fn open(disk: Arc<dyn Disk>, swarm: u16, robot: RobotId) -> (Self, Option<EpochFault>) {
        let mut file = Self { disk, swarm, robot, last: None };
        let fault = file.read().map(|last| file.last = last).err();
        (file, fault)
    }

    /// Its name in the folder: `epoch-SWARM-ROBOT`.
    pub fn name(&self) -> String {
        format!("epoch-{}-{}", self.swarm, self.robot)
    }

    /// The highest epoch that is safe in it.
    pub const fn last(&self) -> Option<u64> {
        self.last
    }

    /// Writes an epoch that is higher than the one in it. When this returns it is safe on disk. A crash at
    /// any moment leaves either the old file or the new one.
    ///
    /// # Errors
    /// [`EpochFault::Disk`]; as a rule the file says then what it said before.
    pub fn keep(&mut self, epoch: u64) -> Result<(), EpochFault> {
        if self.last.is_some_and(|last| last >= epoch) {
            return Ok(());
        }
        let name = self.name();
        let new = name.clone() + ".new";
        let write = || {
            // What a crash left.
            let _ = self.disk.remove(&new);
            let mut file = self.disk.create(&new)?;
            file.write_all(&self.bytes(epoch))?;
            file.sync()?;
            drop(file);
            self.disk.rename(&new, &name)?;
            self.disk.sync_folder()
        };
        write().map_err(|error| EpochFault::Disk { what: "write", name, error })?;
        self.last = Some(epoch);
        Ok(())
    }

    fn bytes(&self, epoch: u64) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(FILE_BYTES);
        bytes.extend_from_slice(MAGIC);
        bytes.extend_from_slice(&[VERSION, 0, 0, 0]);
        bytes.extend_from_slice(&self.swarm.to_le_bytes());
        bytes.extend_from_slice(&self.robot.0.to_le_bytes());
        bytes.extend_from_slice(&epoch.to_le_bytes());
        bytes.extend_from_slice(&crc32fast::hash(&bytes).to_le_bytes());
        bytes
    }

    fn read(&self) -> Result<Option<u64>, EpochFault> {
        let name = self.name();
        let mut bytes = Vec::new();
        let read = self.disk.read(&name).and_then(|file| file.take(64).read_to_end(&mut bytes));
        match read {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(EpochFault::Disk { what: "read", name, error }),
            Ok(_) => {}
        }
        let stated = bytes.get(16..24).and_then(|epoch| epoch.try_into().ok()).map(u64::from_le_bytes);
        // Whatever is not just as it would be written is no such file.
        match stated.filter(|epoch| bytes == self.bytes(*epoch)) {
            Some(epoch) => Ok(Some(epoch)),
            None => Err(EpochFault::Damaged { name, what: self.damage(&bytes) }),
        }
    }

    fn damage(&self, bytes: &[u8]) -> &'static str {
        let Some((content, check)) = bytes.split_last_chunk().filter(|_| bytes.len() == FILE_BYTES) else {
            return "has another length than an epoch file";
        };
        if !content.starts_with(MAGIC) || crc32fast::hash(content) != u32::from_le_bytes(*check) {
            "is damaged"
        } else if content[8] != VERSION {
            "is of another version"
        } else {
            "is of another robot"
        }
    }
}
