//! The occupancy map of Flockmap: voxel geometry, block-sparse grids, the log-odds mapper, change tracking,
//! layers of what each robot reported, and their fusion into one map for a planner.
//!
//! This crate knows no bytes, no network and no clock: time comes in with each scan as a [`Stamp`].
//! Everything is deterministic: the same input gives the same map on every machine.
#![forbid(unsafe_code)]

mod block;
mod changes;
mod fusion;
mod layer;
mod mapper;
mod memory;
#[doc(hidden)]
mod origin;
mod packing;
mod pose;
mod scan;
mod snapshot;
mod states;
mod submap;
#[cfg(feature = "serde")]
#[doc(hidden)]
pub mod units;
mod unpacked;
mod varint;
mod voxel;

pub use block::{BLOCK_VOXELS, Plane, StateBlock, bit_of, meet, plane_within, set_bits, voxel_bit};
pub use changes::Changes;
pub use fusion::{Dropped, Fusion, FusionConfig, FusionError, MapView, RayEnd};
pub use layer::{BaseSuperseded, DiscardedLayer, LAYER_BLOCK_BYTES_MAX, Layer, SnapshotReader};
pub use mapper::{
    ConfigError, LOG_ODDS_UNITS_PER_NAT, MAP_BLOCK_BYTES, Mapper, MapperConfig, MovedBlock, Preset,
    RaysWalked, ScanReport, Sphere, Which,
};
pub use origin::{RobotId, Stamp, Stream, epoch, seconds_of_epoch};
pub use pose::{Pose, PoseError};
pub use scan::Scan;
pub use snapshot::{BlockRuns, Snapshot, SnapshotVoxels};
pub use states::{States, StatesError, StatesUpdate};
pub use submap::{Sheet, SubmapId, SubmapRecord};
pub use unpacked::UNPACKED_BYTES_MAX;
pub use voxel::{BLOCK_SIDE, BlockIndex, Resolution, State, VOXEL_LIMIT, Voxel, VoxelBox};
