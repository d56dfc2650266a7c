//! Centres of occupied voxels as a `sensor_msgs/PointCloud2`.

use std::time::Instant;

use flockmap::MapView;
use flockmap::grid::VoxelBox;
use flockmap_io::ros::{Bytes, PointCloud2, cloud_of_points};
use flockmap_plan::box_between;

use super::outlet::{Outlet, Output, Shot, cell};

/// Occupied voxels: all, or those near the robot.
pub(crate) struct Cloud {
    outlet: Outlet<PointCloud2<Bytes>>,
    /// In a box that goes so far from the robot along each axis.
    range_m: Option<f64>,
}

impl Cloud {
    pub(crate) const fn new(outlet: Outlet<PointCloud2<Bytes>>, range_m: Option<f64>) -> Self {
        Self { outlet, range_m }
    }
}

impl Output for Cloud {
    fn publish(&mut self, shot: &Shot, now: Instant) -> Result<(), String> {
        let place = if self.range_m.is_some() { cell(&shot.view, shot.position) } else { [0; 3] };
        if !self.outlet.wants(shot.view.version(), place, now) {
            return Ok(());
        }
        let region = match (self.range_m, shot.position) {
            (Some(range), Some(at)) => {
                box_between(shot.view.resolution(), at.map(|v| v - range), at.map(|v| v + range))
            }
            // Nobody knows yet where near is.
            (Some(_), None) => None,
            (None, _) => shot.view.bounding_box(),
        };
        let points = region.map_or_else(Vec::new, |region| occupied(&shot.view, &region));
        self.outlet.send(cloud_of_points(shot.header.clone(), &points))
    }

    fn due(&self) -> Instant {
        self.outlet.due()
    }
}

/// The centres of occupied voxels in a box, in metres.
pub(super) fn occupied(view: &MapView, region: &VoxelBox) -> Vec<[f32; 3]> {
    let side = view.resolution().metres();
    let centre = |v: i32| ((f64::from(v) + 0.5) * side) as f32;
    let mut points = Vec::new();
    for (index, block) in view.blocks_in(region) {
        let low = [index.x, index.y, index.z].map(|v| v * 8);
        for (z, plane) in (0..).zip(block.occupied()) {
            let mut left = *plane;
            while left != 0 {
                let bit = left.trailing_zeros() as i32;
                left &= left - 1;
                let voxel = flockmap::Voxel::new(low[0] + bit % 8, low[1] + bit / 8, low[2] + z);
                if region.contains(voxel) {
                    points.push([centre(voxel.x), centre(voxel.y), centre(voxel.z)]);
                }
            }
        }
    }
    points
}
