//! Obstacles made larger by the size of the robot.

use flockmap_grid::{BlockIndex, MapView, Plane, StateBlock};

use super::cell::{Cell, LANES};
use super::passes::{Passes, Shape};
use super::{Cells, DistanceField};

impl DistanceField {
    /// The voxels of the box whose distance to an obstacle is at most this many metres (centre to centre), as bit
    /// planes of blocks in ascending order; only blocks that have such voxels. O(voxels).
    pub fn within(&self, radius_m: f64) -> Vec<(BlockIndex, Plane)> {
        // The largest whole squared distance that is not beyond the radius, to rounding. None of what is no number.
        let squared = (radius_m / self.resolution.metres()).powi(2) * (1.0 + 1e-12);
        if radius_m.is_nan() || radius_m < 0.0 {
            return Vec::new();
        }
        let squared = squared.min(f64::from(u32::MAX)) as u32;
        match &self.cells {
            Cells::Small(passes) => within(&self.shape, passes, squared.min(u32::from(u16::MAX - 1))),
            Cells::Large(passes) => within(&self.shape, passes, squared),
        }
    }

    /// The map with the obstacles of the box grown: what [`Self::within`] names is Occupied, all else is as in the
    /// view. For planners of points: a sphere of this radius about the centre of a voxel that is not Occupied here
    /// meets no centre of an obstacle. O(voxels of the box, and a copy of the regions of the map that it touches).
    pub fn inflated(&self, view: &MapView, radius_m: f64) -> MapView {
        let mut map = view.clone();
        for (index, plane) in self.within(radius_m) {
            let mut block = view.block(index).unwrap_or_default();
            block.overlay(&StateBlock::new([0; 8], plane));
            map.set_block(index, &block);
        }
        map
    }
}

fn within<T: Cell>(shape: &Shape, passes: &Passes<T>, squared: u32) -> Vec<(BlockIndex, Plane)> {
    let most = T::from_whole(squared);
    let (low, high) = (shape.region.min(), shape.region.max());
    let mut found = Vec::new();
    for index in shape.region.blocks() {
        let corner = index.corner();
        let mut plane: Plane = [0; 8];
        for z in low.z.max(corner.z)..=high.z.min(corner.z + 7) {
            for y in low.y.max(corner.y)..=high.y.min(corner.y + 7) {
                let (group, lane) = shape.place([corner.x, y, z]);
                let lanes = &passes.in_space[group][lane & (LANES - 8)..][..8];
                let row = lanes.iter().rev().fold(0, |row, cell| row << 1 | u64::from(*cell <= most));
                plane[(z & 7) as usize] |= row << (8 * (y & 7));
            }
        }
        let of_box = shape.region.plane(index);
        plane.iter_mut().zip(of_box).for_each(|(slice, of_box)| *slice &= of_box);
        if plane != [0; 8] {
            found.push((index, plane));
        }
    }
    found
}
