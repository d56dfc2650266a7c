//! Centres of occupied voxels as a `sensor_msgs/PointCloud2`.

use std::time::Instant;

use flockmap::MapView;
use flockmap::grid::{VoxelBox, set_bits};
use flockmap_io::ros::{Bytes, PointCloud2, cloud_of_points};
use flockmap_plan::box_between;

use super::outlet::{Outlet, Output, Shot};

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
        let place = self.range_m.and_then(|_| shot.voxel());
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
fn occupied(view: &MapView, region: &VoxelBox) -> Vec<[f32; 3]> {
    let voxels = view
        .blocks_in(region)
        .flat_map(|(index, block)| set_bits(block.occupied()).map(move |place| index.voxel(place)));
    let inside = voxels.filter(|voxel| region.contains(*voxel));
    inside.map(|voxel| view.resolution().centre(voxel).map(|v| v as f32)).collect()
}
