//! The options of the mapper: sensor model, range, limits; and the three presets.

use crate::Resolution;

/// Log-odds are whole numbers: 1,024 units are one natural unit (nat). One miss of the `rog-map` preset is 41
/// units.
pub const LOG_ODDS_UNITS_PER_NAT: f64 = 1024.0;

/// Most threads that take in a scan.
const THREADS_MAX: usize = 64;

/// Rules and values of a known mapper.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Preset {
    /// ROG-Map (its yaml files): every ray counts; hits win over the misses of the same scan; Unknown is a
    /// band of values between Free and Occupied. The default.
    #[default]
    RogMap,
    /// RACER's map with the values of C2-Explorer on LiDAR: one update a voxel and scan; the first touch decides.
    Racer,
    /// OctoMap's `insertPointCloud` with its default sensor model: one update a voxel and scan.
    #[cfg_attr(feature = "serde", serde(rename = "octomap"))]
    OctoMap,
}

impl core::str::FromStr for Preset {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        match name {
            "rog-map" => Ok(Self::RogMap),
            "racer" => Ok(Self::Racer),
            "octomap" => Ok(Self::OctoMap),
            _ => Err(format!("unknown mapper \"{name}\"; known are rog-map, racer and octomap")),
        }
    }
}

impl core::fmt::Display for Preset {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::RogMap => "rog-map",
            Self::Racer => "racer",
            Self::OctoMap => "octomap",
        })
    }
}

/// Which rays of a scan are walked.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum RaysWalked {
    /// All of them. The default.
    #[default]
    All,
    /// Of the rays that end in one voxel only the first, in the order of points and then of those without a return: less
    /// work, and fewer free voxels. Hits count as ever. Bonxai does the like.
    OnePerEndVoxel,
}

/// All options of a mapper. How hits and misses add up to a state is in probabilities, 0.001 … 0.999, so that
/// sums fit 16 bits.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema))]
#[cfg_attr(feature = "serde", serde(deny_unknown_fields))]
pub struct MapperConfig {
    /// Side of a voxel. The same for all robots of a swarm.
    #[cfg_attr(feature = "serde", serde(rename = "resolution_m"))]
    pub resolution: Resolution,
    /// Rays longer than this are cut there and end without a hit. Metres, above 0; at most 500 voxels.
    pub range_m: f64,
    /// Points nearer than this are ignored (the robot's own body). Metres; default 0.
    pub range_min_m: f64,
    /// Half extents in metres, along the axes of the map, of a box around the sensor: rays are cut at its
    /// faces and end there without a hit. `None`: only the range limits.
    pub update_box_m: Option<[f64; 3]>,
    /// Probability that a voxel is occupied, given one ray that ends in it. More than 0.5.
    pub p_hit: f64,
    /// Probability that a voxel is occupied, given one ray that passes through. Less than 0.5.
    pub p_miss: f64,
    /// Values are kept at this or above.
    pub p_min: f64,
    /// Values are kept at this or below.
    pub p_max: f64,
    /// A voxel at this or above is Occupied (above it, if `start_at_occupied`).
    pub p_occupied: f64,
    /// A voxel below this is Free. Between the two it is Unknown; equal to `p_occupied`: there is no band.
    pub p_free: f64,
    /// Whether each ray of a scan counts (ROG-Map), or a voxel changes once a scan (RACER, OctoMap).
    pub every_ray_counts: bool,
    /// Whether the first touch starts from `p_occupied` in place of 0.5, so that it decides the state (RACER).
    pub start_at_occupied: bool,
    /// Rays cut at the range or at the update box are dropped when they end below this height in the map
    /// frame, in metres (RACER: 0.2, so that the ground is not cleared by rays which never reached it).
    pub drop_cut_rays_below_m: Option<f64>,
    /// Which rays of a scan are walked.
    pub rays: RaysWalked,
    /// The blocks of the map and their tables are kept within this many bytes, also while a scan is taken in,
    /// by forgetting those farthest from the sensor: 2.6 kB a block at most. What scans need comes on top and
    /// is kept for the next one: 36 bytes for each point, and counts for each thread. Where a voxel changes once a scan,
    /// those are 68 bytes for each block of 8³ voxels of the box around the rays, its sides rounded up to powers of two,
    /// and 80 where rays end; else 8 bytes for each block of that box, 640 for each that is touched, and 640 where rays
    /// end (twice that where more than 255 rays count). For a moment, 0.9 kB a block and as much again of points and
    /// half of counts while lists grow. The worst case is [`Self::memory_max`]. Default 512 MiB.
    #[cfg_attr(feature = "serde", serde(rename = "memory_mb", with = "crate::units::Mebibytes"))]
    pub memory_bytes_max: usize,
    /// Threads that take in a scan together: the one that calls, and others that sleep between scans. One for each 4,096
    /// points at most. 1 to 64; default 1: none is made. In the file of a node: half of the cores, at most 4. The map does
    /// not depend on it. Where the system makes none, and in a fork of the process, the one that calls works alone.
    pub threads: usize,
}

impl MapperConfig {
    /// A preset's values at this resolution and range, with the default limits. Sources: ROG-Map's example
    /// yaml files; C2-Explorer's launch file; OctoMap's defaults.
    pub const fn preset(preset: Preset, resolution: Resolution, range_m: f64) -> Self {
        let rog_map = Self {
            resolution,
            range_m,
            range_min_m: 0.0,
            update_box_m: None,
            p_hit: 0.90,
            p_miss: 0.49,
            p_min: 0.12,
            p_max: 0.98,
            p_occupied: 0.85,
            p_free: 0.499,
            every_ray_counts: true,
            start_at_occupied: false,
            drop_cut_rays_below_m: None,
            rays: RaysWalked::All,
            memory_bytes_max: 512 << 20,
            threads: 1,
        };
        match preset {
            Preset::RogMap => rog_map,
            Preset::Racer => Self {
                p_miss: 0.48,
                p_min: 0.10,
                p_occupied: 0.80,
                p_free: 0.80,
                every_ray_counts: false,
                start_at_occupied: true,
                drop_cut_rays_below_m: Some(0.2),
                ..rog_map
            },
            Preset::OctoMap => Self {
                p_hit: 0.7,
                p_miss: 0.4,
                p_min: 0.1192,
                p_max: 0.971,
                p_occupied: 0.5,
                p_free: 0.5,
                every_ray_counts: false,
                ..rog_map
            },
        }
    }
}

/// A configuration that cannot work.
#[derive(Clone, PartialEq, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// The range is not positive or holds too many voxels.
    #[error("range_m is {range_m}, expected more than 0 and at most {max_m} (500 voxels of {resolution:?})")]
    Range {
        /// As configured.
        range_m: f64,
        /// The largest that is allowed.
        max_m: f64,
        /// As configured.
        resolution: Resolution,
    },
    /// A value of the sensor model is outside of what it may be beside the others.
    #[error("{option} is {got}, expected {expected}")]
    Probability {
        /// Name of the option.
        option: &'static str,
        /// As configured.
        got: f64,
        /// What would work.
        expected: String,
    },
    /// There are no threads, or too many.
    #[error("threads is {0}, expected 1 to {THREADS_MAX}")]
    Threads(usize),
    /// The update box has an extent that is not positive.
    #[error("update_box_m is {0:?}, expected three half extents in metres, each above 0")]
    UpdateBox([f64; 3]),
}

/// The sensor model in whole log-odds units, as the update wants it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Rules {
    pub(super) hit: i16,
    pub(super) miss: i16,
    pub(super) min: i16,
    pub(super) max: i16,
    /// Occupied from this value on.
    pub(super) occupied_from: i16,
    /// Free below this value.
    pub(super) free_below: i16,
    /// Value before the first touch.
    pub(super) start: i16,
    /// More rays than this through one voxel in one scan make no difference.
    pub(super) rays_max: u16,
    /// Nor do more rays that end there.
    pub(super) hits_max: u16,
}

impl MapperConfig {
    pub(super) fn rules(&self) -> Result<Rules, ConfigError> {
        let max_m = 500.0 * self.resolution.metres();
        if !(self.range_m > 0.0 && self.range_m <= max_m) {
            return Err(ConfigError::Range { range_m: self.range_m, max_m, resolution: self.resolution });
        }
        if !(1..=THREADS_MAX).contains(&self.threads) {
            return Err(ConfigError::Threads(self.threads));
        }
        if let Some(half) = self.update_box_m
            && !half.iter().all(|h| *h > 0.0)
        {
            return Err(ConfigError::UpdateBox(half));
        }
        let Self { p_hit, p_miss, p_min, p_max, p_occupied, p_free, .. } = *self;
        let probability = "a probability of 0.001 to 0.999";
        for (option, got, is_right, expected) in [
            ("p_hit", p_hit, p_hit > 0.5, "more than 0.5"),
            ("p_miss", p_miss, p_miss < 0.5, "less than 0.5"),
            ("p_min", p_min, p_min < p_free, &format!("less than p_free, which is {p_free}")),
            ("p_free", p_free, p_free <= p_occupied, &format!("at most p_occupied, which is {p_occupied}")),
            ("p_max", p_max, p_max > p_occupied, &format!("more than p_occupied, which is {p_occupied}")),
            ("p_occupied", p_occupied, true, ""),
        ] {
            let is_probability = (0.001..=0.999).contains(&got);
            if !(is_probability && is_right) {
                let expected = if is_probability { expected } else { probability }.to_owned();
                return Err(ConfigError::Probability { option, got, expected });
            }
        }
        let units = |p: f64| (libm::log(p / (1.0 - p)) * LOG_ODDS_UNITS_PER_NAT).round() as i16;
        let occupied = units(self.p_occupied);
        let (min, max, miss) = (units(self.p_min), units(self.p_max), units(self.p_miss).min(-1));
        let occupied_from = if self.start_at_occupied { occupied + 1 } else { occupied };
        let (hit, start) = (units(self.p_hit).max(1), if self.start_at_occupied { occupied } else { 0 });
        // Enough misses to go from the top to the bottom, or hits to go back; also keeps products within 16 bits.
        let most = |from: i16, to: i16, by: i16| {
            let width = (i32::from(to) - i32::from(from)).unsigned_abs();
            if self.every_ray_counts { width.div_ceil(i32::from(by).unsigned_abs()) as u16 } else { 1 }
        };
        Ok(Rules {
            hit,
            miss,
            min,
            max,
            occupied_from,
            free_below: if self.p_free == self.p_occupied { occupied_from } else { units(self.p_free) },
            start,
            rays_max: most(max, min, miss),
            hits_max: most(min.min(start), max, hit).min(most(max, min, miss)),
        })
    }
}
