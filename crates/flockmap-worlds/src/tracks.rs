//! Where things that move are at any time: obstacles on the loose, and team-mates on known flights.

use crate::curve::between;
use crate::random::Random;
use crate::{Body, OptionError, SCAN_PERIOD_MICROS, Shape, World};
use flockmap_grid::{Pose, Stamp, VoxelBox};
use thiserror::Error;

/// Most tracks together.
const TRACKS_MAX: usize = 1_024;

/// Most seconds of obstacle flight in one call: a million, at most 400 MB if every obstacle is turned back ten
/// times a second, and a hundredth of it as a rule.
const OBSTACLE_SECONDS_MAX: f64 = 1e6;

/// Places tried for an obstacle to start in.
const STARTS_TRIED: usize = 1_000;

/// How obstacles move about. The sizes and speeds are MARSIM's.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct ObstacleOptions {
    /// How many there are, 0 … 1,024. Default 10.
    pub count: usize,
    /// Least and greatest width in metres, 0.05 … 5. Default 0.6 to 0.8.
    pub size_m: [f64; 2],
    /// Least and greatest speed in m/s, 0 … 10. Default 1 to 3.
    pub speed_m_s: [f64; 2],
    /// When they start. Default 0.
    pub start: Stamp,
    /// How long they move, in seconds; then they stay where they are. 0 … 14,400. Default 600.
    pub duration_s: f64,
}

impl Default for ObstacleOptions {
    fn default() -> Self {
        Self { count: 10, size_m: [0.6, 0.8], speed_m_s: [1.0, 3.0], start: Stamp(0), duration_s: 600.0 }
    }
}

/// Why there are no such tracks.
#[derive(Clone, PartialEq, Debug, Error)]
#[non_exhaustive]
pub enum TracksError {
    /// An option is out of its range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// An obstacle finds no free place.
    #[error(
        "no free place for moving obstacle {number} of {count}: {tried} places tried for a width of {size_m:.2} m; use smaller ones"
    )]
    NoRoom {
        /// Which obstacle, counted from 1.
        number: usize,
        /// Of how many.
        count: usize,
        /// Its width in metres.
        size_m: f64,
        /// Places tried.
        tried: usize,
    },
    /// There are 1,024 tracks.
    #[error("more than 1,024 tracks: use fewer obstacles")]
    TooMany,
}

/// The tracks of things that move and are seen, known beforehand.
///
/// ```
/// use flockmap_grid::Stamp;
/// use flockmap_worlds::{ObstacleOptions, Shape, Tracks, Trajectory, TrajectoryOptions, World};
///
/// let world = World::indoor(1);
/// let options = ObstacleOptions { count: 5, duration_s: 10.0, ..ObstacleOptions::default() };
/// let mut tracks = Tracks::obstacles(&world, 1, &options)?;
/// let flights = TrajectoryOptions { duration_s: 1.0, ..TrajectoryOptions::default() };
/// let mut own = 0;
/// for trajectory in Trajectory::plan(&world, 2, 1, &flights)? {
///     own = tracks.push(Shape::ROBOT, trajectory.poses())?;
/// }
/// // What the second robot sees of the others: five obstacles and the first robot.
/// assert_eq!(tracks.bodies_at(Stamp(500_000), Some(own)).len(), 6);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Tracks {
    tracks: Vec<Track>,
}

#[derive(Clone, PartialEq, Debug)]
struct Track {
    shape: Shape,
    /// Where it is when; straight on at constant speed in between. Not empty, stamps ascend.
    places: Vec<(Stamp, [f64; 3])>,
}

impl Tracks {
    /// Obstacles that move about in a world: spheres and boxes in turn, two that fly straight on and then two
    /// that change their direction every one to three seconds. They bounce off whatever is solid and off the
    /// ends of the world, and pass through each other and through robots (which do not see what they are
    /// inside of). The same arguments give the same tracks on every machine. About 1 µs for each obstacle and
    /// tenth of a second.
    pub fn obstacles(world: &World, seed: u64, options: &ObstacleOptions) -> Result<Self, TracksError> {
        check(options)?;
        let mut tracks = Vec::with_capacity(options.count);
        for number in 0..options.count {
            let mut random = Random::new(seed, 0x0b57 + number as u64);
            let size_m = random.range(options.size_m[0], options.size_m[1]);
            let shape = if number % 2 == 0 {
                Shape::Sphere { radius_m: 0.5 * size_m }
            } else {
                Shape::Box { half_m: [0.5 * size_m; 3] }
            };
            let start = (0..STARTS_TRIED)
                .map(|_| anywhere(world, &mut random))
                .find(|place| fits(world, &shape, *place))
                .ok_or(TracksError::NoRoom {
                    number: number + 1,
                    count: options.count,
                    size_m,
                    tried: STARTS_TRIED,
                })?;
            let wanders = number / 2 % 2 == 1;
            tracks.push(roam(world, shape, start, wanders, options, &mut random));
        }
        Ok(Self { tracks })
    }

    /// Adds something that moves through these poses, straight from one to the next; before the first and
    /// after the last it stays. Stamps must ascend (others are left out). Returns its index, by which it can
    /// be left out of what it sees itself. Without a pose it is never seen.
    pub fn push(&mut self, shape: Shape, poses: &[(Stamp, Pose)]) -> Result<usize, TracksError> {
        if self.tracks.len() >= TRACKS_MAX {
            return Err(TracksError::TooMany);
        }
        let mut places = Vec::with_capacity(poses.len());
        poses.iter().for_each(|(stamp, pose)| push(&mut places, *stamp, pose.translation()));
        self.tracks.push(Track { shape, places });
        Ok(self.tracks.len() - 1)
    }

    /// Number of tracks.
    pub const fn len(&self) -> usize {
        self.tracks.len()
    }

    /// Whether there are none.
    pub const fn is_empty(&self) -> bool {
        self.tracks.is_empty()
    }

    /// Where the centre of a track is at a time, in metres. `None` if there is no such track.
    pub fn position(&self, track: usize, at: Stamp) -> Option<[f64; 3]> {
        self.tracks.get(track)?.position(at)
    }

    /// Everything as it is at a time, in the order of tracks, but for the track `except`.
    pub fn bodies_at(&self, at: Stamp, except: Option<usize>) -> Vec<Body> {
        let others = self.tracks.iter().enumerate().filter(|(index, _)| Some(*index) != except);
        others
            .filter_map(|(_, track)| Some(Body { shape: track.shape, centre_m: track.position(at)? }))
            .collect()
    }
}

impl Track {
    fn position(&self, at: Stamp) -> Option<[f64; 3]> {
        let next = self.places.partition_point(|(stamp, _)| *stamp <= at);
        let (Some(&(from, start)), Some(&(to, end))) =
            (next.checked_sub(1).and_then(|last| self.places.get(last)), self.places.get(next))
        else {
            // Before the first or after the last.
            return self.places.get(next).or_else(|| self.places.last()).map(|(_, place)| *place);
        };
        Some(between(start, end, (at.0 - from.0) as f64 / (to.0 - from.0) as f64))
    }
}

fn check(options: &ObstacleOptions) -> Result<(), OptionError> {
    let ([small, large], [slow, fast]) = (options.size_m, options.speed_m_s);
    let count = options.count as f64;
    OptionError::check(&[
        ("count", count, 0.0, TRACKS_MAX as f64, "0 to 1,024"),
        ("size_m[0]", small, 0.05, 5.0, "0.05 to 5"),
        ("size_m[1]", large, small, 5.0, "size_m[0] to 5"),
        ("speed_m_s[0]", slow, 0.0, 10.0, "0 to 10"),
        ("speed_m_s[1]", fast, slow, 10.0, "speed_m_s[0] to 10"),
        ("duration_s", options.duration_s, 0.0, 14_400.0, "0 to 14,400"),
        ("count × duration_s", count * options.duration_s, 0.0, OBSTACLE_SECONDS_MAX, "up to 1,000,000"),
    ])
}

/// The path of one obstacle, a tenth of a second at a time.
fn roam(
    world: &World,
    shape: Shape,
    start: [f64; 3],
    wanders: bool,
    options: &ObstacleOptions,
    random: &mut Random,
) -> Track {
    let period_s = SCAN_PERIOD_MICROS as f64 * 1e-6;
    let steps = (options.duration_s / period_s) as i64;
    let speed = random.range(options.speed_m_s[0], options.speed_m_s[1]);
    let mut velocity = heading(random).map(|v| v * speed);
    let mut place = start;
    let mut places = vec![(options.start, place)];
    let mut turn_at = if wanders { turn_after(random) } else { i64::MAX };
    let mut last_moved = None;
    for step in 0..steps {
        if step == turn_at {
            velocity = heading(random).map(|v| v * speed);
            turn_at = step + turn_after(random);
        }
        let ahead = |velocity: [f64; 3]| core::array::from_fn(|a| place[a] + velocity[a] * period_s);
        let free = bounce(velocity).find(|bounced| fits(world, &shape, ahead(*bounced)));
        // Shut in on all sides it waits, which cannot last, since it came from somewhere.
        velocity = free.unwrap_or_else(|| velocity.map(|v| -v));
        let moved = free.unwrap_or_default();
        if last_moved != Some(moved) {
            push(&mut places, options.start.plus_micros(step * SCAN_PERIOD_MICROS), place);
        }
        last_moved = Some(moved);
        place = ahead(moved);
    }
    push(&mut places, options.start.plus_micros(steps * SCAN_PERIOD_MICROS), place);
    Track { shape, places }
}

fn push(places: &mut Vec<(Stamp, [f64; 3])>, at: Stamp, place: [f64; 3]) {
    if places.last().is_none_or(|(last, _)| *last < at) {
        places.push((at, place));
    }
}

/// A velocity, and then what is left of it after bouncing off walls across one, two and all axes.
fn bounce(velocity: [f64; 3]) -> impl Iterator<Item = [f64; 3]> {
    [0b000, 0b001, 0b010, 0b100, 0b011, 0b101, 0b110, 0b111].into_iter().map(move |turned: u32| {
        core::array::from_fn(|a| if turned >> a & 1 == 0 { velocity[a] } else { -velocity[a] })
    })
}

/// A direction, at most 17° up or down.
fn heading(random: &mut Random) -> [f64; 3] {
    loop {
        let [x, y] = [random.range(-1.0, 1.0), random.range(-1.0, 1.0)];
        let flat = (x * x + y * y).sqrt();
        if 0.1 < flat && flat <= 1.0 {
            let up = random.range(-0.3, 0.3);
            let length = (1.0 + up * up).sqrt();
            return [x / flat / length, y / flat / length, up / length];
        }
    }
}

/// One to three seconds, in steps.
fn turn_after(random: &mut Random) -> i64 {
    10 + random.below(21) as i64
}

fn anywhere(world: &World, random: &mut Random) -> [f64; 3] {
    let side = world.resolution().metres();
    let (low, high) = (world.bounds().min(), world.bounds().max());
    [(low.x, high.x), (low.y, high.y), (low.z, high.z)]
        .map(|(low, high)| random.range(f64::from(low) * side, (f64::from(high) + 1.0) * side))
}

/// Whether something of this shape fits here: inside of the world, in nothing solid, its centre not where the
/// world does not know.
fn fits(world: &World, shape: &Shape, place: [f64; 3]) -> bool {
    let half = shape.half_m();
    let corner = |sign: f64| {
        let corner = core::array::from_fn(|a| place[a] + sign * half[a]);
        world.resolution().voxel_at(corner).filter(|cell| world.bounds().contains(*cell))
    };
    let (Some(low), Some(high)) = (corner(-1.0), corner(1.0)) else { return false };
    let is_known = || {
        let centre = world.resolution().voxel_at(place);
        centre.is_some_and(|cell| world.is_known_free(cell) != Some(false))
    };
    VoxelBox::spanning(low, high).is_some_and(|region| !world.is_any_solid(&region)) && is_known()
}
