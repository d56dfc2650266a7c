//! The paper's codec (Sec. III): the states of all voxels of a box, two bits each along a Hilbert walk, then
//! zlib. And those that it is compared with: the same in nested order, with zlib and without, and a list of
//! addresses.
//!
//! Changes are cut in space until each piece fits. A snapshot has the stamp of every voxel beside its states.

mod addresses;
mod batch;
mod blocks;
mod codes;
mod fit;
mod grid;
mod hilbert;
mod snapshot;
mod stamps;
mod states;
mod voxels;

pub use hilbert::hilbert_order;

pub(crate) use batch::{decode_batch, encode_batch, encode_whole};
pub(crate) use fit::Writer;
pub(crate) use snapshot::{SnapshotWriter, decode_chunk};
pub(crate) use states::Scratch;
