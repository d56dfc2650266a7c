//! MARSIM's polar depth image: surface points painted into an image of ranges.
//!
//! The image has 0.2° a pixel, rows along the elevation and columns along the azimuth of the sensor. Each
//! point of the surface stands for a ball of radius c = 0.55 · √3 · spacing and covers a square patch of
//! pixels ⌈asin(c / range) / 0.2°⌉ to each side. In each pixel of its patch it offers
//! - its own range ("inflated"), of which the nearest counts, unless the ray meets its tangent plane out of
//!   range, and
//! - the range at which the ray of the pixel meets its tangent plane, if that is within 0.866 · spacing of
//!   the point; the nearest counts, and beats the inflated range.
//!
//! A plane must not be seen through what stands in front of it, though. MARSIM asks whether the point is
//! visible; here each pixel is judged by itself: the plane wins if the inflated range is one that the same
//! surface, seen at the same angle, would give, and otherwise the inflated range stays.
//!
//! Only pixels that a beam points to are painted, 4 % of the image for a Mid-360, and from near to far, so that
//! what is hidden need not be. The result is the same.

mod nearby;

use crate::cells::Bits;
use crate::world::{Surface, SurfacePoint};
use core::f32::consts::{FRAC_PI_2, PI};
use core::ops::Range;
use flockmap_grid::Pose;
use libm::{cos, sin};
use nearby::{Nearby, WIDTH, WORDS};

/// Degrees of a pixel.
const PIXEL_DEG: f64 = 0.2;

/// Radians of a pixel.
const PIXEL_RAD: f32 = PI / 900.0;

/// Distances in metres at which it is seen which pixels nothing further away can change.
const SHELLS_M: [f32; 6] = [2.0, 3.5, 6.0, 9.0, 14.0, 21.0];

/// A plane shows through what is nearer than it by less than this share of its range, at most.
const THROUGH: f32 = 0.4;

/// Nearest that a point is taken to be, in metres, so that no patch is wider than half of the sky.
const NEAR_M: f32 = 0.05;

/// What the image has in one pixel.
pub(super) struct Pixel {
    /// Unit vector to its centre, in the frame of the sensor.
    pub(super) direction: [f64; 3],
    /// Metres to the surface; `None` if there is nothing.
    pub(super) range_m: Option<f64>,
}

/// The image, as far as beams point into it. About 1 MB, 40 bytes a beam, and 16 bytes a patch of the surface in
/// range.
#[derive(Clone, Debug, Default)]
pub(super) struct PolarImage {
    /// Elevation of the lowest row, in degrees.
    lowest_deg: f64,
    /// Cosine and sine of the elevation of each row.
    rows: Vec<[f64; 2]>,
    /// Cosine and sine of the azimuth of each column.
    columns: Vec<[f64; 2]>,
    /// For each row and 64 columns, which pixels a beam points to …
    wanted: Vec<u64>,
    /// … and how many there are before these.
    before: Vec<u32>,
    /// The pixel of each beam.
    pixel_of_beam: Vec<u32>,
    /// Lowest and highest row and column that is wanted.
    window: [i32; 4],
    slots: Slots,
    /// Wanted pixels that can still change, and where there are any.
    open: Vec<u64>,
    nearby: Nearby,
    /// Patches of the surface by shell: which, and where from the sensor, along the axes of the map.
    shells: [Vec<(u32, [f32; 3])>; SHELLS_M.len() + 1],
}

/// What is known of each wanted pixel, in the order of pixels. A list for each number, so that a row of a
/// patch is painted with vector instructions.
#[derive(Clone, Debug, Default)]
struct Slots {
    direction: [Vec<f32>; 3],
    /// Range of the nearest point that covers the pixel.
    inflated: Vec<f32>,
    /// Range of the nearest tangent plane …
    plane: Vec<f32>,
    /// … the sine of the angle at which the ray meets it …
    grazing: Vec<f32>,
    /// … and half of the angle that the patch of its point covers, in radians.
    half_angle: Vec<f32>,
    /// The first beam that points there.
    beam: Vec<u32>,
}

impl PolarImage {
    /// An image for beams between these elevations in degrees, all around.
    pub(super) fn new([lowest_deg, highest_deg]: [f64; 2]) -> Self {
        let turn = |deg: f64| [cos(deg.to_radians()), sin(deg.to_radians())];
        // Rounded, since 0.2 has no exact number.
        let height = ((highest_deg - lowest_deg) / PIXEL_DEG + 0.5) as usize + 1;
        Self {
            lowest_deg,
            rows: (0..height).map(|v| turn(lowest_deg + v as f64 * PIXEL_DEG)).collect(),
            columns: (0..WIDTH).map(|u| turn(u as f64 * PIXEL_DEG - 180.0)).collect(),
            wanted: vec![0; height * WORDS],
            before: vec![0; height * WORDS],
            ..Self::default()
        }
    }

    /// Clears the image and finds the pixels of these beams.
    pub(super) fn aim(&mut self, beams: &[[f64; 3]]) {
        self.wanted.fill(0);
        self.pixel_of_beam.clear();
        self.window = [i32::MAX, i32::MIN, i32::MAX, i32::MIN];
        let lowest = self.lowest();
        for beam in beams {
            let [x, y, z] = beam.map(|v| v as f32);
            let (u, v) = pixel_at(x, y, z, (x * x + y * y).sqrt(), lowest);
            let (u, v) = (u.rem_euclid(WIDTH as i32), v.clamp(0, self.rows.len() as i32 - 1));
            let [v_low, v_high, u_low, u_high] = self.window;
            self.window = [v_low.min(v), v_high.max(v), u_low.min(u), u_high.max(u)];
            let (u, v) = (u as usize, v as usize);
            self.wanted[v * WORDS + u / 64] |= 1 << (u % 64);
            self.pixel_of_beam.push((v * WIDTH + u) as u32);
        }
        let mut directions = Vec::with_capacity(beams.len());
        for (at, &word) in self.wanted.iter().enumerate() {
            self.before[at] = directions.len() as u32;
            let ([flat, up], first) = (self.rows[at / WORDS], at % WORDS * 64);
            for bit in Bits(word) {
                let [forward, side] = self.columns[first + bit as usize];
                directions.push([flat * forward, flat * side, up].map(|v| v as f32));
            }
        }
        self.slots = Slots::new(&directions);
        for (number, &pixel) in self.pixel_of_beam.iter().enumerate() {
            let (v, u) = (pixel as usize / WIDTH, pixel as usize % WIDTH);
            let slot = self.rank(v, u);
            self.slots.beam[slot] = self.slots.beam[slot].min(number as u32);
        }
    }

    /// Paints the surface as seen from `pose`, for returns up to `range_m`.
    pub(super) fn paint(&mut self, surface: &Surface, pose: &Pose, range_m: f64) {
        self.paint_all(surface, pose, range_m, true);
    }

    /// `leaves_out`: whether points are left out of which it is known that they change nothing.
    fn paint_all(&mut self, surface: &Surface, pose: &Pose, range_m: f64, leaves_out: bool) {
        let (rows, sensor) = (pose.rotation_rows().map(|row| row.map(|v| v as f32)), pose.translation());
        let spacing = surface.spacing_m as f32;
        let brush = Brush {
            rows,
            lowest: self.lowest(),
            spacing,
            patch_reach: surface.patch_reach_m() as f32,
            cover: 0.55 * 3f32.sqrt() * spacing,
            plane_reach_squared: 0.75 * spacing * spacing,
            range_max: range_m as f32,
        };
        self.sort(surface, sensor, &brush);
        self.open.clone_from(&self.wanted);
        let shells = core::mem::take(&mut self.shells);
        for (number, shell) in shells.iter().enumerate().filter(|(_, shell)| !shell.is_empty()) {
            let from = number.checked_sub(1).and_then(|last| SHELLS_M.get(last));
            if let Some(from) = from.filter(|_| leaves_out) {
                self.close(*from, spacing);
            }
            self.nearby.take(&self.open);
            for &(patch, centre) in shell {
                if !leaves_out || self.may_see(&brush, centre) {
                    for point in surface.points(&surface.patches[patch as usize]) {
                        self.paint_point(&brush, centre, point);
                    }
                }
            }
        }
        self.shells = shells;
    }

    /// Sorts the patches in range into shells by their nearest point.
    fn sort(&mut self, surface: &Surface, sensor: [f64; 3], brush: &Brush) {
        self.shells.iter_mut().for_each(Vec::clear);
        let reach = brush.range_max + brush.spacing + brush.patch_reach;
        for (number, patch) in surface.patches.iter().enumerate() {
            let centre = patch.centre_from(sensor);
            let square = dot(centre, centre);
            if square <= reach * reach && patch.faces(centre, brush.spacing) {
                let nearest = square.sqrt() - brush.patch_reach;
                let shell = SHELLS_M.iter().filter(|from| nearest >= **from).count();
                self.shells[shell].push((number as u32, centre));
            }
        }
    }

    /// Closes the pixels that no point at `from` metres or beyond can change.
    fn close(&mut self, from: f32, spacing: f32) {
        // Planes are met up to 0.866 spacings before their point.
        let from = from - spacing;
        let mut slot = 0;
        for (open, &wanted) in self.open.iter_mut().zip(&self.wanted) {
            for bit in Bits(wanted) {
                let (inflated, plane) = (self.slots.inflated[slot], self.slots.plane[slot]);
                // Further planes do not count if there is a nearer one, or if none of them would show through
                // (see `range`; the angle of a patch at range r is at most 1.13 spacings / r and 1.5 pixels).
                let through = from * (1.0 - THROUGH - 2.25 * PIXEL_RAD) - 1.7 * spacing;
                let is_settled = inflated < from && (plane < from || inflated < through);
                if is_settled {
                    *open &= !(1 << bit);
                }
                slot += 1;
            }
        }
    }

    /// Whether anything of a patch with this centre can fall on an open pixel.
    #[inline]
    fn may_see(&self, brush: &Brush, centre: [f32; 3]) -> bool {
        let [x, y, z] = brush.to_sensor(centre);
        let flat = (x * x + y * y).sqrt();
        let range = (flat * flat + z * z).sqrt();
        if flat < 2.0 * brush.patch_reach {
            return true;
        }
        let (u, v) = pixel_at(x, y, z, flat, brush.lowest);
        // The patch is widest in azimuth, where a turn is the shorter the higher it is; its points cover more.
        let half =
            half_width(brush.patch_reach / flat) + half_width(brush.cover / (range - brush.patch_reach));
        self.nearby.any(v, u, half + 1)
    }

    /// `centre` is where offsets of points are counted from, as seen from the sensor, along the axes of the
    /// map.
    #[inline]
    fn paint_point(&mut self, brush: &Brush, centre: [f32; 3], point: &SurfacePoint) {
        let place: [f32; 3] = core::array::from_fn(|a| centre[a] + point.offset[a]);
        if !point.faces(place, brush.spacing) {
            return;
        }
        let square = dot(place, place);
        // A plane can be met in range whose point is not.
        let reach = brush.range_max + brush.spacing;
        if square > reach * reach {
            return;
        }
        let [x, y, z] = brush.to_sensor(place);
        let flat = (x * x + y * y).sqrt();
        let (u, v) = pixel_at(x, y, z, flat, brush.lowest);
        let range = square.sqrt();
        let half = half_width(brush.cover / range.max(NEAR_M));
        if !self.nearby.any(v, u, half) {
            return;
        }
        let [v_low, v_high, u_low, u_high] = self.window;
        let (top, bottom) = ((v + half).min(v_high), (v - half).max(v_low));
        if top < bottom {
            return;
        }
        let plane = Plane {
            place: [x, y, z],
            normal: brush.to_sensor(point.normal),
            offset: dot(place, point.normal),
            range,
            square,
            half_angle: (half as f32 + 0.5) * PIXEL_RAD,
        };
        // The patch, and its part that comes in at the other side of the image.
        let width = WIDTH as i32;
        for shift in [0, -width, width] {
            let (left, right) = ((u - half + shift).max(u_low), (u + half + shift).min(u_high));
            if left > right {
                continue;
            }
            let (left, right) = (left as usize, right as usize);
            for row in bottom as usize..=top as usize {
                if self.any_open(row, left, right) {
                    let (first, last) = (self.rank(row, left), self.rank(row, right + 1));
                    self.slots.paint(first..last, brush, &plane);
                }
            }
        }
    }

    /// Every wanted pixel with the first beam that points there, in the order of beams.
    pub(super) fn pixels(&self) -> impl Iterator<Item = (usize, Pixel)> + '_ {
        self.pixel_of_beam.iter().enumerate().filter_map(|(number, &pixel)| {
            let (v, u) = (pixel as usize / WIDTH, pixel as usize % WIDTH);
            let slot = self.rank(v, u);
            let ([flat, up], [forward, side]) = (self.rows[v], self.columns[u]);
            let direction = [flat * forward, flat * side, up];
            (self.slots.beam[slot] == number as u32)
                .then(|| (number, Pixel { direction, range_m: self.slots.range(slot) }))
        })
    }

    fn lowest(&self) -> f32 {
        (self.lowest_deg / PIXEL_DEG) as f32
    }

    /// Whether a row has open pixels from `left` to `right`.
    #[inline]
    fn any_open(&self, row: usize, left: usize, right: usize) -> bool {
        let (first, last) = (row * WORDS + left / 64, row * WORDS + right / 64);
        let (from, to) = (u64::MAX << (left % 64), u64::MAX >> (63 - right % 64));
        if first == last {
            return self.open[first] & from & to != 0;
        }
        self.open[first] & from != 0
            || self.open[last] & to != 0
            || self.open[first + 1..last].iter().any(|word| *word != 0)
    }

    /// Number of wanted pixels before this one.
    #[inline]
    fn rank(&self, row: usize, column: usize) -> usize {
        let at = row * WORDS + column / 64;
        let below = self.wanted[at] & ((1u64 << (column % 64)) - 1);
        (self.before[at] + below.count_ones()) as usize
    }
}

impl Slots {
    /// Nothing is seen yet in any of these directions.
    fn new(directions: &[[f32; 3]]) -> Self {
        let count = directions.len();
        Self {
            direction: [0, 1, 2].map(|a| directions.iter().map(|direction| direction[a]).collect()),
            inflated: vec![f32::INFINITY; count],
            plane: vec![f32::INFINITY; count],
            grazing: vec![1.0; count],
            half_angle: vec![0.0; count],
            beam: vec![u32::MAX; count],
        }
    }

    /// Offers a point to some slots.
    #[inline]
    fn paint(&mut self, slots: Range<usize>, brush: &Brush, point: &Plane) {
        let [xs, ys, zs] = [0, 1, 2].map(|a| &self.direction[a][slots.clone()]);
        let inflated = &mut self.inflated[slots.clone()];
        let plane = &mut self.plane[slots.clone()];
        let grazing = &mut self.grazing[slots.clone()];
        let half_angle = &mut self.half_angle[slots.clone()];
        let count = slots.len();
        // Of one length, so that the compiler needs no checks inside.
        if [xs.len(), ys.len(), zs.len(), inflated.len(), plane.len(), grazing.len(), half_angle.len()]
            != [count; 7]
        {
            return;
        }
        for i in 0..count {
            let ray = [xs[i], ys[i], zs[i]];
            let slope = dot(ray, point.normal);
            let range = point.offset / slope;
            let gap = range * (range - 2.0 * dot(ray, point.place)) + point.square;
            // False where there is no plane or the ray is parallel to it: then the range is no number.
            let nearer = (range > 0.0) & (gap <= brush.plane_reach_squared) & (range < plane[i]);
            // A ray that meets the plane out of range passes over the last points of a floor.
            let leaves = range > brush.range_max;
            let covers = !leaves & (point.range < inflated[i]);
            inflated[i] = if covers { point.range } else { inflated[i] };
            plane[i] = if nearer { range } else { plane[i] };
            grazing[i] = if nearer { slope.abs() } else { grazing[i] };
            half_angle[i] = if nearer { point.half_angle } else { half_angle[i] };
        }
    }

    fn range(&self, slot: usize) -> Option<f64> {
        let (inflated, plane) = (self.inflated[slot], self.plane[slot]);
        if plane < f32::INFINITY {
            // The nearest place of the same plane whose patch reaches this pixel: further down the slope by
            // the angle of a patch, and nearer by another half for points that lie off the plane.
            let (g, angle) = (self.grazing[slot].min(1.0), 1.5 * self.half_angle[slot]);
            let slope = g / (g + angle * (1.0 - g * g).sqrt());
            if inflated >= plane * (slope.max(1.0 - THROUGH) - angle) {
                return Some(f64::from(plane));
            }
        }
        (inflated < f32::INFINITY).then(|| f64::from(inflated))
    }
}

/// What is the same for every point of an image.
struct Brush {
    rows: [[f32; 3]; 3],
    lowest: f32,
    spacing: f32,
    patch_reach: f32,
    cover: f32,
    plane_reach_squared: f32,
    range_max: f32,
}

impl Brush {
    /// A vector along the axes of the map as seen from the sensor.
    #[inline]
    fn to_sensor(&self, v: [f32; 3]) -> [f32; 3] {
        core::array::from_fn(|a| self.rows[0][a] * v[0] + self.rows[1][a] * v[1] + self.rows[2][a] * v[2])
    }
}

/// A point of the surface in the frame of the sensor, and its tangent plane.
struct Plane {
    place: [f32; 3],
    /// All zero if it has none.
    normal: [f32; 3],
    /// Distance of the plane from the sensor along the normal.
    offset: f32,
    /// Metres to the point, and its square.
    range: f32,
    square: f32,
    half_angle: f32,
}

#[inline]
fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Column and row of the pixel in this direction. The column may be one too high.
#[inline]
fn pixel_at(x: f32, y: f32, z: f32, flat: f32, lowest: f32) -> (i32, i32) {
    let u = arc(y, x) / PIXEL_RAD + 900.0;
    let v = arc(z, flat) / PIXEL_RAD - lowest;
    // Rounded by cutting off, which is fast; the offset keeps it positive.
    ((u + 0.5) as i32, (v + 1_024.5) as i32 - 1_024)
}

/// Pixels from the middle of a patch to its side, for this ratio of cover to range.
#[inline]
fn half_width(ratio: f32) -> i32 {
    let s = ratio.min(1.0);
    // asin; its series does below 0.5, where patches are 30° wide.
    let angle = if s < 0.5 {
        let q = s * s;
        s * (1.0 + q * (0.166_666_67 + q * (0.075 + q * (0.044_642_86 + q * 0.030_381_94))))
    } else {
        arc(s, (1.0 - s * s).sqrt())
    };
    (angle / PIXEL_RAD) as i32 + 1
}

/// The angle of a vector (atan2) in radians, within 10⁻⁵ (1/300 of a pixel) and the same on every machine; 0
/// for no vector.
#[inline]
fn arc(y: f32, x: f32) -> f32 {
    let (ax, ay) = (x.abs(), y.abs());
    let (low, high) = if ax < ay { (ax, ay) } else { (ay, ax) };
    let a = low / high.max(1e-30);
    let s = a * a;
    let poly = 0.999_977_26
        + s * (-0.332_623_47
            + s * (0.193_543_46 + s * (-0.116_432_87 + s * (0.052_653_32 - s * 0.011_721_2))));
    let mut angle = a * poly;
    if ax < ay {
        angle = FRAC_PI_2 - angle;
    }
    if x < 0.0 {
        angle = PI - angle;
    }
    if y < 0.0 { -angle } else { angle }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Lidar, World};
    use flockmap_grid::Stamp;

    #[test]
    fn what_is_left_out_would_change_nothing() {
        for (world, place) in
            [(World::indoor(1), [-1.0, 1.2, 1.7]), (World::forest(1), [0.375, 0.025, 2.325])]
        {
            for lidar in [Lidar::Mid360, Lidar::Os128] {
                let pose = Pose::new(place, [0.05, -0.03, 0.4, 1.0]).unwrap();
                let beams = lidar.directions(Stamp(700_000));
                let ranges = [true, false].map(|leaves_out| {
                    let mut image = PolarImage::new(lidar.field_of_view_deg().1);
                    image.aim(&beams);
                    image.paint_all(world.surface(), &pose, 30.0, leaves_out);
                    image.pixels().map(|(_, pixel)| pixel.range_m).collect::<Vec<_>>()
                });
                assert!(ranges[0].len() > 10_000);
                assert!(ranges[0] == ranges[1], "{lidar}");
            }
        }
    }

    #[test]
    fn angles_are_right_to_a_hundredth_of_a_pixel() {
        for step in 0..3_600 {
            let angle = (f64::from(step) * 0.1 - 179.95).to_radians();
            let (x, y) = (3.7 * angle.cos(), 3.7 * angle.sin());
            assert!((f64::from(arc(y as f32, x as f32)) - angle).abs() < 0.01 * f64::from(PIXEL_RAD));
        }
        assert_eq!(arc(0.0, 0.0), 0.0);
        for step in 1..1_000 {
            let ratio = f64::from(step) / 1_000.0;
            let exact = ratio.asin() / f64::from(PIXEL_RAD);
            assert!((f64::from(half_width(ratio as f32)) - exact.ceil()).abs() <= 1.0, "{ratio}");
        }
    }
}
