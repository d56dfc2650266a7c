//! Why a store cannot be used.

use std::io;
use std::path::PathBuf;

use crate::segment::{Identity, STORE_VERSION};

/// Why a store cannot be used. The text says what to do.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StoreError {
    /// The system refused something. No reason not to fly: [`Store::off`](crate::Store::off).
    #[error("store: cannot {what}: {error}")]
    Disk {
        /// What was asked of it.
        what: String,
        /// Its answer.
        error: io::Error,
    },
    /// Another node has this folder.
    #[error("store: {} is in use by another node: give each node a folder of its own", .0.display())]
    InUse(PathBuf),
    /// It belongs to another robot.
    #[error("store: {name} is of {got}, this is {own}: give it another folder, or empty this one")]
    Foreign {
        /// The segment that says so.
        name: String,
        /// Whose it is.
        got: Identity,
        /// Who wants it.
        own: Identity,
    },
    /// It was written by another version.
    #[error(
        "store: {name} has version {got}, this program knows version {STORE_VERSION}: move the folder away, or name another one, and start again. The map in it is lost to this \
         robot; what the team holds of it comes back over the radio"
    )]
    Version {
        /// The segment that says so.
        name: String,
        /// Its version.
        got: u8,
    },
    /// An option cannot work with this value.
    #[error("store: bytes_max is {0}, expected at least {least}", least = crate::store_log::BYTES_MAX_MIN)]
    BytesMax(u64),
    /// The epoch of the robot was used before.
    #[error("store: epoch {got} was used before: the last one was {last}, give a higher one")]
    Epoch {
        /// The epoch of this run.
        got: u64,
        /// The highest in the store.
        last: u64,
    },
}
