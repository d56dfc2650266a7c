//! Flockmap for C. Each function says what it takes and gives; `include/flockmap.h` is made of these words by cbindgen,
//! and `cbindgen.toml` has what holds for all of them.
#![deny(unsafe_op_in_unsafe_fn)]

mod args;
mod collision;
mod event;
mod field;
mod file;
mod flat;
mod frontiers;
mod options;
mod result;
mod robot;
mod states;
mod transport;
mod view;
mod voxel;

pub use collision::*;
pub use event::*;
pub use field::*;
pub use file::*;
pub use flat::*;
pub use frontiers::*;
pub use options::*;
pub use result::*;
pub use robot::*;
pub use states::*;
pub use transport::*;
pub use view::*;
pub use voxel::*;
