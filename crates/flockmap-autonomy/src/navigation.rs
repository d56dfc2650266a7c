//! How a robot finds paths in its own fused map: a coarse grid that follows the map, shortest paths through
//! it, and a body in motion.

mod grid;
mod motion;
mod route;

pub use grid::{CellState, NavigationConfig, NavigationError, NavigationGrid};
pub use motion::{Motion, MotionLimits};
pub use route::{NoRoute, RouteQuery, Router};

#[cfg(test)]
mod tests;
