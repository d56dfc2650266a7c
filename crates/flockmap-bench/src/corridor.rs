//! A straight flight past walls that are never the same: everything is new, and nothing is seen twice.

use flockmap::{Pose, Scan, Stamp};

/// A scan of 720 rays all around, whose ends are 4 to 5.6 m away, each time others. One every 0.2 s.
pub fn scan(step: u32) -> Scan {
    let rays = (0..60u32).flat_map(|i| (0..12u32).map(move |j| (i, j)));
    let points = rays.map(|(i, j)| {
        let around = i as f32 / 60.0 * core::f32::consts::TAU + step as f32 * 0.01;
        let up = (j as f32 - 6.0) * 0.1;
        let far = 4.0 + ((i * 7 + step * 3 + j) % 5) as f32 * 0.4;
        [far * up.cos() * around.cos(), far * up.cos() * around.sin(), far * up.sin()]
    });
    Scan { stamp: Stamp(i64::from(step) * 200_000), points: points.collect(), no_returns: Vec::new() }
}

/// Where it is made: 0.4 m after the one before.
pub fn pose(step: u32) -> Pose {
    Pose::from_translation([f64::from(step) * 0.4, 0.0, 0.0])
}

/// Scans of so many metres.
pub const fn scans(metres: u32) -> u32 {
    metres * 10 / 4
}
