//! The codec `flock`: map changes as decisions of an arithmetic coder that learns. Explained in
//! `docs/codec.md`.
//!
//! From the bottom: the crate `flockmap-coder` turns bits into bytes; `tables`, `mixing` and `coding` give each decision
//! its probability, by what `voxel_contexts` and `flag_contexts` see round it.
//! `planes`, `cells`, `orientation` and `neighbourhood` lay out what is known of a block and round it;
//! `block` asks the decisions of one. `known`, `field`, `flags` and `order` are about many blocks; `model`
//! has all that a decision may look at. `section` is the payload; `batch` and `snapshot` are made of it, or
//! where there is no pattern of `gap_coding`.

mod adaptive_state;
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
mod flag_contexts;
mod flags;
mod gap_coding;
mod habits;
mod head;
mod known;
mod log2;
mod mixing;
mod model;
mod neighbourhood;
mod odds;
mod order;
mod orientation;
mod planes;
mod rays;
mod section;
mod snapshot;
mod tables;
#[cfg(feature = "training")]
pub mod training;
mod voxel_contexts;

pub(crate) use adaptive_state::CarriedState;
pub(crate) use batch::{decode_batch, encode_batch, sensor};
pub(crate) use section::Workspace;
pub(crate) use snapshot::{SnapshotWriter, decode_chunk};
