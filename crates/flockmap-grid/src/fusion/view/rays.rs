//! Rays through the fused map.

use super::{MapView, RayEnd};
use crate::fusion::region::region_of;
use crate::{State, Voxel, voxel_bit};

impl MapView {
    /// Follows the straight line between two points (metres) to the first voxel that is Occupied, or Unknown if
    /// `through_unknown` is false. A point outside of the voxel limits ends as Unknown at the start.
    pub fn cast_ray(&self, from: [f64; 3], to: [f64; 3], through_unknown: bool) -> RayEnd {
        let side = self.resolution.metres();
        let (Some(start), Some(end)) = (self.resolution.voxel_at(from), self.resolution.voxel_at(to)) else {
            return RayEnd::Unknown { voxel: Voxel::default(), distance_m: 0.0 };
        };
        let d: [f64; 3] = core::array::from_fn(|axis| to[axis] - from[axis]);
        let length = d.iter().map(|d| d * d).sum::<f64>().sqrt();
        let mut at = [start.x, start.y, start.z];
        let to = [end.x, end.y, end.z];
        // Share of the ray at which it next crosses a face of each axis.
        let mut next: [f64; 3] = core::array::from_fn(|axis| {
            let face = f64::from(at[axis] + i32::from(d[axis] > 0.0)) * side;
            if d[axis] == 0.0 { f64::INFINITY } else { (face - from[axis]) / d[axis] }
        });
        let mut entered = 0.0;
        let steps: u32 = at.iter().zip(to).map(|(a, b)| a.abs_diff(b)).sum();
        // A region is looked up when the ray comes into it, a block too.
        let mut index = start.block();
        let mut region = self.region(region_of(index));
        let mut block = region.as_ref().and_then(|region| region.block(index)).copied();
        for _ in 0..=steps {
            let voxel = Voxel::new(at[0], at[1], at[2]);
            let distance_m = entered * length;
            if index != voxel.block() {
                if region_of(index) != region_of(voxel.block()) {
                    region = self.region(region_of(voxel.block()));
                }
                index = voxel.block();
                block = region.as_ref().and_then(|region| region.block(index)).copied();
            }
            match block.as_ref().map_or(State::Unknown, |block| block.get(voxel_bit(voxel))) {
                State::Occupied => return RayEnd::Occupied { voxel, distance_m },
                State::Unknown if !through_unknown => return RayEnd::Unknown { voxel, distance_m },
                _ => {}
            }
            let axis = (0..3).min_by(|a, b| next[*a].total_cmp(&next[*b])).unwrap_or(0);
            entered = next[axis].clamp(0.0, 1.0);
            at[axis] += if d[axis] > 0.0 { 1 } else { -1 };
            next[axis] += side / d[axis].abs();
        }
        RayEnd::Clear
    }
}
