//! The application of the paper (Sec. V-B): two robots cross a dense thicket in line. The leader's LiDAR faces
//! backwards, so it sees what lies ahead only through the map of its follower.
//!
//! Both are real [`flockmap::Robot`]s. Each plans on nothing but its own fused map; unknown space counts as
//! free. What becomes of them is judged in the world as it is.
//!
//! ```
//! use flockmap_autonomy::application::{ApplicationOptions, Course, Ending, MapSync, fly};
//!
//! let options = ApplicationOptions { sync: MapSync::None, seconds_max: 1.0, ..ApplicationOptions::default() };
//! let outcome = fly(&Course::thicket(1), &options)?;
//! assert_eq!(outcome.ending, Ending::TimeOut);
//! # Ok::<(), flockmap::RobotError>(())
//! ```

mod course;
mod judge;
mod options;
mod outcome;
mod pair;
mod pilot;
mod route;
mod series;
mod sight;
mod slab;

use crate::MotionLimits;
use flockmap::RobotError;
use flockmap_grid::Stamp;
use flockmap_worlds::SCAN_PERIOD_MICROS;
use flockmap_worlds::curve::{distance, line};

pub use course::Course;
pub use judge::BODY_RADIUS_M;
pub use options::{ApplicationOptions, MapSync};
pub use outcome::{ApplicationOutcome, Ending, RobotTraffic};
pub use series::{Series, SeriesOptions, series};

use pair::{FOLLOWER, LEADER, Pair};
use pilot::{Flyer, Pilot, STEP_S};
use route::POINT_EVERY_M;

/// The robots hover so long before they set off, in seconds, so that they find each other and have a map.
const HOVER_S: f64 = 2.0;
/// The leader is there when it is this near to the goal.
const GOAL_RADIUS_M: f64 = 0.5;
/// The leader flies slower, down to standing still, while the follower is farther behind than it should be by
/// this much more.
const STRETCH_M: [f64; 2] = [0.8, 2.0];
/// The follower looks at the point so far ahead on the leader's path.
const LOOK_AHEAD_M: f64 = 2.0;
/// Turning rate of both robots.
const YAW_RATE_RAD_S: f64 = 1.4;

/// Flies one course. Deterministic: the same course and options give the same outcome on every machine.
///
/// # Errors
/// [`RobotError`] names an option that cannot work.
pub fn fly(course: &Course, options: &ApplicationOptions) -> Result<ApplicationOutcome, RobotError> {
    let mut flight = Flight::new(course, options)?;
    let mut ending = None;
    while ending.is_none() && flight.now.seconds() < options.seconds_max {
        flight.scan();
        flight.plan();
        ending = flight.fly_on();
    }
    Ok(flight.into_outcome(ending.unwrap_or(Ending::TimeOut)))
}

/// A flight in progress.
struct Flight<'a> {
    course: &'a Course,
    options: &'a ApplicationOptions,
    pair: Pair,
    now: Stamp,
    limits: MotionLimits,
    pilots: [Pilot; 2],
    flyers: [Flyer; 2],
    /// Where the leader was, each 10 cm, with the line to it from the follower's start.
    trail: Vec<[f64; 2]>,
    path_m: f64,
}

impl<'a> Flight<'a> {
    fn new(course: &'a Course, options: &'a ApplicationOptions) -> Result<Self, RobotError> {
        let limits = MotionLimits {
            speed_m_s: options.speed_m_s,
            acceleration_m_s2: options.acceleration_m_s2,
            yaw_rate_rad_s: YAW_RATE_RAD_S,
        };
        let at = |start: [f64; 3], yaw| Flyer {
            position: [start[0], start[1]],
            velocity: [0.0; 2],
            height: start[2],
            yaw,
        };
        let (leader, follower) = (course.leader_start, course.follower_start);
        let ahead = libm::atan2(leader[1] - follower[1], leader[0] - follower[0]);
        Ok(Self {
            course,
            options,
            pair: Pair::new(options, Stamp(0))?,
            now: Stamp(0),
            limits,
            pilots: [(); 2].map(|()| Pilot::new(limits, course.fence)),
            flyers: [at(leader, ahead + core::f64::consts::PI), at(follower, ahead)],
            trail: line([follower[0], follower[1]], [leader[0], leader[1]], POINT_EVERY_M).collect(),
            path_m: 0.0,
        })
    }

    /// Both robots take a scan and map it.
    fn scan(&mut self) {
        for number in [LEADER, FOLLOWER] {
            let pose = self.flyers[number].pose();
            let other = self.flyers[1 - number].point();
            let scan = sight::scan(self.options, &self.course.world, &pose, self.now, other);
            self.pair.insert_scan(number, &scan, &pose, other);
        }
    }

    /// Both robots plan on the maps that they have.
    fn plan(&mut self) {
        let hovers = self.now.seconds() < HOVER_S;
        let [leader, follower] = self.flyers;
        let gap = distance(leader.position, follower.position) - self.options.distance_m;
        let stretch = (STRETCH_M[1] - gap) / (STRETCH_M[1] - STRETCH_M[0]);
        let leader_speed = self.limits.speed_m_s * stretch.clamp(0.0, 1.0);
        let targets = [self.course.goal, self.follower_target()];
        // The follower may catch up.
        let speeds = [leader_speed, self.limits.speed_m_s * 1.2];
        for number in [LEADER, FOLLOWER] {
            let other = self.flyers[1 - number].position;
            let view = self.pair.robot(number).view();
            let speed = if hovers { 0.0 } else { speeds[number] };
            self.pilots[number].plan(&view, &self.flyers[number], targets[number], speed, other);
        }
    }

    /// A point on the leader's trail at the wanted distance behind it.
    fn follower_target(&self) -> [f64; 2] {
        let leader = self.flyers[LEADER].position;
        let far_enough = |point: &&[f64; 2]| distance(**point, leader) >= self.options.distance_m;
        let target = self.trail.iter().rev().find(far_enough);
        target.copied().unwrap_or(self.flyers[FOLLOWER].position)
    }

    /// A tenth of a second of motion, while the radio works.
    fn fly_on(&mut self) -> Option<Ending> {
        let steps = (SCAN_PERIOD_MICROS as f64 / 1e6 / STEP_S).round() as i64;
        for step in 1..=steps {
            let before = self.flyers[LEADER].position;
            for (pilot, flyer) in self.pilots.iter_mut().zip(&mut self.flyers) {
                pilot.step(flyer);
            }
            let leader = self.flyers[LEADER].position;
            self.path_m += distance(before, leader);
            self.turn();
            if self.trail.last().is_none_or(|last| distance(*last, leader) >= 0.1) {
                self.trail.push(leader);
            }
            let at = self.now.plus_micros(SCAN_PERIOD_MICROS * step / steps);
            let [leader_at, follower_at] = [LEADER, FOLLOWER].map(|number| self.flyers[number].point());
            let ending = judge::collision(&self.course.world, leader_at, follower_at)
                .or_else(|| (distance(leader, self.course.goal) <= GOAL_RADIUS_M).then_some(Ending::Goal));
            if ending.is_some() || step == steps {
                self.pair.advance(at);
                self.now = at;
                return ending;
            }
        }
        None
    }

    /// The leader's LiDAR faces against its direction of flight; the follower's looks along the leader's path
    /// ahead.
    fn turn(&mut self) {
        let leader = self.flyers[LEADER];
        if let Some(heading) = self.pilots[LEADER].heading(&leader) {
            self.flyers[LEADER].turn(heading + core::f64::consts::PI, &self.limits);
        }
        let look_at = self.pilots[LEADER].ahead(LOOK_AHEAD_M).unwrap_or(leader.position);
        let follower = &mut self.flyers[FOLLOWER];
        let d = [look_at[0] - follower.position[0], look_at[1] - follower.position[1]];
        if d != [0.0; 2] {
            follower.turn(libm::atan2(d[1], d[0]), &self.limits);
        }
    }

    fn into_outcome(self, ending: Ending) -> ApplicationOutcome {
        let [leader, follower] = self.pair.traffic();
        let (seconds, leader_at) = (self.now.seconds(), self.flyers[LEADER].point());
        let ages = self.pair.into_ages();
        let age = |share: f64| {
            let rank = (share * ages.len() as f64).ceil().max(1.0) as usize;
            ages.get(rank - 1).map_or(0.0, |micros| *micros as f64 / 1e6)
        };
        ApplicationOutcome {
            ending,
            seconds,
            leader_at,
            leader_path_m: self.path_m,
            leader,
            follower,
            obstacle_age_median_s: age(0.5),
            obstacle_age_p99_s: age(0.99),
        }
    }
}
