//! What a sensor sees from a place, as far as a planner can tell.

use crate::navigation::wrapped;
use crate::{CellState, Lidar, NavigationGrid};
use libm::atan2;

/// The reach of a LiDAR on a robot that flies level.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sight {
    /// Half of the angle seen left and right, radians; π or more: all around.
    half_azimuth: f64,
    /// Tangents of the lowest and highest elevation.
    slopes: [f64; 2],
    range_m: f64,
}

impl Sight {
    pub(super) fn new(lidar: Lidar, range_m: f64) -> Self {
        let (azimuth, elevation) = lidar.field_of_view_deg();
        Self {
            half_azimuth: (0.5 * (azimuth[1] - azimuth[0])).to_radians(),
            slopes: elevation.map(|deg| libm::tan(deg.to_radians())),
            range_m,
        }
    }

    pub(super) const fn range_m(&self) -> f64 {
        self.range_m
    }

    /// Whether it sees all around, whatever the yaw.
    pub(super) fn is_all_around(&self) -> bool {
        self.half_azimuth >= core::f64::consts::PI - 1e-6
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
        match yaw {
            Some(yaw) if !self.is_all_around() => wrapped(atan2(d[1], d[0]) - yaw).abs() <= self.half_azimuth,
            _ => true,
        }
    }

    /// Whether an Unknown cell next to a frontier cell can be seen: in reach, and nothing but Free cells in between.
    pub(super) fn sees_beyond(
        &self,
        grid: &NavigationGrid,
        from: [f64; 3],
        yaw: Option<f64>,
        frontier: usize,
    ) -> bool {
        grid.beside(frontier).any(|next| {
            let to = grid.centre(next);
            grid.cell_state(next) == CellState::Unknown
                && self.covers(from, yaw, to)
                && grid.line_fits(from, to, |cell| cell == next || grid.cell_state(cell) == CellState::Free)
        })
    }
}
