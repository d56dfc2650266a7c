//! How an odometry drifts.

use flockmap::Pose;

/// How far off a robot believes to be after so many metres.
#[derive(Clone, Copy, Debug)]
pub(super) struct Drift {
    pub(super) per_metre: f64,
    pub(super) yaw_per_metre: f64,
}

impl Drift {
    pub(super) const NONE: Self = Self { per_metre: 0.0, yaw_per_metre: 0.0 };

    /// Where a robot believes the map to be that it has left `way_m` ago: off by a share of the way, and turned.
    pub(super) fn at(self, way_m: f64) -> Pose {
        let off = self.per_metre * way_m;
        Pose::from_yaw([off * 0.8, off * 0.6, 0.0], self.yaw_per_metre * way_m)
    }

    /// A share of it.
    pub(super) fn part(self, share: f64) -> Self {
        Self { per_metre: self.per_metre * share, yaw_per_metre: self.yaw_per_metre * share }
    }
}
