//! What follows from the options.

use super::ExploreOptions;
use crate::{NavigationConfig, NavigationError};
use flockmap_worlds::{OptionError, ROBOTS_MAX, World};

/// Cells of the navigation grids up to which they stay 20 cm wide.
const CELLS_WANTED: f64 = 4e6;

/// The world's box in x and y, and its lowest 3 m.
pub(super) fn default_region(world: &World) -> [[f64; 3]; 2] {
    let side = world.resolution().metres();
    let (min, max) = (world.bounds().min(), world.bounds().max());
    let low = [min.x, min.y, min.z].map(|v| f64::from(v) * side);
    let high = [max.x, max.y, max.z].map(|v| f64::from(v + 1) * side);
    [low, [high[0], high[1], high[2].min(low[2] + 3.0)]]
}

/// Lowest and highest flight (z).
pub(super) fn heights(region_m: [[f64; 3]; 2], options: &ExploreOptions) -> [f64; 2] {
    let (floor, top) = (region_m[0][2], region_m[1][2]);
    [floor + options.height_m[0], (floor + options.height_m[1]).min(top - 0.3)]
}

/// What robots plan in: cells of 20 cm, larger in large worlds.
pub(super) fn navigation(
    region_m: [[f64; 3]; 2],
    options: &ExploreOptions,
) -> Result<NavigationConfig, NavigationError> {
    let volume = (0..3).map(|a| region_m[1][a] - region_m[0][a]).product::<f64>();
    let mut config = NavigationConfig::new(options.resolution, region_m);
    config.cell_m = config.cell_m.max(options.resolution.metres());
    while volume / (config.cell_m * config.cell_m * config.cell_m) > CELLS_WANTED {
        config.cell_m += options.resolution.metres();
        if config.cell_m > 8.0 * options.resolution.metres() {
            return Err(NavigationError::TooLarge {
                cells: core::array::from_fn(|a| ((region_m[1][a] - region_m[0][a]) / config.cell_m) as u32),
                cell_m: config.cell_m,
            });
        }
    }
    config.clearance_m = options.clearance_m;
    config.comfort_m = options.clearance_m + 0.2;
    Ok(config)
}

impl ExploreOptions {
    /// Whether every option is in its range.
    ///
    /// # Errors
    /// The first that is not.
    pub fn check(&self) -> Result<(), OptionError> {
        OptionError::check(&[
            ("robots", self.robots as f64, 1.0, ROBOTS_MAX as f64, "1 to 64"),
            ("threads", self.threads as f64, 1.0, 64.0, "1 to 64"),
            ("range_m", self.range_m, 1.0, 100.0, "1 to 100"),
            ("seconds_max", self.seconds_max, 0.1, 14_400.0, "0.1 to 14,400"),
            ("speed_m_s", self.limits.speed_m_s, 0.1, 20.0, "0.1 to 20"),
            ("acceleration_m_s2", self.limits.acceleration_m_s2, 0.1, 20.0, "0.1 to 20"),
            ("yaw_rate_rad_s", self.limits.yaw_rate_rad_s, 0.1, 10.0, "0.1 to 10"),
            ("clearance_m", self.clearance_m, 0.1, 1.0, "0.1 to 1"),
            ("separation_m", self.separation_m, 0.8, 5.0, "0.8 to 5"),
            ("height_m[0]", self.height_m[0], 0.0, 1_000.0, "0 to 1,000"),
            ("height_m[1]", self.height_m[1], self.height_m[0], 1_000.0, "height_m[0] to 1,000"),
        ])?;
        self.scan.check()
    }
}
