//! A pilot: plans on nothing but the fused map of its robot, and flies no faster than it can brake.

use super::route::{self, Keep, POINT_EVERY_M};
use super::slab::{Slab, Window};
use crate::MotionLimits;
use flockmap_grid::{MapView, Pose};
use flockmap_worlds::curve::{distance, wrapped};
use libm::{atan2, cos, sin};

/// Time between two steps of the flyer, in seconds.
pub(super) const STEP_S: f64 = 0.02;

/// Where a robot is and how it moves, at constant height.
#[derive(Clone, Copy)]
pub(super) struct Flyer {
    pub(super) position: [f64; 2],
    pub(super) velocity: [f64; 2],
    pub(super) height: f64,
    /// Direction of its LiDAR, radians about z from x.
    pub(super) yaw: f64,
}

impl Flyer {
    /// Its LiDAR's pose in the map.
    pub(super) fn pose(&self) -> Pose {
        let half = 0.5 * self.yaw;
        Pose::new(self.point(), [0.0, 0.0, sin(half), cos(half)]).unwrap_or_default()
    }

    pub(super) const fn point(&self) -> [f64; 3] {
        [self.position[0], self.position[1], self.height]
    }

    pub(super) fn speed(&self) -> f64 {
        distance(self.velocity, [0.0; 2])
    }

    /// One step towards a wanted velocity.
    fn step(&mut self, wanted: [f64; 2], limits: &MotionLimits) {
        let change = distance(wanted, self.velocity);
        let share = (limits.acceleration_m_s2 * STEP_S / change.max(1e-12)).min(1.0);
        let velocity = self.velocity;
        self.velocity = core::array::from_fn(|a| velocity[a] + (wanted[a] - velocity[a]) * share);
        let position = self.position;
        self.position = core::array::from_fn(|a| position[a] + self.velocity[a] * STEP_S);
    }

    /// One step of turning towards a yaw.
    pub(super) fn turn(&mut self, yaw: f64, limits: &MotionLimits) {
        let most = limits.yaw_rate_rad_s * STEP_S;
        self.yaw += wrapped(yaw - self.yaw).clamp(-most, most);
    }
}

/// Half the side of the window that is planned in: the update box of the map.
const WINDOW_HALF_M: f64 = 7.5;
/// Half the height of the slab that must be free: body and a margin.
const SLAB_HALF_M: f64 = 0.3;
/// Paths keep this far from obstacles: body 0.2, margin 0.15, and half a voxel.
const KEEP: Keep = Keep { clearance_m: 0.4, comfort_m: 0.8 };
/// The motion itself keeps this far: it may cut a corner a little.
const FLOWN_CLEARANCE_M: f64 = 0.32;
/// With the clearance of paths, centres of robots stay 0.9 m apart.
const OTHER_RADIUS_M: f64 = 0.5;
/// How long a speed is tried ahead before braking.
const TRIED_STEPS: usize = 50;
/// Speeds that are tried, as shares of what is allowed.
const SPEED_SHARES: [f64; 6] = [1.0, 0.8, 0.6, 0.45, 0.3, 0.15];

/// A pilot and its plan. Plans ten times a second, moves in between.
pub(super) struct Pilot {
    limits: MotionLimits,
    /// Corners of the ground to stay on.
    fence: [[f64; 2]; 2],
    path: Vec<[f64; 2]>,
    /// Point of the path that is nearest to the robot.
    at: usize,
    /// Speed decided on; 0 brakes.
    speed: f64,
}

impl Pilot {
    pub(super) const fn new(limits: MotionLimits, fence: [[f64; 2]; 2]) -> Self {
        Self { limits, fence, path: Vec::new(), at: 0, speed: 0.0 }
    }

    /// Plans anew on the fused map: a path to the target, and the highest speed up to `speed_max` at which
    /// the robot neither leaves free space within the next second nor when it brakes after that. None: it
    /// brakes now. `other`: where the other robot is.
    pub(super) fn plan(
        &mut self,
        map: &MapView,
        flyer: &Flyer,
        target: [f64; 2],
        speed_max: f64,
        other: [f64; 2],
    ) {
        let heights = [-SLAB_HALF_M, 0.0, SLAB_HALF_M].map(|dz| flyer.height + dz);
        let window = Window { centre: flyer.position, half_m: WINDOW_HALF_M, heights };
        let mut slab = Slab::of_map(map, &window);
        slab.fence(self.fence);
        slab.block(|at| distance(at, other) <= OTHER_RADIUS_M);
        slab.measure();
        let rest = self.path.get(self.at..).unwrap_or_default();
        self.path = route::find(&slab, flyer.position, target, rest, &KEEP).unwrap_or_default();
        self.at = 0;
        let safe = |share: &f64| self.is_safe(&slab, flyer, share * speed_max);
        self.speed = SPEED_SHARES.iter().find(|share| safe(share)).map_or(0.0, |share| share * speed_max);
    }

    /// One step of motion along the path.
    pub(super) fn step(&mut self, flyer: &mut Flyer) {
        let mut at = self.at;
        let wanted = self.wanted(flyer, &mut at, self.speed);
        self.at = at;
        flyer.step(wanted, &self.limits);
    }

    /// The direction that the robot flies to, as an angle about z; `None` if it stands.
    pub(super) fn heading(&self, flyer: &Flyer) -> Option<f64> {
        let to = self.path.get((self.at + 10).min(self.path.len().saturating_sub(1)))?;
        let d = [to[0] - flyer.position[0], to[1] - flyer.position[1]];
        (distance(d, [0.0; 2]) > 0.2).then(|| atan2(d[1], d[0]))
    }

    /// The point so many metres ahead on the path.
    pub(super) fn ahead(&self, metres: f64) -> Option<[f64; 2]> {
        let points = (metres / POINT_EVERY_M) as usize;
        self.path.get((self.at + points).min(self.path.len().saturating_sub(1))).copied()
    }

    fn is_safe(&self, slab: &Slab, flyer: &Flyer, speed: f64) -> bool {
        // Where the robot is too near to something already, it must not get nearer.
        let least = FLOWN_CLEARANCE_M.min(slab.distance_at(flyer.position));
        let mut tried = *flyer;
        let mut at = self.at;
        let mut step = 0;
        while step < TRIED_STEPS || tried.speed() > 1e-6 {
            let wanted = if step < TRIED_STEPS { self.wanted(&tried, &mut at, speed) } else { [0.0; 2] };
            tried.step(wanted, &self.limits);
            if slab.distance_at(tried.position) < least {
                return false;
            }
            step += 1;
        }
        true
    }

    /// The velocity that leads along the path: towards a point some metres ahead, slowing down before the end.
    fn wanted(&self, flyer: &Flyer, at: &mut usize, speed: f64) -> [f64; 2] {
        *at = nearest(&self.path, *at, flyer.position);
        let Some(last) = self.path.len().checked_sub(1) else { return [0.0; 2] };
        let ahead = ((0.3 + 0.3 * flyer.speed()) / POINT_EVERY_M) as usize;
        let to = self.path[(*at + ahead).min(last)];
        let left = (last - *at) as f64 * POINT_EVERY_M;
        let speed = speed.min((2.0 * 0.7 * self.limits.acceleration_m_s2 * left).sqrt());
        let d = [to[0] - flyer.position[0], to[1] - flyer.position[1]];
        let length = distance(d, [0.0; 2]);
        if length < 1e-6 { [0.0; 2] } else { d.map(|v| v / length * speed) }
    }
}

/// The point of a path that is nearest to `position`, searched from point `from` on, at most 1 m ahead.
fn nearest(path: &[[f64; 2]], from: usize, position: [f64; 2]) -> usize {
    let end = path.len().min(from + 11);
    (from..end)
        .min_by(|a, b| distance(path[*a], position).total_cmp(&distance(path[*b], position)))
        .unwrap_or_else(|| from.min(path.len().saturating_sub(1)))
}
