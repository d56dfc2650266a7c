//! The rays from the sensor through the voxels of a block.

use super::orientation::Distance;

/// How they lie in the current slice.
pub(crate) struct Rays {
    pub(crate) distance: Distance,
    /// Whether the axis of a slice along which the sensor is farther away is the one from row to row.
    pub(crate) is_by_rows: bool,
    reciprocal: u64,
    /// How far they move along x with each slice, in sixteenths of a voxel: 0 … 16.
    pub(crate) slope_x: usize,
}

impl Rays {
    pub(crate) fn of(distance: Distance) -> Self {
        Self { distance, is_by_rows: distance[1] >= distance[0], reciprocal: 0, slope_x: 0 }
    }

    /// Goes on to a slice.
    #[inline]
    pub(crate) fn enter(&mut self, z: usize) {
        let along = (self.distance[2] + 56 - 16 * z as i32).max(0);
        // One divided by a distance of so many half voxels.
        let half_voxels = (along as u32 >> 3).min(1023);
        self.reciprocal = u64::from(65_536 / (8 * half_voxels + 4));
        self.slope_x = self.slope(self.distance[0]);
    }

    #[inline]
    fn slope(&self, along: i32) -> usize {
        ((along.max(0) as u64 * self.reciprocal) >> 12).min(16) as usize
    }

    /// How far those through the middle of a row move along y, as `slope_x`.
    #[inline]
    pub(crate) fn slope_y(&self, y: usize) -> usize {
        self.slope(self.distance[1] + 56 - 16 * y as i32)
    }
}
