//! The options of a robot.

use flockmap_codec::Codec;
use flockmap_grid::{FusionConfig, MapperConfig, Preset, Resolution, RobotId};
use flockmap_sync::SessionConfig;

use crate::piece::PIECE_BYTES;

/// When a batch of mapping is closed and sent (the paper's Alg. 1, line 13).
///
/// Under a byte budget a batch that is due waits until the packages before it have been sent. What changes
/// meanwhile is merged in the map; then what the radio takes in a quarter of a second is sent at a time,
/// obstacles first (three parts of them for one of anything else), the nearest first. So obstacles stay fresh
/// where the radio takes less than the map changes, and free space gets late. A change that waited has the
/// stamp at which it is sent; free space that waited is not sent where a team-mate saw an obstacle in the
/// meantime.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema))]
#[cfg_attr(feature = "serde", serde(default, deny_unknown_fields))]
pub struct BatchConfig {
    /// A batch closes when this many voxels have changed: the paper's `d`. At least 1. Default 50,000.
    pub voxels_max: usize,
    /// A batch with changes closes after this time: the paper's `t_l`. Milliseconds, at least 1. Default 500.
    pub publish_period_ms: u32,
    /// Obstacles go out after this time, ahead of free space, which waits for `publish_period_ms`. Both go out
    /// earlier, with a scan, if the next scan is expected after the end of the period.
    /// Milliseconds, at least 1. Default `None`: both together after `publish_period_ms`.
    pub obstacle_period_ms: Option<u32>,
}

impl Default for BatchConfig {
    fn default() -> Self {
        Self { voxels_max: 50_000, publish_period_ms: 500, obstacle_period_ms: None }
    }
}

/// All options of a [`Robot`](crate::Robot).
#[derive(Clone, PartialEq, Debug)]
pub struct RobotConfig {
    /// Which robot of the swarm this is. No two may have the same.
    pub id: RobotId,
    /// Which run of this robot: [`epoch`](crate::epoch) of the seconds since 1970 and 32 random bits, new for
    /// **every** run. Two runs with the same epoch are taken for one, and what the second one publishes does
    /// not arrive. Default 1, for one that is never started again.
    pub epoch: u64,
    /// Its mapper.
    pub mapper: MapperConfig,
    /// When batches close.
    pub batch: BatchConfig,
    /// How its packages are coded. Packages of others are read in every codec. Default `flock`.
    pub codec: Codec,
    /// Batches are coded against what the others have received, where the codec can: it takes fewer bytes,
    /// and what was lost is waited for. Where it takes longer than this until nine of ten batches are whole
    /// at the slowest peer, they are coded independently, until it takes less than half of this.
    /// Milliseconds; 0: always against what the others have received. Default 2,000.
    pub repair_delay_max_ms: u32,
    /// How it talks to others, and limits on what they can make it hold.
    pub session: SessionConfig,
    /// How the layers become one map.
    pub fusion: FusionConfig,
    /// A state that would take more bytes while a snapshot of it is made goes in pieces, the oldest first: some 3 bytes for
    /// each voxel, and 140 to 300 for each block. At most three times `session.snapshot_bytes_max` counts. What cannot be
    /// cut may take 256 MiB, and is not made if it would take more. Default 48 MiB.
    pub snapshot_piece_bytes: usize,
    /// A submap begins after so many metres of way of the sensor
    /// ([`Robot::begin_submap`](crate::Robot::begin_submap)). Above 0. Default `None`: only when the driver says so.
    pub submap_length_m: Option<f64>,
    /// Returns within this distance of a team-mate's position are taken for the team-mate. Metres, 0 or more.
    /// Default 0.5.
    pub teammate_radius_m: f64,
    /// A team-mate's position counts for this long. Milliseconds; default 1,000.
    pub teammate_timeout_ms: u32,
    /// Moves requests of different robots apart in time. The id is mixed in, so the same seed for all will do.
    pub seed: u64,
}

impl RobotConfig {
    /// The defaults, with the `rog-map` preset at this resolution and range.
    pub fn new(id: RobotId, resolution: Resolution, range_m: f64) -> Self {
        Self {
            id,
            epoch: 1,
            mapper: MapperConfig::preset(Preset::RogMap, resolution, range_m),
            batch: BatchConfig::default(),
            codec: Codec::Flock,
            repair_delay_max_ms: 2_000,
            session: SessionConfig::default(),
            fusion: FusionConfig::default(),
            snapshot_piece_bytes: PIECE_BYTES,
            submap_length_m: None,
            teammate_radius_m: 0.5,
            teammate_timeout_ms: 1_000,
            seed: 0,
        }
    }
}

/// A configuration that cannot work.
#[derive(Clone, PartialEq, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RobotError {
    /// The mapper's part.
    #[error(transparent)]
    Mapper(#[from] flockmap_grid::ConfigError),
    /// The session's part.
    #[error(transparent)]
    Session(#[from] flockmap_sync::ConfigError),
    /// The batch's part.
    #[error("batch.{option} is 0, expected at least 1")]
    Batch {
        /// Name of the option, in [`BatchConfig`].
        option: &'static str,
    },
    /// The length of submaps.
    #[error("submap_length_m is {0}, expected a number above 0, or none")]
    SubmapLength(f64),
    /// How far newer submaps clear older ones.
    #[error("fusion.submap_clears_voxels is {0}, expected 0 to 7")]
    SubmapClears(u8),
}
