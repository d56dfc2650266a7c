//! How a scan is taken.

use crate::OptionError;

/// How beams meet a world.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub enum Rendering {
    /// Exact: each beam is cast through the cells of the world. A point lies in a solid cell.
    #[default]
    Cast,
    /// As the MARSIM simulator does: the surface of the world as points 0.1 m apart, painted into an image of
    /// ranges with 0.2° a pixel. A point covers more pixels the nearer it is and lends them its tangent plane.
    /// Edges come out some centimetres too wide, as they do on a real device; beams that share a pixel give
    /// one point.
    Polar,
}

/// How a scan is taken.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct ScanOptions {
    /// Metres beyond which nothing is seen; more than 0. Default 30.
    pub range_m: f64,
    /// Metres below which returns are dropped. Default 0.3. (MARSIM: 1.)
    pub min_range_m: f64,
    /// Whether beams that hit nothing are delivered in [`Scan::no_returns`](flockmap_grid::Scan::no_returns),
    /// as points at `range_m`. Most real drivers deliver none. Default false.
    pub no_returns: bool,
    /// Standard deviation of the noise on the range of a return, in metres; about 0.02 for the real devices.
    /// Default 0.
    pub range_noise_m: f64,
    /// Share of the returns that are lost, 0 … 1. A lost beam is delivered neither as a point nor as a
    /// no-return. Default 0.
    pub drop_out: f64,
    /// Whether the sensor moves while it scans: each beam starts where the sensor is when it is fired, and
    /// its point is in the frame of the sensor at that moment (not corrected for motion). Default false.
    pub motion: bool,
    /// How beams meet the world. Default [`Rendering::Cast`].
    pub rendering: Rendering,
    /// Seed of noise and drop-out, which are drawn for each stamp and beam apart. Robots of a swarm should
    /// have different seeds.
    pub seed: u64,
}

impl Default for ScanOptions {
    fn default() -> Self {
        Self {
            range_m: 30.0,
            min_range_m: 0.3,
            no_returns: false,
            range_noise_m: 0.0,
            drop_out: 0.0,
            motion: false,
            rendering: Rendering::Cast,
            seed: 0,
        }
    }
}

impl ScanOptions {
    /// Whether every option is in its range. A scanner works with others too, but not as one would expect
    /// (with a negative range it sees nothing).
    ///
    /// # Errors
    /// The first that is not.
    pub fn check(&self) -> Result<(), OptionError> {
        OptionError::check(&[
            ("range_m", self.range_m, 0.1, 1_000.0, "0.1 to 1,000"),
            ("min_range_m", self.min_range_m, 0.0, self.range_m, "0 to range_m"),
            ("range_noise_m", self.range_noise_m, 0.0, 10.0, "0 to 10"),
            ("drop_out", self.drop_out, 0.0, 1.0, "0 to 1"),
        ])
    }
}

impl core::str::FromStr for Rendering {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        match name {
            "cast" => Ok(Self::Cast),
            "polar" => Ok(Self::Polar),
            _ => Err(format!("\"{name}\" is no rendering: use cast or polar")),
        }
    }
}

impl core::fmt::Display for Rendering {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Cast => "cast",
            Self::Polar => "polar",
        })
    }
}
