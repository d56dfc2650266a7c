//! The `flock` codec: map changes as decisions of an arithmetic coder that learns. Explained in `docs/codec.md`.

mod block;
mod cells;
mod choice;
mod coder;
mod coding;
mod cycle;
mod decide;
mod field;
mod noise;
mod order;
mod package;
pub(crate) mod present;
mod tables;
#[cfg(feature = "training")]
pub mod training;

pub(crate) use cycle::{Told, decode, encode, sensor};
pub(crate) use package::Workspace;
