//! A LiDAR at work in a world.

use super::body::{Body, Sight};
use super::course::Course;
use super::polar::PolarImage;
use super::{Lidar, Rendering, SCAN_PERIOD_MICROS, ScanOptions};
use crate::World;
use crate::random::{Random, hash_at, unit};
use core::ops::Range;
use flockmap_grid::{Pose, Scan, Stamp};
use std::sync::Arc;

/// Images that are rendered for a scan in motion: one each 10 ms.
const SLICES: usize = 10;

/// A LiDAR that takes scans in a world. Everything it returns depends on nothing but its arguments, to the last
/// bit and on every machine; a scanner only keeps buffers between scans (some 10 MB at most). Robots and
/// threads have a scanner each and share the world.
///
/// ```
/// use flockmap_grid::{Pose, Stamp};
/// use flockmap_worlds::{Body, Lidar, ScanOptions, Scanner, World};
/// use std::sync::Arc;
///
/// let world = Arc::new(World::indoor(1));
/// let mut scanner = Scanner::new(world, Lidar::Mid360, ScanOptions::default());
/// let pose = Pose::from_translation([-1.0, 1.2, 1.7]);
/// let team_mate = Body::robot([1.0, 1.2, 1.8]);
/// let scan = scanner.scan(Stamp(0), &pose, None, &[team_mate]);
/// assert!(scan.points.len() > 19_000);
/// ```
///
/// Cost on one core: see `benches/scan.rs`; a few milliseconds for 20,000 beams in the generated worlds.
#[derive(Clone, Debug)]
pub struct Scanner {
    world: Arc<World>,
    lidar: Lidar,
    options: ScanOptions,
    /// The beams of the last scan.
    beams: Vec<[f64; 3]>,
    image: PolarImage,
}

impl Scanner {
    /// A scanner. With [`Rendering::Polar`] the first scanner of a world takes its surface, which takes about
    /// half a second; all later ones share it. What options may be: [`ScanOptions::check`].
    pub fn new(world: Arc<World>, lidar: Lidar, options: ScanOptions) -> Self {
        let (_, elevation_deg) = lidar.field_of_view_deg();
        let image = match options.rendering {
            Rendering::Cast => PolarImage::default(),
            Rendering::Polar => {
                world.surface();
                PolarImage::new(elevation_deg)
            }
        };
        Self { world, lidar, options, beams: Vec::new(), image }
    }

    /// The scan that starts at `stamp` with the sensor at `T_map_sensor`.
    ///
    /// `end` is the pose of the sensor at the end of the scan, 0.1 s later; it is used with
    /// [`ScanOptions::motion`] only. Each point is then given in the frame of the sensor at the moment of its
    /// beam, as a real device does. [`Rendering::Polar`] takes ten images for such a scan.
    ///
    /// `bodies` are seen beside the world, but for those that the sensor is inside of. They are cast exactly
    /// with either rendering.
    ///
    /// With [`Rendering::Cast`] a point of the world lies where its beam enters a solid cell, moved inside of
    /// the cell by at most 1 % of its side on each axis; so without noise the cell at a point is solid.
    #[allow(non_snake_case)]
    pub fn scan(&mut self, stamp: Stamp, T_map_sensor: &Pose, end: Option<&Pose>, bodies: &[Body]) -> Scan {
        if !(self.lidar.repeats() && self.beams.len() == self.lidar.beams()) {
            self.beams = self.lidar.directions(stamp);
        }
        let course = Course::new(T_map_sensor, end.filter(|_| self.options.motion));
        let sight = Sight::new(bodies, T_map_sensor.translation(), course.travel_m(), &self.options);
        let mut delivery = Delivery { options: self.options, stamp, scan: Scan { stamp, ..Scan::default() } };
        match self.options.rendering {
            Rendering::Cast => self.cast(&course, &sight, &mut delivery),
            Rendering::Polar => {
                let slices = if course.moves() { SLICES } else { 1 };
                for slice in 0..slices {
                    let middle = SCAN_PERIOD_MICROS * (2 * slice as i64 + 1) / (2 * slices as i64);
                    let beams = self.beams.len() * slice / slices..self.beams.len() * (slice + 1) / slices;
                    self.render(&course.at(middle), beams, &sight, &mut delivery);
                }
            }
        }
        delivery.scan
    }

    fn cast(&self, course: &Course, sight: &Sight, delivery: &mut Delivery) {
        let view = |at: i64| {
            let pose = course.at(at);
            (pose.rotation_rows(), pose.translation())
        };
        let mut at = 0;
        let (mut rows, mut origin) = view(at);
        for (number, &beam) in self.beams.iter().enumerate() {
            if course.moves() && self.lidar.fired_after_micros(number) != at {
                at = self.lidar.fired_after_micros(number);
                (rows, origin) = view(at);
            }
            let direction = rows.map(|row| row[0] * beam[0] + row[1] * beam[1] + row[2] * beam[2]);
            let hit = self.world.cast_ray(origin, direction, self.options.range_m);
            let limit = hit.map_or(self.options.range_m, |hit| hit.distance_m);
            if let Some(distance) = sight.nearest(origin, direction, limit) {
                delivery.point(number, beam, distance, beam.map(|v| v * distance));
            } else if let Some(hit) = hit {
                let offset: [f64; 3] = core::array::from_fn(|a| hit.point[a] - origin[a]);
                let point = core::array::from_fn(|a| {
                    rows[0][a] * offset[0] + rows[1][a] * offset[1] + rows[2][a] * offset[2]
                });
                delivery.point(number, beam, hit.distance_m, point);
            } else {
                delivery.nothing(number, beam);
            }
        }
    }

    fn render(&mut self, pose: &Pose, beams: Range<usize>, sight: &Sight, delivery: &mut Delivery) {
        let range_m = self.options.range_m;
        let (rows, origin) = (pose.rotation_rows(), pose.translation());
        self.image.aim(&self.beams[beams.clone()]);
        self.image.paint(self.world.surface(), pose, range_m);
        for (first, seen) in self.image.pixels() {
            let (number, beam) = (beams.start + first, seen.direction);
            let surface = seen.range_m.filter(|range| *range <= range_m);
            let direction = rows.map(|row| row[0] * beam[0] + row[1] * beam[1] + row[2] * beam[2]);
            let limit = surface.unwrap_or(range_m);
            match sight.nearest(origin, direction, limit).or(surface) {
                Some(distance) => delivery.point(number, beam, distance, beam.map(|v| v * distance)),
                None => delivery.nothing(number, beam),
            }
        }
    }
}

/// What comes out of the sensor for each of its beams.
struct Delivery {
    options: ScanOptions,
    stamp: Stamp,
    scan: Scan,
}

impl Delivery {
    /// Beam `number` comes back from `point` (frame of the sensor).
    fn point(&mut self, number: usize, beam: [f64; 3], distance_m: f64, point: [f64; 3]) {
        let options = &self.options;
        if distance_m < options.min_range_m || self.is_lost(number) {
            return;
        }
        let shift = if options.range_noise_m > 0.0 {
            let draw = hash_at(0x5ca9, self.stamp.0, number as i64, 0);
            let noise = Random::new(options.seed, draw).normal() * options.range_noise_m;
            noise.max(-distance_m)
        } else {
            0.0
        };
        self.scan.points.push(core::array::from_fn(|a| (point[a] + beam[a] * shift) as f32));
    }

    /// Beam `number` does not come back.
    fn nothing(&mut self, number: usize, beam: [f64; 3]) {
        if self.options.no_returns && !self.is_lost(number) {
            self.scan.no_returns.push(beam.map(|v| (v * self.options.range_m) as f32));
        }
    }

    fn is_lost(&self, number: usize) -> bool {
        let draw = || unit(hash_at(self.options.seed ^ 0xd20f, self.stamp.0, number as i64, 1));
        self.options.drop_out > 0.0 && draw() < self.options.drop_out
    }
}
