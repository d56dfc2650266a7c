//! What a record shows to people beside the data: the map and the path flown, as coloured points.

use std::time::Duration;

use flockmap_grid::{Resolution, RobotId, Stamp, Voxel};

/// Most voxels of one picture of a map; a larger map is shown in larger voxels.
pub(crate) const VIEW_VOXELS_MAX: usize = 1 << 18;
/// Most points of a path; of a longer one every second is left out.
const PATH_POINTS_MAX: usize = 4096;
/// Distance of two points of a path, to begin with.
const PATH_STEP_M: f64 = 0.1;
/// Orange: seen well before the colours of the map.
const PATH_COLOUR: [u8; 3] = [255, 120, 0];
/// Red: stands out from both.
pub(crate) const SCAN_COLOUR: [u8; 3] = [255, 60, 60];
/// Heights over which the colours of the map go from the first to the last; above it they go back again.
const RAMP_M: f32 = 5.0;
/// From low to high.
const RAMP: [[u8; 3]; 5] = [[68, 58, 150], [40, 110, 160], [30, 160, 130], [120, 205, 80], [250, 230, 40]];

/// Colours of robots, by their ids: told apart by those too who see less of red and green (Okabe, Ito).
const ROBOTS: [[u8; 3]; 8] = [
    [240, 228, 66],
    [86, 180, 233],
    [230, 159, 0],
    [0, 158, 115],
    [204, 121, 167],
    [0, 114, 178],
    [213, 94, 0],
    [200, 200, 200],
];

/// A point and its colour (red, green, blue).
pub(crate) type ColouredPoint = ([f32; 3], [u8; 3]);

/// When pictures are due. They never take more bytes than what is not drawn, such as scans, so that a long flight
/// stays small.
#[derive(Debug)]
pub(crate) struct ViewSchedule {
    /// 0: never.
    period_micros: i64,
    last: Option<Stamp>,
    scan_bytes: u64,
    view_bytes: u64,
}

impl Default for ViewSchedule {
    /// Every 2 s.
    fn default() -> Self {
        Self::new(Duration::from_secs(2))
    }
}

impl ViewSchedule {
    pub(crate) fn new(period: Duration) -> Self {
        let period_micros = i64::try_from(period.as_micros()).unwrap_or(i64::MAX);
        Self { period_micros, last: None, scan_bytes: 0, view_bytes: 0 }
    }

    pub(crate) fn is_due(&self, now: Stamp) -> bool {
        self.period_micros > 0
            && self.view_bytes <= self.scan_bytes
            && self.last.is_none_or(|last| now.micros_since(last) >= self.period_micros)
    }

    pub(crate) const fn scan_written(&mut self, bytes: usize) {
        self.scan_bytes += bytes as u64;
    }

    pub(crate) fn view_written(&mut self, now: Stamp, bytes: usize) {
        self.last = Some(now);
        self.view_bytes += bytes as u64;
    }
}

/// The places that a robot came by. At most 98 kB.
#[derive(Debug)]
pub(crate) struct Travelled {
    places: Vec<[f64; 3]>,
    step_m: f64,
    now: Option<[f64; 3]>,
}

impl Default for Travelled {
    fn default() -> Self {
        Self { places: Vec::new(), step_m: PATH_STEP_M, now: None }
    }
}

impl Travelled {
    pub(crate) fn push(&mut self, place: [f64; 3]) {
        self.now = Some(place);
        let far = |last: &[f64; 3]| {
            let squared: f64 = last.iter().zip(place).map(|(a, b)| (a - b) * (a - b)).sum();
            squared >= self.step_m * self.step_m
        };
        if !self.places.last().is_none_or(far) {
            return;
        }
        if self.places.len() >= PATH_POINTS_MAX {
            self.places = self.places.iter().copied().step_by(2).collect();
            self.step_m *= 2.0;
        }
        self.places.push(place);
    }

    /// The places in order, the present one last.
    pub(crate) fn points(&self) -> Vec<ColouredPoint> {
        let last = self.now.filter(|now| self.places.last() != Some(now));
        let places = self.places.iter().copied().chain(last);
        places.map(|place| (place.map(|v| v as f32), PATH_COLOUR)).collect()
    }
}

/// The middles of voxels in metres, coloured by height, and by the robot that saw them where that is known, in the
/// order of the voxels. Where they are more than `voxels_max`, of voxels twice, four times … as large that hold any
/// of them.
pub(crate) fn map_points(
    resolution: Resolution,
    occupied: impl IntoIterator<Item = (Voxel, Option<RobotId>)>,
    voxels_max: usize,
) -> Vec<ColouredPoint> {
    let mut voxels: Vec<(Voxel, Option<RobotId>)> = occupied.into_iter().collect();
    let mut halvings = 0u32;
    loop {
        voxels.sort_unstable();
        voxels.dedup_by_key(|(voxel, _)| *voxel);
        if voxels.len() <= voxels_max || halvings >= 24 {
            break;
        }
        halvings += 1;
        for (v, _) in &mut voxels {
            *v = Voxel::new(v.x >> 1, v.y >> 1, v.z >> 1);
        }
    }
    let side = resolution.metres() * f64::from(1u32 << halvings);
    let points = voxels.into_iter().take(voxels_max).map(|(v, robot)| {
        let point = [v.x, v.y, v.z].map(|i| ((f64::from(i) + 0.5) * side) as f32);
        (point, robot.map_or_else(|| colour(point[2]), |robot| shade(robot, point[2])))
    });
    points.collect()
}

/// The colour of a robot.
pub(crate) fn robot_colour(robot: RobotId) -> [u8; 3] {
    ROBOTS[usize::from(robot.0) % ROBOTS.len()]
}

/// That colour, from dark to bright and back with the height.
fn shade(robot: RobotId, z: f32) -> [u8; 3] {
    let turn = z.abs() / RAMP_M % 2.0;
    let share = if turn <= 1.0 { turn } else { 2.0 - turn };
    robot_colour(robot).map(|part| (f32::from(part) * (0.4 + 0.6 * share)) as u8)
}

/// The colour of a height: up the ramp and down again.
fn colour(z: f32) -> [u8; 3] {
    let steps = (RAMP.len() - 1) as f32;
    let turn = z.abs() / RAMP_M % 2.0;
    let at = (if turn <= 1.0 { turn } else { 2.0 - turn }) * steps;
    let low = (at as usize).min(RAMP.len() - 2);
    let share = at - low as f32;
    let [a, b] = [RAMP[low], RAMP[low + 1]].map(|colour| colour.map(f32::from));
    core::array::from_fn(|i| (a[i] + (b[i] - a[i]) * share) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_large_map_is_shown_in_larger_voxels_that_cover_it() {
        let resolution = Resolution::from_metres(0.1).unwrap();
        let cube = || (0..20i32.pow(3)).map(|i| Voxel::new(i % 20 - 7, i / 20 % 20, i / 400));
        let map_points =
            |of: &mut dyn Iterator<Item = Voxel>, most| map_points(resolution, of.map(|v| (v, None)), most);
        assert_eq!(map_points(&mut cube(), 8_000).len(), 8_000);
        let points = map_points(&mut cube().chain(cube()), 1_999);
        assert!(points.len() <= 1_999 && points.len() > 200, "{}", points.len());
        for v in cube() {
            let centre = resolution.centre(v);
            let near = points
                .iter()
                .any(|(p, _)| p.iter().zip(centre).all(|(p, c)| (f64::from(*p) - c).abs() <= 0.21));
            assert!(near, "{v:?} is not shown");
        }
        assert_eq!(map_points(&mut [Voxel::new(0, -1, 2)].into_iter(), 1)[0].0, [0.05, -0.05, 0.25]);
    }

    #[test]
    fn a_long_path_stays_bounded_and_ends_where_the_robot_is() {
        let mut travelled = Travelled::default();
        for i in 0..100_000 {
            travelled.push([f64::from(i) * 0.07, 0.0, 1.0]);
        }
        let points = travelled.points();
        assert!(points.len() > PATH_POINTS_MAX / 2 && points.len() <= PATH_POINTS_MAX + 1);
        assert_eq!(points[0].0, [0.0, 0.0, 1.0]);
        assert_eq!(points.last().unwrap().0[0], (99_999.0 * 0.07) as f32);
        assert!(points.windows(2).all(|w| w[0].0[0] < w[1].0[0]));
    }

    #[test]
    fn pictures_come_every_two_seconds_and_never_outweigh_the_scans() {
        let mut schedule = ViewSchedule::default();
        assert!(schedule.is_due(Stamp(0)));
        schedule.view_written(Stamp(0), 1_000);
        schedule.scan_written(900);
        assert!(!schedule.is_due(Stamp(5_000_000)));
        schedule.scan_written(900);
        assert!(schedule.is_due(Stamp(2_000_000)) && !schedule.is_due(Stamp(1_900_000)));
    }

    #[test]
    fn colours_follow_the_height_up_and_down_again() {
        assert_eq!(colour(0.0), RAMP[0]);
        assert_eq!(colour(5.0), RAMP[4]);
        assert_eq!(colour(2.5), RAMP[2]);
        assert_eq!(colour(10.0), RAMP[0]);
        assert_eq!(colour(-5.0), RAMP[4]);
        assert_eq!(colour(f32::INFINITY), colour(f32::INFINITY));
    }
}
