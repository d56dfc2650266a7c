//! The map as an `octomap_msgs/Octomap`, in the binary form.

use std::time::Instant;

use flockmap_io::octomap_tree;
use flockmap_io::ros::Octomap;

use super::outlet::{Outlet, Output, Shot};

/// The whole map as a tree of occupied and free voxels.
pub(crate) struct Tree {
    outlet: Outlet<Octomap>,
}

impl Tree {
    pub(crate) const fn new(outlet: Outlet<Octomap>) -> Self {
        Self { outlet }
    }
}

impl Output for Tree {
    fn publish(&mut self, shot: &Shot, now: Instant) -> Result<(), String> {
        if !self.outlet.wants(shot.view.version(), None, now) {
            return Ok(());
        }
        let (data, _) = octomap_tree(shot.view.voxels()).map_err(|voxel| {
            format!("no OctoMap: it ends 32,768 voxels from the origin, and {voxel:?} is in the map")
        })?;
        self.outlet.send(Octomap {
            header: shot.header.clone(),
            binary: true,
            id: "OcTree".into(),
            resolution: shot.view.resolution().metres(),
            data: data.into_iter().map(u8::cast_signed).collect(),
        })
    }

    fn due(&self) -> Instant {
        self.outlet.due()
    }
}
