//! A robot's body in motion along waypoints.

use flockmap_grid::Pose;
use flockmap_worlds::curve::{
    CORNER_M, CREEP_M_S, SAMPLE_M, between, distance, rounded, slow_in_bends, slow_to_reach, towards, wrapped,
};
use libm::{cos, sin};

/// How fast a robot can be.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct MotionLimits {
    /// Highest speed in m/s; more than 0. Default 1.5.
    pub speed_m_s: f64,
    /// Highest acceleration along the path, and across it, in m/s²; more than 0. Default 1.
    pub acceleration_m_s2: f64,
    /// Highest yaw rate in rad/s; more than 0. Default 1.4.
    pub yaw_rate_rad_s: f64,
}

impl Default for MotionLimits {
    fn default() -> Self {
        Self { speed_m_s: 1.5, acceleration_m_s2: 1.0, yaw_rate_rad_s: 1.4 }
    }
}

/// A robot that flies along a path and keeps its limits, level, with a yaw of its own.
///
/// It never leaves its path, and can always stop on it: new waypoints replace only what lies beyond the point
/// at which it could come to rest ([`Self::stopping_point`]). So a path that is free of obstacles up to there
/// stays so, whatever is planned next. Deterministic: basic operations, square roots and `libm` only.
///
/// ```
/// use flockmap_autonomy::{Motion, MotionLimits};
///
/// let limits = MotionLimits::default();
/// let mut motion = Motion::new([0.0, 0.0, 1.0], 0.0);
/// motion.follow(&[motion.stopping_point(&limits), [3.0, 0.0, 1.0]], &limits, |_, _| true);
/// for _ in 0..50 {
///     motion.step(0.1, 0.5, &limits);
/// }
/// assert!((motion.position()[0] - 3.0).abs() < 1e-6 && motion.is_at_end());
/// ```
#[derive(Clone, PartialEq, Debug)]
pub struct Motion {
    /// Samples of the path from somewhere behind the robot to its end; at least one.
    points: Vec<[f64; 3]>,
    /// Metres from each sample to the next.
    lengths: Vec<f64>,
    /// Speed at each sample. Between two the acceleration is constant.
    speeds: Vec<f64>,
    /// Highest speed at each sample for the bend that it lies in.
    caps: Vec<f64>,
    /// The robot is this many metres beyond this sample.
    segment: usize,
    along: f64,
    yaw: f64,
}

impl Motion {
    /// At rest at a place (metres), looking along `yaw` (radians).
    pub fn new(position: [f64; 3], yaw: f64) -> Self {
        Self {
            points: vec![position],
            lengths: Vec::new(),
            speeds: vec![0.0],
            caps: vec![f64::INFINITY],
            segment: 0,
            along: 0.0,
            yaw,
        }
    }

    /// Where it is, in metres.
    pub fn position(&self) -> [f64; 3] {
        let from = self.points[self.segment];
        match self.points.get(self.segment + 1) {
            Some(to) => between(from, *to, self.along / self.lengths[self.segment]),
            None => from,
        }
    }

    /// Where it is and looks.
    pub fn pose(&self) -> Pose {
        let half = 0.5 * self.yaw;
        // Sine and cosine of one angle make a unit quaternion, and paths are finite.
        Pose::new(self.position(), [0.0, 0.0, sin(half), cos(half)]).unwrap_or_default()
    }

    /// Its velocity in m/s.
    pub fn velocity(&self) -> [f64; 3] {
        match self.points.get(self.segment + 1) {
            Some(to) => {
                let (from, length) = (self.points[self.segment], self.lengths[self.segment]);
                let speed = self.speed();
                core::array::from_fn(|a| (to[a] - from[a]) / length * speed)
            }
            None => [0.0; 3],
        }
    }

    /// Its speed in m/s.
    pub fn speed(&self) -> f64 {
        if self.segment >= self.lengths.len() {
            return 0.0;
        }
        let v0 = self.speeds[self.segment];
        (v0 * v0 + 2.0 * self.acceleration() * self.along).max(0.0).sqrt()
    }

    /// Where it looks, in radians, −π … π.
    pub const fn yaw(&self) -> f64 {
        self.yaw
    }

    /// Whether it has come to the end of its path.
    pub const fn is_at_end(&self) -> bool {
        self.segment >= self.lengths.len()
    }

    /// The path ahead, from where it is to its end: points at most 5 cm apart.
    pub fn path(&self) -> Vec<[f64; 3]> {
        let mut path = vec![self.position()];
        path.extend(self.points.iter().skip(self.segment + 1));
        path
    }

    /// Metres to the end of the path.
    pub fn remaining_m(&self) -> f64 {
        self.lengths.iter().skip(self.segment).sum::<f64>() - self.along
    }

    /// The path ahead up to the point at which it would come to rest if it braked now.
    pub fn stopping_path(&self, limits: &MotionLimits) -> Vec<[f64; 3]> {
        let speed = self.speed();
        let mut left = speed * speed / (2.0 * limits.acceleration_m_s2);
        let mut path = vec![self.position()];
        for &next in self.points.iter().skip(self.segment + 1) {
            let here = path[path.len() - 1];
            let length = distance(here, next);
            if left <= 1e-6 {
                break;
            }
            if length < 1e-9 {
                continue;
            }
            if length > left {
                path.push(towards(here, next, left));
                break;
            }
            path.push(next);
            left -= length;
        }
        path
    }

    /// Where it would come to rest if it braked now: where new waypoints have to begin.
    pub fn stopping_point(&self, limits: &MotionLimits) -> [f64; 3] {
        let path = self.stopping_path(limits);
        path[path.len() - 1]
    }

    /// Goes on along these waypoints (metres), of which the first should be [`Self::stopping_point`]. Corners
    /// are rounded where `fits` says of each short straight piece that it may be flown, and taken slowly where
    /// not. At the last waypoint the robot stops.
    pub fn follow(
        &mut self,
        waypoints: &[[f64; 3]],
        limits: &MotionLimits,
        fits: impl Fn([f64; 3], [f64; 3]) -> bool,
    ) {
        let committed = self.stopping_path(limits);
        let speed = self.speed();
        // The corner at which the new path leaves the old one is rounded only as far as the robot can still
        // slow down.
        let mut tail_m = straight_tail_m(&committed).min(CORNER_M);
        loop {
            let (points, kept) = rounded(&committed, tail_m, waypoints, &fits);
            let lengths: Vec<f64> = points.windows(2).map(|pair| distance(pair[0], pair[1])).collect();
            let mut caps = vec![f64::INFINITY; points.len()];
            slow_in_bends(&mut caps, &points, &lengths, limits.acceleration_m_s2);
            // Bends that were begun keep the speed they were begun with: the robot is in the middle of a sample.
            for (i, cap) in caps.iter_mut().enumerate().take(kept.saturating_sub(1)) {
                *cap = if i == 0 { f64::INFINITY } else { self.caps[self.segment + i] };
            }
            let mut speeds: Vec<f64> = caps.iter().map(|cap| cap.min(limits.speed_m_s.max(speed))).collect();
            speeds[0] = speed.max(CREEP_M_S);
            let last = speeds.len() - 1;
            speeds[last] = if last == 0 { 0.0 } else { CREEP_M_S };
            slow_to_reach(&mut speeds, &lengths, limits.acceleration_m_s2);
            if last > 0 && speeds[0] < speed - 1e-6 && tail_m > 0.0 {
                tail_m = if tail_m > SAMPLE_M { tail_m / 2.0 } else { 0.0 };
                continue;
            }
            if last > 0 {
                // Never a jump of speed, whatever the waypoints were.
                speeds[0] = speed.max(CREEP_M_S);
            }
            (self.points, self.lengths, self.speeds, self.caps) = (points, lengths, speeds, caps);
            (self.segment, self.along) = (0, 0.0);
            return;
        }
    }

    /// Comes to rest as soon as possible, on its path, and stays there.
    pub fn brake(&mut self, limits: &MotionLimits) {
        let points = self.stopping_path(limits);
        let speed = self.speed();
        let lengths: Vec<f64> = points.windows(2).map(|pair| distance(pair[0], pair[1])).collect();
        let mut square = speed * speed;
        let mut speeds = vec![speed];
        for length in &lengths {
            square -= 2.0 * limits.acceleration_m_s2 * length;
            speeds.push(square.max(0.0).sqrt());
        }
        let last = speeds.len() - 1;
        speeds[last] = 0.0;
        let mut caps: Vec<f64> = self.caps.iter().skip(self.segment).take(points.len()).copied().collect();
        caps.resize(points.len(), f64::INFINITY);
        (self.points, self.lengths, self.speeds, self.caps) = (points, lengths, speeds, caps);
        (self.segment, self.along) = (0, 0.0);
    }

    /// Lets time pass: `dt_s` seconds along the path, and towards `yaw_target` (radians) as fast as the yaw rate
    /// allows, the shorter way round.
    pub fn step(&mut self, dt_s: f64, yaw_target: f64, limits: &MotionLimits) {
        let turn = wrapped(yaw_target - self.yaw);
        let most = limits.yaw_rate_rad_s * dt_s;
        self.yaw = wrapped(self.yaw + turn.clamp(-most, most));
        let mut left = dt_s;
        while self.segment < self.lengths.len() {
            let length = self.lengths[self.segment];
            let (now, end) = (self.speed(), self.speeds[self.segment + 1]);
            let lasts = 2.0 * (length - self.along) / (now + end).max(1e-9);
            if lasts > left {
                self.along += now * left + 0.5 * self.acceleration() * left * left;
                self.along = self.along.clamp(0.0, length);
                // Never at a sample and short of it at once: paths cut off here would have pieces without length.
                if self.along > length - 1e-9 {
                    self.segment += 1;
                    self.along = 0.0;
                }
                return;
            }
            left -= lasts;
            self.segment += 1;
            self.along = 0.0;
        }
    }

    /// Acceleration on the segment that the robot is on.
    fn acceleration(&self) -> f64 {
        let (v0, v1) = (self.speeds[self.segment], self.speeds[self.segment + 1]);
        (v1 * v1 - v0 * v0) / (2.0 * self.lengths[self.segment])
    }
}

/// Metres at the end of a path that are straight.
fn straight_tail_m(path: &[[f64; 3]]) -> f64 {
    let Some(&end) = path.last() else { return 0.0 };
    let mut tail = 0.0;
    let mut length = 0.0;
    for pair in path.windows(2).rev() {
        length += distance(pair[0], pair[1]);
        // Straight: as long as the line to its end.
        if length - distance(pair[0], end) > 1e-9 * length {
            break;
        }
        tail = length;
    }
    tail
}
