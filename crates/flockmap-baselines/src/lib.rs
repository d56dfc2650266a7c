//! Ways of telling others what a robot maps, ours and other people's, all behind the same two traits: a [`Sender`]
//! that makes messages and a [`Receiver`] that makes a map of them, from the bytes alone.
//!
//! Every rival is shown at its best, and every lossy or stale behaviour that it has is kept: [`Method::about`] says
//! in a sentence what is sent, what is kept, and where it comes from.
//!
//! ```
//! use flockmap_baselines::Method;
//! use flockmap_codec::Cycle;
//! use flockmap_grid::{Mapper, MapperConfig, Pose, Preset, Resolution, RobotId, Scan, Stamp, State, Stream, Voxel, Which};
//!
//! let config = MapperConfig::preset(Preset::RogMap, Resolution::from_metres(0.1).unwrap(), 7.0);
//! let method: Method = "paper".parse()?;
//! let (mut sender, mut receiver) = (method.sender(&config), method.receiver(&config)?);
//!
//! let mut mapper = Mapper::new(config.clone())?;
//! let scan = Scan { stamp: Stamp(100_000), points: vec![[2.05, 0.05, 0.05]], no_returns: Vec::new() };
//! mapper.insert(&scan, &Pose::IDENTITY, &[]);
//! let stream = Stream { origin: RobotId(1), epoch: 1 };
//! let resolution = config.resolution;
//! let cycle = Cycle { stream, start: Stamp(0), end: scan.stamp, resolution, sensor: [0; 3] };
//! let mut messages = Vec::new();
//! sender.cycle(scan.stamp, &cycle, &mapper.take_changes(Which::All), &mapper, &mut messages)?;
//! for message in &messages {
//!     receiver.receive(message)?;
//! }
//! assert_eq!(receiver.state(Voxel::new(20, 0, 0)), State::Occupied);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
#![forbid(unsafe_code)]

mod address_delta;
mod bytes;
mod colag;
mod error;
mod gvp;
mod map_receiver;
mod method;
mod morton;
mod octomap_diff;
mod package;
pub mod racer_code;
mod relay_points;
mod scan_relay;
mod state_map;
mod traits;

pub use error::{MapTooLarge, ReceiveError, SendError};
pub use method::{Method, UnknownMethod};
pub use state_map::{BLOCKS_MAX, StateMap};
pub use traits::{Observation, Receiver, Sender};
