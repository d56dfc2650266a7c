//! What is asked of a distance field.

use flockmap_grid::Voxel;

use super::cell::Cell;
use super::{Cells, DistanceField};

/// How far from obstacles a point is, and where to go to be farther.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Clearance {
    /// Metres to the nearest obstacle of the box; infinity if there is none.
    pub distance_m: f64,
    /// Metres of distance gained by a metre along x, y, z, in the frame of the map; 0 if there is no obstacle.
    pub gradient: [f64; 3],
}

impl Clearance {
    /// Of a point that is not in the box.
    const OUTSIDE: Self = Self { distance_m: f64::NAN, gradient: [f64::NAN; 3] };
}

impl DistanceField {
    /// Squared distance in voxels, exact. `None` if the voxel is not in the box, or there is no obstacle in the box.
    /// O(1).
    pub fn squared_voxels(&self, voxel: Voxel) -> Option<u32> {
        if !self.region().contains(voxel) {
            return None;
        }
        let (group, lane) = self.shape.place([voxel.x, voxel.y, voxel.z]);
        match &self.cells {
            Cells::Small(passes) => passes.in_space[group][lane].whole(),
            Cells::Large(passes) => passes.in_space[group][lane].whole(),
        }
    }

    /// Metres from the centre of a voxel to that of the nearest obstacle; infinity if there is none. `None` if the
    /// voxel is not in the box. O(1).
    pub fn distance(&self, voxel: Voxel) -> Option<f64> {
        let voxels = || self.squared_voxels(voxel).map_or(f64::INFINITY, |squared| f64::from(squared).sqrt());
        self.region().contains(voxel).then(|| voxels() * self.resolution.metres())
    }

    /// Distance and its gradient at a point (metres, frame of the map): the trilinear interpolation between the eight
    /// voxel centres about it, and the gradient of that, which is constant along each axis from one centre to the next
    /// and jumps there. Within half a voxel of a face of the box distances are those at the nearest centres, and the
    /// gradient across the face is 0. `None` outside of the box, and for what is no number. O(1).
    pub fn at(&self, point: [f64; 3]) -> Option<Clearance> {
        if !self.region().contains(self.resolution.voxel_at(point)?) {
            return None;
        }
        let side = self.resolution.metres();
        let (min, max) = (self.region().min(), self.region().max());
        let (min, max) = ([min.x, min.y, min.z], [max.x, max.y, max.z]);
        // The voxel centre before the point, the one behind it, and the way between them.
        let axes: [(i32, i32, f64); 3] = core::array::from_fn(|axis| {
            let at = point[axis] / side - 0.5;
            let before = at.floor();
            let low = (before as i32).clamp(min[axis], max[axis]);
            let high = (before as i32 + 1).clamp(min[axis], max[axis]);
            (low, high, if low == high { 0.0 } else { at - before })
        });
        let d: [f64; 8] = core::array::from_fn(|corner| {
            let at = |axis: usize| if corner >> axis & 1 == 1 { axes[axis].1 } else { axes[axis].0 };
            let (group, lane) = self.shape.place([at(0), at(1), at(2)]);
            let squared = match &self.cells {
                Cells::Small(passes) => passes.in_space[group][lane].whole(),
                Cells::Large(passes) => passes.in_space[group][lane].whole(),
            };
            squared.map_or(f64::INFINITY, |squared| f64::from(squared).sqrt() * side)
        });
        if d[0] == f64::INFINITY {
            return Some(Clearance { distance_m: f64::INFINITY, gradient: [0.0; 3] });
        }
        let [x, y, z] = axes.map(|axis| axis.2);
        let mix = |a: f64, b: f64, share: f64| a + (b - a) * share;
        let along_x: [f64; 4] = core::array::from_fn(|i| mix(d[2 * i], d[2 * i + 1], x));
        let along_y: [f64; 2] = core::array::from_fn(|i| mix(along_x[2 * i], along_x[2 * i + 1], y));
        let slope: [f64; 4] = core::array::from_fn(|i| d[2 * i + 1] - d[2 * i]);
        let gradient = [
            mix(mix(slope[0], slope[1], y), mix(slope[2], slope[3], y), z),
            mix(along_x[1] - along_x[0], along_x[3] - along_x[2], z),
            along_y[1] - along_y[0],
        ];
        Some(Clearance { distance_m: mix(along_y[0], along_y[1], z), gradient: gradient.map(|g| g / side) })
    }

    /// [`DistanceField::at`] for many points: metres, NaN outside of the box. Writes as many as there are of both.
    pub fn distances(&self, points: &[[f64; 3]], distances_m: &mut [f64]) {
        for (point, distance_m) in points.iter().zip(distances_m) {
            *distance_m = self.at(*point).unwrap_or(Clearance::OUTSIDE).distance_m;
        }
    }

    /// The same with gradients, see [`Clearance`]; NaN outside of the box.
    pub fn clearances(&self, points: &[[f64; 3]], distances_m: &mut [f64], gradients: &mut [[f64; 3]]) {
        for ((point, distance_m), gradient) in points.iter().zip(distances_m).zip(gradients) {
            let found = self.at(*point).unwrap_or(Clearance::OUTSIDE);
            (*distance_m, *gradient) = (found.distance_m, found.gradient);
        }
    }

    /// Whether the spheres of a radius about many points surely keep clear of every obstacle of the box, taken as full
    /// cubes. Some that just pass are false: the distance at the voxel of the point must be larger than the radius, the
    /// way to the centre of that voxel and half the diagonal of a voxel together. [`crate::Collision::sphere`] is
    /// exact. False outside of the box, and for what is no number. Writes as many as there are of both.
    pub fn are_clear(&self, centres: &[[f64; 3]], radius_m: f64, are_clear: &mut [bool]) {
        let half_diagonal = self.resolution.metres() * 0.75f64.sqrt();
        for (centre, is_clear) in centres.iter().zip(are_clear) {
            let voxel = self.resolution.voxel_at(*centre);
            *is_clear = voxel.and_then(|voxel| Some((voxel, self.distance(voxel)?))).is_some_and(
                |(voxel, distance)| {
                    let middle = self.resolution.centre(voxel);
                    let off = (0..3).map(|axis| (centre[axis] - middle[axis]).powi(2)).sum::<f64>().sqrt();
                    distance > radius_m + off + half_diagonal
                },
            );
        }
    }
}
