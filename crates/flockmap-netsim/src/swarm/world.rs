//! A small world that is quickly scanned: a hall with boxes in it, some of which move.

use flockmap_grid::{Scan, Stamp};
use flockmap_worlds::box_crossing;
use flockmap_worlds::random::Random;

/// A box along the axes, moving to and fro.
#[derive(Clone, Copy, Debug)]
struct Thing {
    min: [f64; 3],
    max: [f64; 3],
    /// Metres a second along x and y; 0 for most.
    speed: [f64; 2],
}

/// The hall and what stands in it. A ray costs one look at every box.
#[derive(Clone, Debug)]
pub(super) struct SmallWorld {
    half: [f64; 2],
    height: f64,
    things: Vec<Thing>,
}

/// How a robot flies through the hall: along straight lines, reflected at the walls.
#[derive(Clone, Copy, Debug)]
pub(super) struct Course {
    start: [f64; 3],
    speed: [f64; 2],
}

/// Goes to and fro between −half and half.
fn reflected(x: f64, half: f64) -> f64 {
    let period = 4.0 * half;
    let shifted = x + half;
    let phase = shifted - (shifted / period).floor() * period;
    if phase <= 2.0 * half { phase - half } else { 3.0 * half - phase }
}

impl SmallWorld {
    /// `scale` times as wide and as long as a small hall, with as many more boxes.
    pub(super) fn draw(random: &mut Random, scale: f64) -> Self {
        let half = [random.range(4.0, 9.0) * scale, random.range(4.0, 9.0) * scale];
        let height = random.range(2.5, 5.0);
        let things = (0..((4 + random.below(7)) as f64 * scale * scale) as u64)
            .map(|number| {
                let centre = [random.range(-half[0], half[0]), random.range(-half[1], half[1])];
                let side = random.range(0.3, 1.5);
                let top = random.range(0.5, height);
                let moves = number < 2;
                let mut speed = || if moves { random.range(-2.0, 2.0) } else { 0.0 };
                Thing {
                    min: [centre[0] - side, centre[1] - side, 0.0],
                    max: [centre[0] + side, centre[1] + side, top],
                    speed: [speed(), speed()],
                }
            })
            .collect();
        Self { half, height, things }
    }

    /// A course through the hall at up to 3 m/s.
    pub(super) fn course(&self, random: &mut Random) -> Course {
        Course {
            start: [
                random.range(-self.half[0], self.half[0]),
                random.range(-self.half[1], self.half[1]),
                random.range(0.5, self.height - 0.5),
            ],
            speed: [random.range(-3.0, 3.0), random.range(-3.0, 3.0)],
        }
    }

    /// Where the robot of a course is after some seconds.
    pub(super) fn place(&self, course: &Course, seconds: f64) -> [f64; 3] {
        let along =
            |axis: usize| reflected(course.start[axis] + course.speed[axis] * seconds, self.half[axis] - 0.3);
        [along(0), along(1), course.start[2]]
    }

    /// A scan from `from`: `rays` rays in random directions. Points are relative to the place, along the axes
    /// of the world.
    pub(super) fn scan(
        &self,
        random: &mut Random,
        from: [f64; 3],
        seconds: f64,
        stamp: Stamp,
        rays: usize,
        range_m: f64,
    ) -> Scan {
        let mut scan = Scan { stamp, points: Vec::with_capacity(rays), no_returns: Vec::new() };
        for _ in 0..rays {
            let raw = [random.range(-1.0, 1.0), random.range(-1.0, 1.0), random.range(-0.5, 0.5)];
            let length = raw.iter().map(|x| x * x).sum::<f64>().sqrt();
            if length < 0.1 {
                continue;
            }
            let direction = raw.map(|x| x / length);
            let distance = self.distance(from, direction, seconds);
            if distance <= range_m {
                scan.points.push(direction.map(|x| (x * distance) as f32));
            } else {
                scan.no_returns.push(direction.map(|x| (x * (range_m + 1.0)) as f32));
            }
        }
        scan
    }

    /// How far a ray goes.
    fn distance(&self, from: [f64; 3], direction: [f64; 3], seconds: f64) -> f64 {
        let hall = Thing {
            min: [-self.half[0], -self.half[1], 0.0],
            max: [self.half[0], self.half[1], self.height],
            speed: [0.0; 2],
        };
        // The hall is seen from inside.
        let (_, walls) = hall.crossed(from, direction, [0.0; 2]);
        let things = self.things.iter().filter_map(|thing| {
            let centre = |axis: usize| (thing.min[axis] + thing.max[axis]) / 2.0;
            let moved = |axis: usize| {
                if thing.speed[axis] == 0.0 {
                    return 0.0;
                }
                let at = centre(axis) + thing.speed[axis] * seconds;
                reflected(at, self.half[axis]) - centre(axis)
            };
            let (enters, leaves) = thing.crossed(from, direction, [moved(0), moved(1)]);
            (enters > 0.0 && enters < leaves).then_some(enters)
        });
        things.fold(walls.max(0.1), f64::min)
    }
}

impl Thing {
    /// Where a ray enters and leaves the box, moved by `moved`.
    fn crossed(&self, from: [f64; 3], direction: [f64; 3], moved: [f64; 2]) -> (f64, f64) {
        let moved = [moved[0], moved[1], 0.0];
        let seen = |corner: [f64; 3]| core::array::from_fn(|a| corner[a] + moved[a] - from[a]);
        box_crossing(seen(self.min), seen(self.max), direction)
    }
}
