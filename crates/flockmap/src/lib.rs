//! Flockmap keeps the 3-D occupancy map of every robot of a swarm in sync over a thin, lossy radio.
//!
//! A [`Robot`] takes scans with poses and gives datagrams; it takes the datagrams of others and gives a map that
//! holds what any robot has seen. It knows no sockets, threads or clocks:
//!
//! ```
//! use flockmap::{Pose, Resolution, Robot, RobotConfig, RobotId, Scan, Stamp, State};
//!
//! let resolution = Resolution::from_metres(0.1).unwrap();
//! let mut alice = Robot::new(RobotConfig::new(RobotId(1), resolution, 7.0), Stamp(0))?;
//! let mut bob = Robot::new(RobotConfig::new(RobotId(2), resolution, 7.0), Stamp(0))?;
//!
//! // Alice sees a wall 2 m ahead of her; Bob sees nothing.
//! let points = (-10..10).map(|y| [2.05, y as f32 * 0.1 + 0.05, 0.05]).collect();
//! let scan = Scan { stamp: Stamp(100_000), points, no_returns: Vec::new() };
//! alice.insert_scan(scan.stamp, &scan, &Pose::IDENTITY)?;
//!
//! // A radio without loss. With loss it takes a little longer.
//! let mut now = scan.stamp;
//! while now < Stamp(3_000_000) {
//!     now = now.plus_micros(10_000);
//!     for robot in [&mut alice, &mut bob] {
//!         robot.handle_timeout(now);
//!     }
//!     while let Some(datagram) = alice.poll_transmit(now) {
//!         bob.handle_datagram(now, &datagram.bytes)?;
//!     }
//!     while let Some(datagram) = bob.poll_transmit(now) {
//!         alice.handle_datagram(now, &datagram.bytes)?;
//!     }
//! }
//! assert_eq!(bob.map().state_at([2.05, 0.05, 0.05]), State::Occupied);
//! assert_eq!(bob.map().state_at([1.0, 0.05, 0.05]), State::Free);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! The parts are crates of their own: [`grid`] (the map), [`codec`] (packages), [`sync`] (the session).
#![forbid(unsafe_code)]

mod config;
mod counters;
mod effort;
mod event;
mod events;
mod memory;
mod piece;
mod publisher;
mod readers;
mod republishing;
mod robot;
mod snapshots;
mod submaps;

pub use config::{BatchConfig, RobotConfig, RobotError};
pub use counters::RobotCounters;
pub use event::{Event, Refusal};
pub use flockmap_codec as codec;
pub use flockmap_codec::{Batch, Codec, Package};
pub use flockmap_grid as grid;
pub use flockmap_grid::{
    Changes, Fusion, FusionConfig, MapView, Mapper, MapperConfig, Pose, PoseError, Preset, RayEnd,
    RaysWalked, Resolution, RobotId, Scan, ScanReport, Sphere, Stamp, State, States, StatesError,
    StatesUpdate, Stream, SubmapId, Voxel, VoxelBox, epoch,
};
pub use flockmap_sync as sync;
pub use flockmap_sync::{Cast, Destination, Path, Session, SessionConfig, Transmit};
pub use piece::{PIECE_BYTES, Piece, PieceReader};
pub use publisher::Packer;
pub use robot::{KnownPose, REBUILD_BLOCKS, RestoreError, Robot};
pub use submaps::SubmapError;

#[cfg(doctest)]
#[doc = include_str!("../../../docs/submaps.md")]
struct Submaps;
