//! What a sensor sees from a place, as far as a planner knows.

use crate::{CellState, NavigationGrid};
use core::f64::consts::PI;
use flockmap_worlds::Lidar;
use flockmap_worlds::curve::wrapped;
use libm::{atan2, cos, exp, sin, tan};

/// Rays around and from the lowest to the highest elevation: those by which a place is judged, and those of a
/// look, which has to come to every cell that a scan comes to.
const FAN: [usize; 2] = [60, 12];
const LOOK_FAN: [usize; 2] = [120, 36];

/// Metres of Unknown space behind which nothing is expected to be seen.
const DEPTH_M: f64 = 2.0;

/// Metres of Unknown space that let one ray in e (2.7) through: what is unknown is mostly so because
/// something hides it.
const FADE_M: f64 = 0.9;

/// The reach of a LiDAR on a robot that flies level.
#[derive(Clone, Debug)]
pub(super) struct Sight {
    /// Half of the angle seen left and right, radians; π or more: all around.
    half_azimuth: f64,
    /// Tangents of the lowest and highest elevation.
    slopes: [f64; 2],
    pub(super) range_m: f64,
    fan: Fan,
    look_fan: Fan,
}

/// Directions that stand for all, in the sensor's frame, each with its solid angle.
type Fan = Vec<([f64; 3], f64)>;

impl Sight {
    pub(super) fn new(lidar: Lidar, range_m: f64) -> Self {
        let (azimuth, elevation) = lidar.field_of_view_deg();
        let [azimuth, elevation] = [azimuth, elevation].map(|range| range.map(f64::to_radians));
        Self {
            half_azimuth: 0.5 * (azimuth[1] - azimuth[0]),
            slopes: elevation.map(tan),
            range_m,
            fan: fan(azimuth, elevation, FAN),
            look_fan: fan(azimuth, elevation, LOOK_FAN),
        }
    }

    /// Whether a point is within range, elevation and (for a yaw, if it matters) azimuth.
    pub(super) fn covers(&self, from: [f64; 3], yaw: Option<f64>, to: [f64; 3]) -> bool {
        let d: [f64; 3] = core::array::from_fn(|a| to[a] - from[a]);
        let flat_square = d[0] * d[0] + d[1] * d[1];
        if flat_square + d[2] * d[2] > self.range_m * self.range_m {
            return false;
        }
        let flat = flat_square.sqrt();
        if d[2] < self.slopes[0] * flat || d[2] > self.slopes[1] * flat {
            return false;
        }
        let is_all_around = self.half_azimuth >= PI - 1e-6;
        is_all_around || yaw.is_none_or(|yaw| wrapped(atan2(d[1], d[0]) - yaw).abs() <= self.half_azimuth)
    }

    /// Whether an Unknown cell next to a frontier cell can be seen that is worth it: in reach, and nothing
    /// but Free cells in between.
    pub(super) fn sees_beyond(
        &self,
        grid: &NavigationGrid,
        from: [f64; 3],
        yaw: Option<f64>,
        frontier: usize,
        is_worth: impl Fn(usize, u8) -> bool,
    ) -> bool {
        grid.cells.beside(frontier).any(|next| {
            let to = grid.cells.centre(next);
            is_worth(next, octant([to[0] - from[0], to[1] - from[1]]))
                && self.covers(from, yaw, to)
                && grid
                    .cells
                    .line_fits(from, to, |cell| cell == next || grid.cell_state(cell) == CellState::Free)
        })
    }

    /// About how many Unknown cells can be seen from a place. `probability` says for a cell and an octant how
    /// likely a ray comes back from there: 1 for what was never looked at, 0 for what it makes no sense to
    /// look at from there.
    pub(super) fn gain(
        &self,
        grid: &NavigationGrid,
        from: [f64; 3],
        yaw: f64,
        probability: impl Fn(usize, u8) -> f64,
    ) -> f64 {
        let step = grid.cells.side_m();
        let fade = exp(-step / FADE_M);
        let mut volume = 0.0;
        for (direction, solid_angle) in turned(&self.fan, yaw) {
            let octant = octant([direction[0], direction[1]]);
            let mut depth = 0.0;
            let mut likely = 1.0;
            let mut away = step;
            while away <= self.range_m && depth < DEPTH_M {
                let Some(cell) = grid.cells.cell_at(core::array::from_fn(|a| from[a] + direction[a] * away))
                else {
                    break;
                };
                match grid.cell_state(cell) {
                    CellState::Occupied => break,
                    CellState::Free => {}
                    CellState::Unknown => {
                        likely *= probability(cell, octant) * fade;
                        if likely == 0.0 {
                            // Nothing comes back from there, nor from behind it.
                            break;
                        }
                        depth += step;
                        volume += likely * away * away * step * solid_angle;
                    }
                }
                away += step;
            }
        }
        volume / (step * step * step)
    }

    /// The first Unknown cell in each direction of a look, behind nothing but Free ones, and the octant of
    /// the direction.
    pub(super) fn first_unknown<'a>(
        &'a self,
        grid: &'a NavigationGrid,
        from: [f64; 3],
        yaw: f64,
    ) -> impl Iterator<Item = (usize, u8)> + 'a {
        let step = grid.cells.side_m();
        // Far out rays are few, and the map is a little behind.
        let steps = (0.9 * self.range_m / step) as usize;
        turned(&self.look_fan, yaw).filter_map(move |(direction, _)| {
            let cell = |i: usize| {
                let away = (i + 1) as f64 * step;
                grid.cells.cell_at(core::array::from_fn(|a| from[a] + direction[a] * away))
            };
            let first = (0..steps).map_while(cell).find(|cell| grid.cell_state(*cell) != CellState::Free)?;
            (grid.cell_state(first) == CellState::Unknown)
                .then(|| (first, octant([direction[0], direction[1]])))
        })
    }
}

/// Rays between two azimuths and two elevations: so many around, so many up.
fn fan(azimuth: [f64; 2], elevation: [f64; 2], [around, up]: [usize; 2]) -> Fan {
    // Rings of equal solid angle lie at equal steps of the sine.
    let [low, high] = elevation.map(sin);
    let rise = (high - low) / up as f64;
    let turn = (azimuth[1] - azimuth[0]) / around as f64;
    let mut fan = Vec::with_capacity(around * up);
    for ring in 0..up {
        let z = low + (ring as f64 + 0.5) * rise;
        let flat = (1.0 - z * z).sqrt();
        for step in 0..around {
            let angle = azimuth[0] + (step as f64 + 0.5) * turn;
            fan.push(([flat * cos(angle), flat * sin(angle), z], rise * turn));
        }
    }
    fan
}

/// A fan as it is on a robot with this yaw.
fn turned(fan: &Fan, yaw: f64) -> impl Iterator<Item = ([f64; 3], f64)> + '_ {
    let (c, s) = (cos(yaw), sin(yaw));
    fan.iter().map(move |([x, y, z], solid_angle)| ([c * x - s * y, s * x + c * y, *z], *solid_angle))
}

/// Which eighth of the compass a direction lies in: 0 … 7, in no particular order.
fn octant([x, y]: [f64; 2]) -> u8 {
    u8::from(x < 0.0) | u8::from(y < 0.0) << 1 | u8::from(x.abs() < y.abs()) << 2
}
