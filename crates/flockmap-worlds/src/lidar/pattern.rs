//! Where the beams of each LiDAR point.

use super::model::{Lidar, SCAN_PERIOD_MICROS};
use core::f64::consts::TAU;
use flockmap_grid::Stamp;
use libm::{cos, sin};

/// Columns of a spinning LiDAR in one turn, 0.2° apart.
const COLUMNS: usize = 1_800;

/// Rows of the VLP-32: how many, elevation of the lowest and step between two, in degrees.
const VLP32_ROWS: (usize, f64, f64) = (32, -25.0, 1.2);

/// Rows of the OS-128.
const OS128_ROWS: (usize, f64, f64) = (128, -22.5, 0.4);

impl Lidar {
    /// Number of beams in a scan.
    pub const fn beams(self) -> usize {
        match self {
            Self::Avia => 24_000,
            Self::Mid360 => 20_000,
            Self::Vlp32 => VLP32_ROWS.0 * COLUMNS,
            Self::Os128 => OS128_ROWS.0 * COLUMNS,
        }
    }

    /// The beams of the scan that starts at `stamp`: unit vectors in the frame of the sensor, in the order
    /// they are fired.
    pub fn directions(self, stamp: Stamp) -> Vec<[f64; 3]> {
        let mut beams = Vec::with_capacity(self.beams());
        match self {
            Self::Avia => avia(stamp, &mut beams),
            Self::Mid360 => mid360(stamp, &mut beams),
            Self::Vlp32 => spinning(VLP32_ROWS, &mut beams),
            Self::Os128 => spinning(OS128_ROWS, &mut beams),
        }
        beams
    }

    /// Microseconds from the start of a scan until this beam is fired, 0 … 99,999; never less than for the
    /// beam before. `beam` counts from 0 to [`Self::beams`].
    pub const fn fired_after_micros(self, beam: usize) -> i64 {
        let beam = beam as i64;
        match self {
            Self::Avia => beam / 6 * 25,
            Self::Mid360 => beam * 5,
            Self::Vlp32 => beam / VLP32_ROWS.0 as i64 * SCAN_PERIOD_MICROS / COLUMNS as i64,
            Self::Os128 => beam / OS128_ROWS.0 as i64 * SCAN_PERIOD_MICROS / COLUMNS as i64,
        }
    }
}

/// Phase in radians at a time of something that turns `millionths` · 10⁻⁶ times a second. Whole numbers, so
/// that it is as exact after a year as after a second.
fn phase(micros: i64, millionths: i64) -> f64 {
    let turns = i128::from(micros) * i128::from(millionths) % 1_000_000_000_000;
    turns as f64 / 1e12 * TAU
}

fn avia(stamp: Stamp, beams: &mut Vec<[f64; 3]>) {
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
}

fn mid360(stamp: Stamp, beams: &mut Vec<[f64; 3]>) {
    for beam in 0..20_000 {
        let micros = stamp.0.wrapping_add(beam * 5);
        let azimuth = phase(micros, 172_362_861);
        let wobble = cos(phase(micros, 1_137_100_000)) * cos(phase(micros, 87_300_000));
        let elevation = (22.5 + 25.5 * cos(phase(micros, 10_000_000)) + 4.0 * wobble).to_radians();
        let flat = cos(elevation);
        beams.push([flat * cos(azimuth), flat * sin(azimuth), sin(elevation)]);
    }
}

/// Column after column from behind to the left (counter-clockwise seen from above); the rows of a column,
/// lowest first, all at once.
fn spinning((rows, lowest_deg, step_deg): (usize, f64, f64), beams: &mut Vec<[f64; 3]>) {
    let row = |number: usize| {
        let elevation = (lowest_deg + step_deg * number as f64).to_radians();
        (cos(elevation), sin(elevation))
    };
    let rows: Vec<(f64, f64)> = (0..rows).map(row).collect();
    for column in 0..COLUMNS {
        let azimuth = (column as f64 * 0.2 - 180.0).to_radians();
        let (forward, left) = (cos(azimuth), sin(azimuth));
        beams.extend(rows.iter().map(|&(flat, up)| [flat * forward, flat * left, up]));
    }
}
