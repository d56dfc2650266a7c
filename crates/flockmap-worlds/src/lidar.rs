//! LiDAR models: where the beams of a scan point, and what they return in a world.

mod body;
mod course;
mod model;
mod options;
mod pattern;
mod polar;
mod scanner;

pub use body::{Body, Shape, box_crossing};
pub use model::{Lidar, SCAN_PERIOD_MICROS};
pub use options::{Rendering, ScanOptions};
pub use scanner::Scanner;
