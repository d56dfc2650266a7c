//! The path of a sensor during one scan.

use super::SCAN_PERIOD_MICROS;
use flockmap_grid::Pose;
use libm::{atan2, cos, sin};

/// The pose of a sensor from the start of a scan to its end: straight on, at constant speed, turning about
/// one axis at a constant rate.
pub(super) struct Course {
    start: Pose,
    motion: Option<Motion>,
}

struct Motion {
    shift: [f64; 3],
    /// Unit vector in the frame of the sensor.
    axis: [f64; 3],
    /// Radians turned about it in the whole scan, 0 … π.
    angle: f64,
}

impl Course {
    /// Without an end the sensor stays.
    #[allow(non_snake_case)]
    pub(super) fn new(T_map_start: &Pose, T_map_end: Option<&Pose>) -> Self {
        let motion = T_map_end.filter(|end| *end != T_map_start).map(|end| {
            let (from, to) = (T_map_start.translation(), end.translation());
            let [x, y, z, w] = T_map_start.quaternion_xyzw();
            let [mut ax, mut ay, mut az, mut aw] = product([-x, -y, -z, w], end.quaternion_xyzw());
            if aw < 0.0 {
                // The same rotation, the shorter turn.
                [ax, ay, az, aw] = [-ax, -ay, -az, -aw];
            }
            let sine = (ax * ax + ay * ay + az * az).sqrt();
            let axis = if sine > 0.0 { [ax / sine, ay / sine, az / sine] } else { [0.0, 0.0, 1.0] };
            Motion { shift: core::array::from_fn(|a| to[a] - from[a]), axis, angle: 2.0 * atan2(sine, aw) }
        });
        Self { start: *T_map_start, motion }
    }

    /// Whether the sensor moves at all.
    pub(super) const fn moves(&self) -> bool {
        self.motion.is_some()
    }

    /// Metres from the start to the end.
    pub(super) fn travel_m(&self) -> f64 {
        self.motion.as_ref().map_or(0.0, |m| m.shift.iter().map(|v| v * v).sum::<f64>().sqrt())
    }

    /// The pose at this time after the start of the scan.
    pub(super) fn at(&self, micros: i64) -> Pose {
        let Some(motion) = &self.motion else { return self.start };
        let share = micros as f64 / SCAN_PERIOD_MICROS as f64;
        let half = 0.5 * motion.angle * share;
        let [x, y, z] = motion.axis.map(|v| v * sin(half));
        let turned = product(self.start.quaternion_xyzw(), [x, y, z, cos(half)]);
        let from = self.start.translation();
        let place = core::array::from_fn(|a| from[a] + motion.shift[a] * share);
        // A product of unit quaternions is one; only places beyond all numbers could fail.
        Pose::new(place, turned).unwrap_or(self.start)
    }
}

/// Product of two quaternions `[x, y, z, w]`.
fn product([ax, ay, az, aw]: [f64; 4], [bx, by, bz, bw]: [f64; 4]) -> [f64; 4] {
    [
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    ]
}
