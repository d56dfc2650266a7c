//! How trajectories are flown, and why nobody can fly.

use crate::OptionError;
use flockmap_grid::Stamp;
use thiserror::Error;

/// Most robots of one plan.
pub const ROBOTS_MAX: usize = 64;

/// How trajectories are flown.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct TrajectoryOptions {
    /// How long to fly, in seconds, 0.1 … 14,400. Default 60.
    pub duration_s: f64,
    /// Highest speed in m/s, 0.1 … 20. Default 1.5.
    pub speed_m_s: f64,
    /// Highest acceleration along the path and across it, in m/s², 0.1 … 20. Default 1.
    pub acceleration_m_s2: f64,
    /// Highest yaw rate in rad/s, 0.1 … 10. Default 1.5.
    pub yaw_rate_rad_s: f64,
    /// Least distance to anything solid, in metres, 0.05 … 1, where space allows; see `clearance_min_m`.
    /// Default 0.5.
    pub clearance_m: f64,
    /// Least distance to anything solid in any case. Taken where more clearance would shut the robots out of
    /// more than a fifth of the space, such as by closing doors. Default 0.2.
    pub clearance_min_m: f64,
    /// Lowest and highest flight, in metres above the ground. Default 0.8 to 2.5.
    pub height_m: [f64; 2],
    /// Least distance between two robots at any time, in metres, 0 … 5. Default 1.
    pub separation_m: f64,
    /// Stamp of the first pose. Default 0.
    pub start: Stamp,
}

impl Default for TrajectoryOptions {
    fn default() -> Self {
        Self {
            duration_s: 60.0,
            speed_m_s: 1.5,
            acceleration_m_s2: 1.0,
            yaw_rate_rad_s: 1.5,
            clearance_m: 0.5,
            clearance_min_m: 0.2,
            height_m: [0.8, 2.5],
            separation_m: 1.0,
            start: Stamp(0),
        }
    }
}

/// Why nobody can fly.
#[derive(Clone, PartialEq, Debug, Error)]
#[non_exhaustive]
pub enum TrajectoryError {
    /// An option is out of its range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// There is no connected free space, whatever was tried.
    #[error(
        "no free space to fly in: a world of {size_m:?} m was searched in steps of {step_m} m for places at least {clearance_m} m from \
         anything solid and {heights:?} m above the ground; try another world, a smaller clearance, or finer cells"
    )]
    NoSpace {
        /// Size of the world.
        size_m: [f64; 3],
        /// Side of the cells that were searched.
        step_m: f64,
        /// The smallest clearance tried.
        clearance_m: f64,
        /// The bands of height tried.
        heights: Vec<[f64; 2]>,
    },
    /// There is space, but not for so many robots this far apart.
    #[error(
        "robot {robot} of {robots} finds no room of its own: {area_m2:.0} m² can be flown over at {clearance_m} m clearance; use fewer robots or \
         a smaller separation than {separation_m} m"
    )]
    Crowded {
        /// Which robot, counted from 0.
        robot: usize,
        /// Number of robots.
        robots: usize,
        /// Area of all the space in which one can fly.
        area_m2: f64,
        /// Clearance of that space.
        clearance_m: f64,
        /// Distance asked for between robots.
        separation_m: f64,
    },
}

impl TrajectoryOptions {
    /// Whether every option is in its range, for so many robots.
    ///
    /// # Errors
    /// The first that is not.
    pub fn check(&self, robots: usize) -> Result<(), OptionError> {
        OptionError::check(&[
            ("duration_s", self.duration_s, 0.1, 14_400.0, "0.1 to 14,400"),
            ("speed_m_s", self.speed_m_s, 0.1, 20.0, "0.1 to 20"),
            ("acceleration_m_s2", self.acceleration_m_s2, 0.1, 20.0, "0.1 to 20"),
            ("yaw_rate_rad_s", self.yaw_rate_rad_s, 0.1, 10.0, "0.1 to 10"),
            ("clearance_m", self.clearance_m, 0.05, 1.0, "0.05 to 1"),
            ("clearance_min_m", self.clearance_min_m, 0.05, self.clearance_m, "0.05 to clearance_m"),
            ("height_m[0]", self.height_m[0], 0.0, 1_000.0, "0 to 1,000"),
            ("height_m[1]", self.height_m[1], self.height_m[0], 1_000.0, "height_m[0] to 1,000"),
            ("separation_m", self.separation_m, 0.0, 5.0, "0 to 5"),
            ("robots", robots as f64, 1.0, ROBOTS_MAX as f64, "1 to 64"),
        ])
    }
}
