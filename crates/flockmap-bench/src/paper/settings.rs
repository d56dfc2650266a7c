//! How robots are set in all rows.

use anyhow::Context;
use flockmap::grid::{MapperConfig, Preset};
use flockmap::{Codec, CycleConfig, Resolution, RobotConfig, RobotId};

/// The mapper of all rows: ROG-Map's rules, as on the paper's robots.
pub fn mapper(resolution_m: f64, range_m: f64) -> anyhow::Result<MapperConfig> {
    let resolution = Resolution::from_metres(resolution_m)
        .with_context(|| format!("a voxel side of {resolution_m} m, expected 0.001 to 100 m"))?;
    Ok(MapperConfig::preset(Preset::RogMap, resolution, range_m))
}

/// Cycles that close after so many seconds, or so many changed voxels.
pub fn cycle(t_l_s: f64, changes_max: usize) -> CycleConfig {
    CycleConfig { t_l_ms: (t_l_s * 1e3).round() as u32, changes_max, ..CycleConfig::default() }
}

/// A robot of the whole stack. Its id is still to be given.
pub fn robot(mapper: MapperConfig, cycle: CycleConfig, seed: u64) -> RobotConfig {
    let config = RobotConfig::new(RobotId(1), mapper.resolution, mapper.range_m);
    RobotConfig { mapper, cycle, codec: Codec::Flock, seed, ..config }
}
