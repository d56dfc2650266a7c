//! How a robot finds its way in its own fused map: a coarse grid that follows the map, shortest ways through
//! it, and a body in motion.

mod grid;
mod motion;
mod route;

pub use grid::{CellState, NavigationConfig, NavigationError, NavigationGrid};
pub(crate) use motion::wrapped;
pub use motion::{Motion, MotionLimits};
pub use route::{NoRoute, RouteQuery, Router};

#[cfg(test)]
mod tests;
