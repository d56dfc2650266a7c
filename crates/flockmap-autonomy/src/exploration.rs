//! Robots that explore a world together: each looks for what its own fused map does not show yet.
//!
//! A small relative of RACER's planner (Zhou et al., T-RO 2023): frontiers and viewpoints, a grid of regions
//! that two robots divide between them whenever they hear each other, tours, A* paths, limits of speed and
//! yaw rate. Each robot is a whole [`flockmap::Robot`] on an emulated radio and plans on nothing but its own
//! fused map, so a map that comes late costs it time: it looks at what others have seen already.

mod explorer;
mod frontier;
mod mates;
mod pilot;
mod regions;
mod seeable;
mod setup;
mod sight;
mod start;

use crate::{MotionLimits, NavigationError};
use flockmap::{BatchConfig, Codec, RobotError, SessionConfig};
use flockmap_grid::Resolution;
use flockmap_netsim::RadioConfig;
use flockmap_worlds::{Lidar, OptionError, ScanOptions};
use thiserror::Error;

pub use explorer::{Ended, Explorer, Outcome, Progress, RobotProgress};

/// How a world is explored.
#[derive(Clone, PartialEq, Debug)]
pub struct ExploreOptions {
    /// Number of robots, 1 … 64. Default 2.
    pub robots: usize,
    /// Seed of the radio, of the robots' sessions and of the scans' noise. Default 1.
    pub seed: u64,
    /// Side of a voxel of the maps. Default 0.1 m.
    pub resolution: Resolution,
    /// Range of the mapper in metres. Default 7.
    pub range_m: f64,
    /// LiDAR of every robot; it sits at the robot's centre. Default Mid-360.
    pub lidar: Lidar,
    /// How it scans. Default: with rays that hit nothing, so that the open sky differs from what was not
    /// looked at.
    pub scan: ScanOptions,
    /// The exploration ends after this time at the latest, in seconds. Default 600.
    pub seconds_max: f64,
    /// Speed, acceleration, yaw rate. Default 2 m/s, 2 m/s², 2 rad/s, as in MARSIM's launch files and RACER's
    /// planner.
    pub limits: MotionLimits,
    /// Least distance to anything Occupied in a robot's map, in metres. A robot that finds no path to what it
    /// could look at makes do with 0.1 m less, down to 0.2. Default 0.3.
    pub clearance_m: f64,
    /// Robots keep this far apart, centre to centre, in metres, 0.8 … 5. Default 1.
    pub separation_m: f64,
    /// What is to be explored: lowest and highest corner in metres. Default: the world's box in x and y, and its
    /// lowest 3 metres.
    pub region_m: Option<[[f64; 3]; 2]>,
    /// Lowest and highest flight in metres above the bottom of the region. Default 0.6 to 2.5, and never nearer
    /// than 0.3 m to the top of the region.
    pub height_m: [f64; 2],
    /// The radio between the robots. Its seed is mixed with [`Self::seed`].
    pub radio: RadioConfig,
    /// When robots close their batches.
    pub batch: BatchConfig,
    /// How they code their packages.
    pub codec: Codec,
    /// How their sessions run, with the byte budget.
    pub session: SessionConfig,
    /// Threads on which robots scan, map and plan, 1 … 64. What happens never depends on it. Default 1.
    pub threads: usize,
}

impl Default for ExploreOptions {
    fn default() -> Self {
        Self {
            robots: 2,
            seed: 1,
            resolution: Resolution::from_micrometres(100_000).expect("10 cm is within the limits"),
            range_m: 7.0,
            lidar: Lidar::default(),
            scan: ScanOptions { no_returns: true, ..ScanOptions::default() },
            seconds_max: 600.0,
            limits: MotionLimits { speed_m_s: 2.0, acceleration_m_s2: 2.0, yaw_rate_rad_s: 2.0 },
            clearance_m: 0.3,
            separation_m: 1.0,
            region_m: None,
            height_m: [0.6, 2.5],
            radio: RadioConfig::default(),
            batch: BatchConfig::default(),
            codec: Codec::Flock,
            session: SessionConfig::default(),
            threads: 1,
        }
    }
}

/// Why nothing can be explored.
#[derive(Clone, PartialEq, Debug, Error)]
#[non_exhaustive]
pub enum ExploreError {
    /// An option is out of its range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The region cannot be divided into cells.
    #[error(transparent)]
    Region(#[from] NavigationError),
    /// The options make no robot.
    #[error(transparent)]
    Robot(#[from] RobotError),
    /// The caller wanted no more.
    #[error("stopped before it began")]
    Stopped,
    /// There is no place to start.
    #[error(
        "no place to start for robot {robot} of {robots}: none with {clearance_m} m to anything solid between {heights_m:?} m (z) and {separation_m} m \
         to the other robots; try fewer robots, another region or height, or a smaller clearance"
    )]
    NoStart {
        /// Which robot, counted from 1.
        robot: usize,
        /// Number of robots.
        robots: usize,
        /// Clearance asked for.
        clearance_m: f64,
        /// Lowest and highest flight.
        heights_m: [f64; 2],
        /// Distance between robots asked for.
        separation_m: f64,
    },
}

#[cfg(test)]
mod tests;
