//! What a robot keeps on disk, so that it has its map again after a reboot and every run an epoch of its own.
//! `docs/store.md` has the bytes.
//!
//! A store is a folder of segments, each a header and records that only ever grows. Every run begins a
//! segment of its own, and never writes to one of a former run. A store is opened ([`Store::open`]), gives
//! the robot what it has ([`Store::restore`]), and then takes what comes ([`Store::start`], [`StoreLog`]).
//! The epoch stands in the segments, and in a small file of its own ([`EpochFile`]).
//!
//! Nothing here has a thread, a clock or a random number of its own: who drives it hands in time and
//! packages, and asks what is due. A node does so on a thread, a simulation in virtual time on a disk in
//! memory ([`memory::MemoryDisk`]). A disk that fails, at any call, is reported ([`Notice`]) and counted
//! ([`StoreCounters`]); it never stops the robot.
#![forbid(unsafe_code)]

mod compaction;
mod counters;
mod disk;
mod epoch;
mod error;
mod folder;
mod inspect;
mod log;
pub mod memory;
mod record;
mod segment;
mod store;
mod store_log;
mod stream_copy;

pub use compaction::{Compacted, Compaction};
pub use counters::{Restored, StoreCounters};
pub use disk::{Disk, DiskFile};
pub use epoch::{EpochFault, EpochFile, EpochsExhausted, next_epoch};
pub use error::StoreError;
pub use folder::{Folder, others_may};
pub use inspect::{Inspection, SegmentFacts, StreamFacts, inspect, is_store};
pub use record::Contents;
pub use segment::{Identity, STORE_VERSION};
pub use store::Store;
pub use store_log::{BYTES_MAX_MIN, Notice, StoreLog, StoreOptions, contents_of, packages_of};
pub use stream_copy::{Coded, StreamCopy};
