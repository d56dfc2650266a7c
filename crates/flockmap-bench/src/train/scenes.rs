//! What the tables are learned from: flights through generated worlds.
//!
//! Benchmarks fly with seed 1, so no seed here is 1: a codec must not be measured on what it has learned.
//! Nothing recorded is used, so that anybody can make the tables again from nothing but the repository.

use flockmap_worlds::Lidar;

use crate::place::Place;

/// How much of what is there a scan hits.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Scans {
    /// So many rays for each voxel that neighbours are seen together.
    Dense,
    /// Single rays show in the map.
    Sparse,
}

/// The voxels of a map and how far its mapper looks.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct MapSize {
    pub resolution_m: f64,
    pub range_m: f64,
}

/// One world and the flights through it. Every robot of it is mapped at every size.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Scene {
    pub scans: Scans,
    pub place: Place,
    /// Of the world, the flights and the noise.
    pub seed: u64,
    pub lidar: Lidar,
    /// Metres that the LiDAR sees.
    pub sight_m: f64,
    /// Share of returns that are lost.
    pub drop_out: f64,
    /// Standard deviation of ranges, in metres.
    pub noise_m: f64,
    /// Length of a flight.
    pub seconds: f64,
    /// Of so many scans, ten of which are a second, the last is mapped.
    pub every: usize,
    pub sizes: &'static [MapSize],
}

/// Robots of each scene, as in the benchmarks.
pub const ROBOTS: usize = 2;

const FINE: MapSize = MapSize { resolution_m: 0.1, range_m: 7.0 };
const COARSE: MapSize = MapSize { resolution_m: 0.2, range_m: 20.0 };
const FINE_OUTDOOR: MapSize = MapSize { resolution_m: 0.1, range_m: 15.0 };
const COARSE_OUTDOOR: MapSize = MapSize { resolution_m: 0.2, range_m: 30.0 };
const CAR: MapSize = MapSize { resolution_m: 0.2, range_m: 40.0 };

/// What a small drone with a LiDAR of its time sees near itself.
const DENSE: Scene = Scene {
    scans: Scans::Dense,
    place: Place::Forest,
    seed: 7,
    lidar: Lidar::Mid360,
    sight_m: 7.0,
    drop_out: 0.0,
    noise_m: 0.0,
    seconds: 60.0,
    every: 1,
    sizes: &[FINE],
};

/// What records of real, large places look like: far returns, most of them lost, noise, few scans a second.
const SPARSE: Scene = Scene {
    scans: Scans::Sparse,
    seed: 9,
    sight_m: 60.0,
    drop_out: 0.72,
    noise_m: 0.03,
    seconds: 80.0,
    every: 5,
    sizes: &[FINE_OUTDOOR],
    ..DENSE
};

/// All scenes. Those that take longest come first, so that no thread is left with one of them at the end.
pub const SCENES: &[Scene] = &[
    Scene { sizes: &[COARSE_OUTDOOR, FINE_OUTDOOR], ..SPARSE },
    Scene { seed: 14, sizes: &[COARSE_OUTDOOR, FINE_OUTDOOR], ..SPARSE },
    // The roof of a car: many rays, a scan every two seconds.
    Scene { seed: 11, lidar: Lidar::Os128, drop_out: 0.4, every: 20, sizes: &[CAR], ..SPARSE },
    Scene { seed: 15, lidar: Lidar::Os128, drop_out: 0.4, every: 20, sizes: &[CAR], ..SPARSE },
    Scene { seed: 8, sight_m: 30.0, sizes: &[COARSE], ..DENSE },
    DENSE,
    Scene { lidar: Lidar::Avia, ..DENSE },
    Scene { seed: 10, ..DENSE },
    Scene { seed: 10, lidar: Lidar::Avia, ..DENSE },
    Scene { place: Place::Indoor, ..SPARSE },
    Scene { place: Place::Indoor, ..DENSE },
    Scene { place: Place::Indoor, lidar: Lidar::Avia, ..DENSE },
    Scene { place: Place::Indoor, seed: 8, ..DENSE },
    Scene { place: Place::Indoor, seed: 8, lidar: Lidar::Avia, ..DENSE },
    Scene { seed: 12, ..DENSE },
    Scene { seed: 13, lidar: Lidar::Avia, ..DENSE },
    Scene { place: Place::Indoor, seed: 12, ..DENSE },
    Scene { place: Place::Indoor, seed: 13, lidar: Lidar::Avia, ..DENSE },
];

impl core::fmt::Display for Scene {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let Self { place, seed, lidar, seconds, .. } = self;
        write!(f, "{}, seed {seed}, {lidar}, {seconds:.0} s", place.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_scene_flies_where_benchmarks_fly() {
        assert!(SCENES.iter().all(|scene| scene.seed != 1));
    }
}
