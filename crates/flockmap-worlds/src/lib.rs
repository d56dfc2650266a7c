//! Worlds, LiDAR models, and trajectories through them without collision.
//!
//! Everything is deterministic: the same seed gives the same bytes on every machine. Only the basic
//! operations and the square root of `f64`, which IEEE 754 fixes to the last bit, and the pure-Rust sines of
//! `libm` are used.
//!
//! ```
//! use flockmap_worlds::{Flight, Lidar, ScanOptions, Trajectory, TrajectoryOptions, World};
//! use std::sync::Arc;
//!
//! let world = Arc::new(World::indoor(1));
//! let options = TrajectoryOptions { duration_s: 1.0, ..TrajectoryOptions::default() };
//! let scan = ScanOptions { range_m: 7.0, ..ScanOptions::default() };
//! for trajectory in Trajectory::plan(&world, 2, 1, &options)? {
//!     let mut flight = Flight::new(Arc::clone(&world), Lidar::Mid360, scan, trajectory);
//!     let first = flight.next().expect("ten scans a second");
//!     assert!(!first.scan.points.is_empty());
//! }
//! # Ok::<(), flockmap_worlds::TrajectoryError>(())
//! ```
#![forbid(unsafe_code)]

mod cells;
pub mod curve;
mod flight;
mod lidar;
mod option_error;
pub mod random;
mod tracks;
mod trajectory;
mod world;

/// Why the place of a simulated robot is never refused.
pub const IN_THE_WORLD: &str = "simulated robots are in their world, which is small";

pub use flight::Flight;
pub use lidar::{Body, Lidar, Rendering, SCAN_PERIOD_MICROS, ScanOptions, Scanner, Shape, box_crossing};
pub use option_error::{Limit, OptionError};
pub use random::Random;
pub use tracks::{ObstacleOptions, Tracks, TracksError};
pub use trajectory::{ROBOTS_MAX, Trajectory, TrajectoryError, TrajectoryOptions};
pub use world::{Hit, OpenError, World, WorldError};
