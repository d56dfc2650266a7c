//! A ray, before it walks.

use super::window::Window;
use crate::Voxel;

/// A ray in voxel units (metres divided by the resolution), in the frame of the map.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ray {
    pub(super) end: [f64; 3],
    pub(super) is_hit: bool,
    /// Voxels before the one in which it ends.
    pub(super) length: u32,
}

impl Ray {
    #[inline(always)]
    pub(super) fn new(from: Voxel, end: [f64; 3], to: Voxel, is_hit: bool) -> Self {
        Self { end, is_hit, length: from.x.abs_diff(to.x) + from.y.abs_diff(to.y) + from.z.abs_diff(to.z) }
    }

    /// Place of the voxel in which it ends.
    pub(super) fn end_place(&self, window: &Window) -> u32 {
        let [x, y, z] = window.place(voxel_of(self.end));
        x | y | z
    }
}

/// The voxel in which a point lies. Not by `floor`, which is a call where no vector instructions are asked for.
#[inline(always)]
pub(super) fn voxel_of(p: [f64; 3]) -> Voxel {
    let floor = |v: f64| {
        let towards_zero = v as i32;
        towards_zero - i32::from(f64::from(towards_zero) > v)
    };
    Voxel::new(floor(p[0]), floor(p[1]), floor(p[2]))
}
