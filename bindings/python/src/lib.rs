//! Python bindings of Flockmap: the module `flockmap._flockmap`, which the package `flockmap` re-exports.
//!
//! Conventions: arrays in are read by [`arrays`] and copied piece by piece; the GIL is released wherever more than a few
//! microseconds are worked; what one thread at a time may use is behind [`shared`], of which nobody waits with the GIL held.

// What is public here is public to Python only.
#![allow(missing_docs, reason = "pyo3 makes items that have none")]

mod arrays;
mod collision;
mod errors;
mod event;
mod field;
mod frontiers;
mod given;
mod grid;
mod heights;
mod map_view;
mod node;
mod records;
mod robot;
mod shared;
mod values;
mod view;

/// The part of Flockmap that is in Rust.
#[pyo3::pymodule]
mod _flockmap {
    #[pymodule_export]
    use crate::collision::Collision;
    #[pymodule_export]
    use crate::errors::{ClosedError, ConfigError, DatagramError, Error, FileError, PoseError};
    #[pymodule_export]
    use crate::event::Event;
    #[pymodule_export]
    use crate::field::DistanceField;
    #[pymodule_export]
    use crate::frontiers::Frontier;
    #[pymodule_export]
    use crate::grid::OccupancyGrid;
    #[pymodule_export]
    use crate::heights::HeightMap;
    #[pymodule_export]
    use crate::map_view::MapView;
    #[pymodule_export]
    use crate::node::Node;
    #[pymodule_export]
    use crate::records::{Frame, Record, open_record};
    #[pymodule_export]
    use crate::robot::{Robot, ScanReport, Transmits};
}
