//! Simulated robots that plan on what they know: navigation on the fused map, exploration, and the
//! application of the paper.
//!
//! Everything is deterministic: the same seed gives the same bytes on every machine. Only the basic
//! operations and the square root of `f64`, which IEEE 754 fixes to the last bit, and the pure-Rust sines of
//! `libm` are used.
#![forbid(unsafe_code)]

pub mod application;
mod exploration;
mod navigation;
mod threads;

pub use exploration::{Ended, ExploreError, ExploreOptions, Explorer, Outcome, Progress, RobotProgress};
pub use navigation::{
    CellState, Motion, MotionLimits, NavigationConfig, NavigationError, NavigationGrid, NoRoute, RouteQuery,
    Router,
};
