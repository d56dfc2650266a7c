//! From the command line to what the library takes.

use anyhow::{Context, ensure};
use flockmap::grid::MapperConfig;
use flockmap::{Cast, CycleConfig, Resolution};

use crate::args::{CastName, MapArgs};

impl MapArgs {
    /// The side of a voxel.
    pub fn resolution(&self) -> anyhow::Result<Resolution> {
        Resolution::from_metres(self.resolution)
            .with_context(|| format!("--resolution is {}, expected 0.001 to 100 m", self.resolution))
    }

    /// The mapper's configuration.
    pub fn mapper(&self) -> anyhow::Result<MapperConfig> {
        Ok(MapperConfig::preset(self.mapper, self.resolution()?, self.range))
    }

    /// When cycles close.
    pub fn cycle(&self) -> anyhow::Result<CycleConfig> {
        ensure!(self.d > 0, "--d is 0, expected at least 1");
        let t_l_occupied_ms =
            self.t_l_occupied.map(|seconds| milliseconds("--t-l-occupied", seconds)).transpose()?;
        Ok(CycleConfig { changes_max: self.d, t_l_ms: milliseconds("--t-l", self.t_l)?, t_l_occupied_ms })
    }
}

/// Seconds from the command line as whole milliseconds.
pub fn milliseconds(option: &str, seconds: f64) -> anyhow::Result<u32> {
    ensure!((0.001..=3_600.0).contains(&seconds), "{option} is {seconds}, expected 0.001 to 3,600 s");
    Ok((seconds * 1e3).round() as u32)
}

impl From<CastName> for Cast {
    fn from(name: CastName) -> Self {
        match name {
            CastName::Unicast => Self::Unicast,
            CastName::Broadcast => Self::Broadcast,
        }
    }
}

impl CastName {
    pub const fn name(self) -> &'static str {
        match self {
            Self::Unicast => "unicast",
            Self::Broadcast => "broadcast",
        }
    }
}
