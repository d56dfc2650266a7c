//! The codec `flock`: map changes as decisions of an arithmetic coder that learns. Explained in
//! `docs/codec.md`.
//!
//! From the bottom: `coder` turns bits into bytes, `tables` and `coding` give each decision its probability.
//! `planes`, `cells`, `orientation` and `neighbourhood` lay out what is known of a block and round it;
//! `block` asks the decisions of one. `known`, `field`, `flags` and `order` are about many blocks; `model`
//! has all that a decision may look at. `section` is the payload; `batch` and `snapshot` are made of it, or
//! where there is no pattern of `gap_coding`.

#[cfg(feature = "training")]
mod adding;
mod batch;
mod block;
mod block_box;
mod cells;
mod choice;
mod coding;
mod decide;
mod field;
mod flags;
mod gap_coding;
mod habits;
mod head;
mod known;
mod log2;
mod mixing;
mod model;
mod neighbourhood;
mod order;
mod odds;
mod orientation;
mod planes;
mod rays;
mod flag_contexts;
mod section;
mod snapshot;
mod tables;
mod voxel_contexts;
#[cfg(feature = "training")]
pub mod training;

pub(crate) use batch::{decode_batch, encode_batch, sensor};
pub(crate) use section::Workspace;
pub(crate) use snapshot::{SnapshotWriter, decode_chunk};
