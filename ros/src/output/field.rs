//! Distances to obstacles in a box around the robot, as a `sensor_msgs/PointCloud2`.

use std::time::Instant;

use flockmap_io::ros::{Bytes, PointCloud2, cloud_of_floats};
use flockmap_plan::{DistanceField, FieldConfig, Obstacles, box_between, grown};

use super::outlet::{Outlet, Output, Shot};

/// Centres of free voxels, each with its distance to the nearest obstacle up to a largest one.
pub(crate) struct Field {
    outlet: Outlet<PointCloud2<Bytes>>,
    range_m: [f64; 3],
    distance_max_m: f64,
    field: Option<DistanceField>,
}

impl Field {
    pub(crate) const fn new(
        outlet: Outlet<PointCloud2<Bytes>>,
        range_m: [f64; 3],
        distance_max_m: f64,
    ) -> Self {
        Self { outlet, range_m, distance_max_m, field: None }
    }
}

impl Output for Field {
    fn publish(&mut self, shot: &Shot, now: Instant) -> Result<(), String> {
        let view = &shot.view;
        let Some(at) = shot.position else { return Ok(()) };
        if !self.outlet.wants(view.version(), shot.voxel(), now) {
            return Ok(());
        }
        let corner = |sign: f64| core::array::from_fn(|axis| at[axis] + sign * self.range_m[axis]);
        let Some(region) = box_between(view.resolution(), corner(-1.0), corner(1.0)) else { return Ok(()) };
        let side = view.resolution().metres();
        // Obstacles beyond the box count as far as distances are told.
        let around = grown(region, (self.distance_max_m / side).ceil() as u32);
        let refused = |error: flockmap_plan::FieldError| format!("no distance field: {error}");
        match &mut self.field {
            Some(field) => field.move_to(view, around).map_err(refused)?,
            None => {
                let config = FieldConfig { obstacles: Obstacles::Occupied, ..FieldConfig::default() };
                self.field = Some(DistanceField::new(view, around, &config).map_err(refused)?);
            }
        }
        let Some(field) = &self.field else { return Ok(()) };
        let mut values = Vec::new();
        for (voxel, state) in view.voxels_in(&region) {
            if state == flockmap::State::Free {
                let distance = field.distance(voxel).unwrap_or(f64::INFINITY).min(self.distance_max_m);
                values.extend(view.resolution().centre(voxel).map(|v| v as f32));
                values.push(distance as f32);
            }
        }
        self.outlet.send(cloud_of_floats(shot.header.clone(), &["x", "y", "z", "distance"], &values))
    }

    fn due(&self) -> Instant {
        self.outlet.due()
    }
}
