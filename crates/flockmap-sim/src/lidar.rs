//! LiDAR models: where the beams of a scan point, and what they return in a world.

use crate::World;
use crate::random::{Random, hash_at};
use core::f64::consts::TAU;
use flockmap_grid::{Pose, Scan, Stamp};
use libm::{cos, sin};
use thiserror::Error;

/// Time between the starts of two scans: 0.1 s.
pub const SCAN_PERIOD_MICROS: i64 = 100_000;

/// A LiDAR: a scan pattern in the frame of the sensor (x forward, y left, z up), 10 scans a second.
///
/// Patterns run on with time and hardly ever repeat; which beams a scan has depends on its stamp alone.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub enum Lidar {
    /// Livox Avia: looks forward, 70.4° × 77.2°, 24,000 beams a scan. The rosette of the MARSIM simulator:
    /// two rotations of 7,294 and −4,664 rpm added up, one base point each 25 µs, on 6 rows 1.4° apart.
    Avia,
    /// Livox Mid-360: looks all around, −7° … +52°, 20,000 beams a scan, 5 µs apart. Rate of azimuth
    /// (62,050.63 °/s) and shape of the elevation (22.5° + 25.5° · cos 10 Hz + 4° · wobble) are MARSIM's;
    /// azimuth is not rounded to whole degrees as there, and the wobble is a product of cosines of 1,137.1
    /// and 87.3 Hz, so that scan lines fall elsewhere in each scan as they do on the real device.
    #[default]
    Mid360,
}

/// How a scan is taken.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct ScanOptions {
    /// Metres beyond which nothing is seen; more than 0. Default 30.
    pub range_m: f64,
    /// Metres below which returns are dropped. Default 0.3.
    pub min_range_m: f64,
    /// Whether beams that hit nothing are delivered in [`Scan::no_returns`], as points at `range_m`. Most
    /// real drivers deliver none. Default false.
    pub no_returns: bool,
    /// Standard deviation of the noise on the range of a return, in metres; about 0.02 for the real devices.
    /// Default 0.
    pub range_noise_m: f64,
    /// Seed of that noise.
    pub seed: u64,
}

impl Default for ScanOptions {
    fn default() -> Self {
        Self { range_m: 30.0, min_range_m: 0.3, no_returns: false, range_noise_m: 0.0, seed: 0 }
    }
}

/// A name that is no LiDAR's.
#[derive(Clone, PartialEq, Eq, Debug, Error)]
#[error("\"{0}\" is no LiDAR: use mid360 or avia")]
pub struct UnknownLidar(String);

impl core::str::FromStr for Lidar {
    type Err = UnknownLidar;

    fn from_str(name: &str) -> Result<Self, UnknownLidar> {
        match name {
            "avia" => Ok(Self::Avia),
            "mid360" | "mid-360" => Ok(Self::Mid360),
            _ => Err(UnknownLidar(name.to_owned())),
        }
    }
}

impl core::fmt::Display for Lidar {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Avia => "avia",
            Self::Mid360 => "mid360",
        })
    }
}

impl Lidar {
    /// Number of beams in a scan.
    pub const fn beams(self) -> usize {
        match self {
            Self::Avia => 24_000,
            Self::Mid360 => 20_000,
        }
    }

    /// Lowest and highest azimuth and elevation of any beam, in degrees.
    pub const fn field_of_view_deg(self) -> ([f64; 2], [f64; 2]) {
        match self {
            Self::Avia => ([-35.2, 35.2], [-38.6, 38.6]),
            Self::Mid360 => ([-180.0, 180.0], [-7.0, 52.0]),
        }
    }

    /// The beams of the scan that starts at `stamp`: unit vectors in the frame of the sensor, in the order
    /// they are fired.
    pub fn directions(self, stamp: Stamp) -> Vec<[f64; 3]> {
        match self {
            Self::Avia => avia(stamp),
            Self::Mid360 => mid360(stamp),
        }
    }

    /// The scan taken in `world` from a sensor at `T_map_sensor`, all beams at once (no distortion by
    /// motion).
    ///
    /// A point lies where its beam enters a solid cell, moved inside of the cell by at most 1 % of its side
    /// on each axis; so without noise the cell at a point is always solid. Cost: 20,000 beams in the
    /// generated forest take a few milliseconds on one core.
    #[allow(non_snake_case)]
    pub fn scan(self, world: &World, T_map_sensor: &Pose, stamp: Stamp, options: &ScanOptions) -> Scan {
        let rows = T_map_sensor.rotation_rows();
        let origin = T_map_sensor.translation();
        let mut noise =
            (options.range_noise_m > 0.0).then(|| Random::new(options.seed, hash_at(0x5ca9, stamp.0, 0, 0)));
        let mut scan = Scan { stamp, ..Scan::default() };
        for beam in self.directions(stamp) {
            let direction = rows.map(|row| row[0] * beam[0] + row[1] * beam[1] + row[2] * beam[2]);
            match world.cast_ray(origin, direction, options.range_m) {
                Some(hit) if hit.distance_m >= options.min_range_m => {
                    let offset: [f64; 3] = core::array::from_fn(|a| hit.point[a] - origin[a]);
                    let shift = noise.as_mut().map_or(0.0, |random| random.normal() * options.range_noise_m);
                    scan.points.push(core::array::from_fn(|a| {
                        let along = rows[0][a] * offset[0] + rows[1][a] * offset[1] + rows[2][a] * offset[2];
                        (along + beam[a] * shift) as f32
                    }));
                }
                Some(_) => {}
                None if options.no_returns => {
                    scan.no_returns.push(beam.map(|v| (v * options.range_m) as f32));
                }
                None => {}
            }
        }
        scan
    }
}

/// Phase in radians at a time of something that turns `millionths` · 10⁻⁶ times a second. Whole numbers, so
/// that it is as exact after a year as after a second.
fn phase(micros: i64, millionths: i64) -> f64 {
    let turns = i128::from(micros) * i128::from(millionths) % 1_000_000_000_000;
    turns as f64 / 1e12 * TAU
}

fn avia(stamp: Stamp) -> Vec<[f64; 3]> {
    let mut beams = Vec::with_capacity(Lidar::Avia.beams());
    let row = (1.4_f64.to_radians(), [-2.0, -1.0, 0.0, 1.0, 2.0, 3.0]);
    let turn = row.1.map(|n| (cos(n * row.0), sin(n * row.0)));
    for base in 0..4_000 {
        let micros = stamp.0.wrapping_add(base * 25);
        // 7,294 and −4,664 turns a minute.
        let (a, b) = (phase(micros, 121_566_667), phase(micros, -77_733_333));
        let azimuth = (0.24 * 70.4 * (cos(a) + cos(b))).to_radians();
        let elevation = (0.215 * 77.2 * (sin(a) + sin(b))).to_radians();
        let (flat, up) = (cos(elevation), sin(elevation));
        let (forward, left) = (cos(azimuth), sin(azimuth));
        for (c, s) in turn {
            // Elevation raised by the angle of the row.
            let flat_row = flat * c - up * s;
            beams.push([flat_row * forward, flat_row * left, up * c + flat * s]);
        }
    }
    beams
}

fn mid360(stamp: Stamp) -> Vec<[f64; 3]> {
    let mut beams = Vec::with_capacity(Lidar::Mid360.beams());
    for beam in 0..20_000 {
        let micros = stamp.0.wrapping_add(beam * 5);
        let azimuth = phase(micros, 172_362_861);
        let wobble = cos(phase(micros, 1_137_100_000)) * cos(phase(micros, 87_300_000));
        let elevation = (22.5 + 25.5 * cos(phase(micros, 10_000_000)) + 4.0 * wobble).to_radians();
        let flat = cos(elevation);
        beams.push([flat * cos(azimuth), flat * sin(azimuth), sin(elevation)]);
    }
    beams
}
