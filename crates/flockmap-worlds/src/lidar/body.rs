//! Things that are not of the world and are seen all the same: team-mates and moving obstacles.

use super::ScanOptions;

/// The form of a body, about its centre.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Shape {
    /// A sphere.
    Sphere {
        /// Its radius in metres.
        radius_m: f64,
    },
    /// A box whose sides stay parallel to the axes of the map.
    Box {
        /// Half of its sides in metres.
        half_m: [f64; 3],
    },
}

/// Something that is seen in a scan beside the world.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Body {
    /// Its form.
    pub shape: Shape,
    /// Where its centre is at the time of the scan, in the frame of the map.
    pub centre_m: [f64; 3],
}

impl Shape {
    /// A robot: 0.4 × 0.4 × 0.3 m.
    pub const ROBOT: Self = Self::Box { half_m: [0.2, 0.2, 0.15] };

    /// Half of the sides of the smallest box parallel to the axes that holds the shape, in metres.
    pub const fn half_m(&self) -> [f64; 3] {
        match *self {
            Self::Sphere { radius_m } => [radius_m; 3],
            Self::Box { half_m } => half_m,
        }
    }

    /// Radius of the smallest sphere about the centre that holds the shape, in metres.
    pub fn reach_m(&self) -> f64 {
        match *self {
            Self::Sphere { radius_m } => radius_m,
            Self::Box { half_m } => half_m.iter().map(|h| h * h).sum::<f64>().sqrt(),
        }
    }
}

impl Body {
    /// A robot with its centre here.
    pub const fn robot(centre_m: [f64; 3]) -> Self {
        Self { shape: Shape::ROBOT, centre_m }
    }

    /// Metres along a ray to where it enters the body; `direction` must have length 1. `None` if it misses,
    /// or if the ray starts inside: a sensor does not see the body that carries it.
    pub fn distance_m(&self, origin: [f64; 3], direction: [f64; 3]) -> Option<f64> {
        let to: [f64; 3] = core::array::from_fn(|a| self.centre_m[a] - origin[a]);
        let along = dot(to, direction);
        let distance = match self.shape {
            Shape::Sphere { radius_m } => {
                let outside = dot(to, to) - radius_m * radius_m;
                let square = along * along - outside;
                if outside <= 0.0 || square < 0.0 {
                    return None;
                }
                along - square.sqrt()
            }
            Shape::Box { half_m } => {
                let [low, high] = [-1.0, 1.0].map(|side| core::array::from_fn(|a| to[a] + side * half_m[a]));
                let (enter, leave) = box_crossing(low, high, direction);
                if enter > leave {
                    return None;
                }
                enter
            }
        };
        (distance > 0.0).then_some(distance)
    }
}

/// Where a ray enters and leaves a box, in multiples of its direction; the corners are counted from where the
/// ray starts. It leaves before it enters if it misses.
pub fn box_crossing(low: [f64; 3], high: [f64; 3], direction: [f64; 3]) -> (f64, f64) {
    let (mut enter, mut leave) = (f64::NEG_INFINITY, f64::INFINITY);
    for a in 0..3 {
        if direction[a] != 0.0 {
            let (one, other) = (low[a] / direction[a], high[a] / direction[a]);
            enter = enter.max(one.min(other));
            leave = leave.min(one.max(other));
        } else if low[a] > 0.0 || high[a] < 0.0 {
            return (f64::INFINITY, f64::NEG_INFINITY);
        }
    }
    (enter, leave)
}

/// The bodies that a scan can see.
pub(super) struct Sight {
    bodies: Vec<(Body, f64)>,
}

impl Sight {
    /// Those of the bodies within range of a sensor that stays within `travel_m` of `origin`.
    pub(super) fn new(bodies: &[Body], origin: [f64; 3], travel_m: f64, options: &ScanOptions) -> Self {
        let near = |&body: &Body| {
            let to: [f64; 3] = core::array::from_fn(|a| body.centre_m[a] - origin[a]);
            let reach = body.shape.reach_m();
            let range = options.range_m + travel_m + reach;
            (dot(to, to) <= range * range).then_some((body, reach * reach))
        };
        Self { bodies: bodies.iter().filter_map(near).collect() }
    }

    /// Metres to the nearest body on a ray, if it is nearer than `limit_m`.
    pub(super) fn nearest(&self, origin: [f64; 3], direction: [f64; 3], limit_m: f64) -> Option<f64> {
        let mut nearest = None;
        let mut limit = limit_m;
        for (body, reach_squared) in &self.bodies {
            let to: [f64; 3] = core::array::from_fn(|a| body.centre_m[a] - origin[a]);
            let along = dot(to, direction);
            // Passes by the sphere around the body, or has it behind.
            let square = dot(to, to);
            if square - along * along > *reach_squared || (along < 0.0 && square > *reach_squared) {
                continue;
            }
            if let Some(distance) = body.distance_m(origin, direction)
                && distance <= limit
            {
                limit = distance;
                nearest = Some(distance);
            }
        }
        nearest
    }
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}
