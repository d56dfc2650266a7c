//! From the points of a scan to rays.

use super::config::{MapperConfig, RaysWalked};
use super::rays::{Ray, voxel_of};
use super::{ScanReport, Sphere};
use crate::{Pose, Voxel};

/// How points become rays, in voxel units.
pub(super) struct RayMaker {
    rotation: [[f64; 3]; 3],
    start: [f64; 3],
    from: Voxel,
    range: f64,
    range_min: f64,
    half_box: Option<[f64; 3]>,
    lowest_cut_end: Option<f64>,
    rays: RaysWalked,
    /// Centre and square of the radius of the spheres in which points are ignored.
    masks: Vec<([f64; 3], f64)>,
}

impl RayMaker {
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    pub(super) fn new(config: &MapperConfig, T_map_sensor: &Pose, teammates: &[Sphere]) -> Self {
        let scale = 1.0 / config.resolution.metres();
        let start = T_map_sensor.translation().map(|v| v * scale);
        Self {
            rotation: T_map_sensor.rotation_rows().map(|row| row.map(|v| v * scale)),
            start,
            from: voxel_of(start),
            range: config.range_m * scale,
            range_min: config.range_min_m * scale,
            half_box: config.update_box_m.map(|half| half.map(|h| h * scale)),
            lowest_cut_end: config.drop_cut_rays_below_m.map(|z| z * scale),
            rays: config.rays,
            masks: teammates
                .iter()
                .map(|s| (s.centre.map(|c| c * scale), (s.radius * scale).powi(2)))
                .collect(),
        }
    }

    /// Where all rays begin.
    pub(super) const fn start(&self) -> [f64; 3] {
        self.start
    }

    /// Which rays are walked.
    pub(super) const fn rays(&self) -> RaysWalked {
        self.rays
    }

    /// The ray to a point in the frame of the sensor, if it is one; `returned`: something is there.
    #[inline(always)]
    pub(super) fn ray(&self, point: &[f32; 3], returned: bool, report: &mut ScanReport) -> Option<Ray> {
        let Self { rotation, start, range, range_min, .. } = self;
        let p = point.map(f64::from);
        let d: [f64; 3] = core::array::from_fn(|axis| {
            rotation[axis][0] * p[0] + rotation[axis][1] * p[1] + rotation[axis][2] * p[2]
        });
        let length = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
        // Written so that a NaN is ignored.
        if !(length >= *range_min && length < f64::INFINITY) {
            report.ignored += 1;
            return None;
        }
        let end: [f64; 3] = core::array::from_fn(|axis| start[axis] + d[axis]);
        let is_within = |(c, radius2): &([f64; 3], f64)| {
            (0..3).map(|axis| (end[axis] - c[axis]).powi(2)).sum::<f64>() <= *radius2
        };
        if returned && self.masks.iter().any(is_within) {
            report.masked += 1;
            return None;
        }
        let mut part = if length > *range { range / length } else { 1.0 };
        if let Some(half) = self.half_box {
            for axis in 0..3 {
                if (d[axis] * part).abs() > half[axis] {
                    part = half[axis] / d[axis].abs();
                }
            }
        }
        let is_hit = returned && part == 1.0;
        let end = if part == 1.0 { end } else { core::array::from_fn(|axis| start[axis] + d[axis] * part) };
        if !is_hit && self.lowest_cut_end.is_some_and(|z| end[2] < z) {
            report.ignored += 1;
            return None;
        }
        *if is_hit { &mut report.hits } else { &mut report.cut } += 1;
        let to = voxel_of(end);
        let end = match self.rays {
            RaysWalked::All => end,
            RaysWalked::OnePerEndVoxel => [to.x, to.y, to.z].map(|index| f64::from(index) + 0.5),
        };
        Some(Ray::new(self.from, end, is_hit))
    }
}
