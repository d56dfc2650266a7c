//! How robots are set in all rows.

use anyhow::Context;
use flockmap::grid::{MapperConfig, Preset};
use flockmap::{BatchConfig, Codec, Resolution, RobotConfig, RobotId};

/// The mapper of all rows: ROG-Map's rules, as on the paper's robots.
pub fn mapper(resolution_m: f64, range_m: f64) -> anyhow::Result<MapperConfig> {
    let resolution = Resolution::from_metres(resolution_m)
        .with_context(|| format!("a voxel side of {resolution_m} m, expected 0.001 to 100 m"))?;
    Ok(MapperConfig::preset(Preset::RogMap, resolution, range_m))
}

/// Batches that close after so many seconds, or so many changed voxels.
pub fn batch(publish_period_s: f64, voxels_max: usize) -> BatchConfig {
    BatchConfig {
        publish_period_ms: (publish_period_s * 1e3).round() as u32,
        voxels_max,
        ..BatchConfig::default()
    }
}

/// A robot of the whole stack. Its id is still to be given.
pub fn robot(mapper: MapperConfig, batch: BatchConfig, seed: u64) -> RobotConfig {
    let config = RobotConfig::new(RobotId(1), mapper.resolution, mapper.range_m);
    RobotConfig { mapper, batch, codec: Codec::Flock, seed, ..config }
}
