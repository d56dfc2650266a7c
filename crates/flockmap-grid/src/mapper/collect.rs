//! From the points of a scan to rays.

use super::config::{MapperConfig, RaysWalked};
use super::group::integers;
use super::ray::{Ray, voxel_of};
use super::report::{ScanReport, Sphere};
use super::tally::LANES;
use crate::{Pose, Voxel};
use fearless_simd::f64x8;
use fearless_simd::prelude::*;

/// Where points lie, in voxel units, by axes.
#[derive(Default)]
pub(super) struct Directions {
    /// From the start, in the frame of the map.
    d: [[f64; LANES]; 3],
    length: [f64; LANES],
    /// How much of it is within the range.
    part: [f64; LANES],
    /// Where rays end by that, and in which voxel.
    end: [[f64; LANES]; 3],
    to: [[i32; LANES]; 3],
}

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

    /// The voxel in which all rays begin.
    pub(super) const fn from(&self) -> Voxel {
        self.from
    }

    /// Where up to eight points in the frame of the sensor lie, by vector instructions.
    #[inline(always)]
    pub(super) fn directions<S: Simd>(&self, simd: S, points: &[[f32; 3]]) -> Directions {
        let all = |value: f64| f64x8::splat(simd, value);
        let mut p = [[f64::NAN; LANES]; 3];
        for (lane, point) in points.iter().enumerate().take(LANES) {
            for axis in 0..3 {
                p[axis][lane] = f64::from(point[axis]);
            }
        }
        let p = [0, 1, 2].map(|axis| f64x8::from_slice(simd, &p[axis]));
        let mut directions = Directions::default();
        let mut d = p;
        for (d, row) in d.iter_mut().zip(&self.rotation) {
            *d = all(row[0]) * p[0] + all(row[1]) * p[1] + all(row[2]) * p[2];
        }
        let length = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
        let part = length.simd_gt(all(self.range)).select(all(self.range) / length, all(1.0));
        length.store_slice(&mut directions.length);
        part.store_slice(&mut directions.part);
        for (axis, d) in d.into_iter().enumerate() {
            d.store_slice(&mut directions.d[axis]);
            let end = all(self.start[axis]) + d * part;
            end.store_slice(&mut directions.end[axis]);
            directions.to[axis] = integers(simd, end.floor());
        }
        directions
    }

    /// The ray to one of the points, if it is one, and the voxel in which it ends; `returned`: something is there.
    #[inline(always)]
    pub(super) fn ray(
        &self,
        directions: &Directions,
        lane: usize,
        returned: bool,
        report: &mut ScanReport,
    ) -> Option<(Ray, Voxel)> {
        let of = |values: &[[f64; LANES]; 3]| values.map(|values| values[lane]);
        let length = directions.length[lane];
        // Written so that a NaN is ignored.
        if !(length >= self.range_min && length < f64::INFINITY) {
            report.ignored += 1;
            return None;
        }
        if returned && self.is_masked(of(&directions.d)) {
            report.masked += 1;
            return None;
        }
        let (mut part, mut end) = (directions.part[lane], of(&directions.end));
        let [x, y, z] = directions.to.map(|to| to[lane]);
        let mut to = Voxel::new(x, y, z);
        if let Some(half) = self.half_box {
            let d = of(&directions.d);
            for axis in 0..3 {
                if (d[axis] * part).abs() > half[axis] {
                    part = half[axis] / d[axis].abs();
                }
            }
            end = core::array::from_fn(|axis| self.start[axis] + d[axis] * part);
            to = voxel_of(end);
        }
        let is_hit = returned && part == 1.0;
        if !is_hit && self.lowest_cut_end.is_some_and(|z| end[2] < z) {
            report.ignored += 1;
            return None;
        }
        *if is_hit { &mut report.hits } else { &mut report.cut } += 1;
        Some((Ray::new(self.from, end, to, is_hit), to))
    }

    /// Whether a point lies on a team-mate.
    #[inline(always)]
    fn is_masked(&self, d: [f64; 3]) -> bool {
        let is_within = |(c, radius2): &([f64; 3], f64)| {
            (0..3).map(|axis| (self.start[axis] + d[axis] - c[axis]).powi(2)).sum::<f64>() <= *radius2
        };
        self.masks.iter().any(is_within)
    }
}
