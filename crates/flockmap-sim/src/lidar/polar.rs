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
//! Only pixels that a beam points to are painted, 4 % of the image for a Mid-360. The result is the same.

use crate::world::{Surface, SurfacePoint};
use core::f32::consts::{FRAC_PI_2, PI};
use flockmap_grid::Pose;
use libm::{cos, sin};

/// Pixels in a full turn.
const WIDTH: usize = 1_800;

/// Degrees of a pixel.
const PIXEL_DEG: f64 = 0.2;

/// Radians of a pixel.
const PIXEL_RAD: f32 = PI / 900.0;

/// Bit words in a row.
const WORDS: usize = WIDTH.div_ceil(64);

/// Nearest that a point is taken to be, in metres, so that no patch is wider than half of the sky.
const NEAR_M: f32 = 0.05;

/// What the image has in one pixel.
pub(super) struct Pixel {
    /// Unit vector to its centre, in the frame of the sensor.
    pub(super) direction: [f64; 3],
    /// Metres to the surface; `None` if there is nothing.
    pub(super) range_m: Option<f64>,
}

/// The image, as far as beams point into it. About 100 KB and 40 bytes a beam.
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
        let mut count = 0;
        self.slots.clear();
        for (at, &word) in self.wanted.iter().enumerate() {
            self.before[at] = count;
            count += word.count_ones();
            let ([flat, up], first) = (self.rows[at / WORDS], at % WORDS * 64);
            let mut left = word;
            while left != 0 {
                let [forward, side] = self.columns[first + left.trailing_zeros() as usize];
                self.slots.push([flat * forward, flat * side, up].map(|v| v as f32));
                left &= left - 1;
            }
        }
        for (number, &pixel) in self.pixel_of_beam.iter().enumerate() {
            let (v, u) = (pixel as usize / WIDTH, pixel as usize % WIDTH);
            let slot = self.rank(v, u);
            self.slots.beam[slot] = self.slots.beam[slot].min(number as u32);
        }
    }

    /// Paints the surface as seen from `pose`, for returns up to `range_m`.
    pub(super) fn paint(&mut self, surface: &Surface, pose: &Pose, range_m: f64) {
        let (rows, sensor) = (pose.rotation_rows().map(|row| row.map(|v| v as f32)), pose.translation());
        let spacing = surface.spacing_m() as f32;
        let brush = Brush {
            rows,
            lowest: self.lowest(),
            spacing,
            cover: 0.55 * 3f32.sqrt() * spacing,
            plane_reach_squared: 0.75 * spacing * spacing,
            range_max: range_m as f32,
        };
        for (corner, points) in surface.near(sensor, range_m + surface.spacing_m()) {
            let corner = core::array::from_fn(|a| (corner[a] - sensor[a]) as f32);
            for point in points {
                self.paint_point(&brush, corner, point);
            }
        }
    }

    /// `corner` is where offsets of points are counted from, as seen from the sensor, along the axes of the
    /// map.
    #[inline]
    fn paint_point(&mut self, brush: &Brush, corner: [f32; 3], point: &SurfacePoint) {
        let place: [f32; 3] = core::array::from_fn(|a| corner[a] + point.offset[a]);
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
            reach_squared: brush.plane_reach_squared,
            range_max: brush.range_max,
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
                let (first, last) = (self.rank(row, left), self.rank(row, right + 1));
                if first < last {
                    self.slots.paint(first, last, &plane);
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
            (self.slots.beam[slot] == number as u32).then(|| {
                (
                    number,
                    Pixel { direction: [flat * forward, flat * side, up], range_m: self.slots.range(slot) },
                )
            })
        })
    }

    fn lowest(&self) -> f32 {
        (self.lowest_deg / PIXEL_DEG) as f32
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
    fn clear(&mut self) {
        let [x, y, z] = &mut self.direction;
        for list in [x, y, z, &mut self.inflated, &mut self.plane, &mut self.grazing, &mut self.half_angle] {
            list.clear();
        }
        self.beam.clear();
    }

    fn push(&mut self, direction: [f32; 3]) {
        for (list, value) in self.direction.iter_mut().zip(direction) {
            list.push(value);
        }
        self.inflated.push(f32::INFINITY);
        self.plane.push(f32::INFINITY);
        self.grazing.push(1.0);
        self.half_angle.push(0.0);
        self.beam.push(u32::MAX);
    }

    /// Offers a point to the slots `first..last`.
    #[inline]
    fn paint(&mut self, first: usize, last: usize, point: &Plane) {
        let [xs, ys, zs] = &self.direction;
        let (xs, ys, zs) = (&xs[first..last], &ys[first..last], &zs[first..last]);
        let inflated = &mut self.inflated[first..last];
        let plane = &mut self.plane[first..last];
        let grazing = &mut self.grazing[first..last];
        let half_angle = &mut self.half_angle[first..last];
        let count = last - first;
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
            let nearer = (range > 0.0) & (gap <= point.reach_squared) & (range < plane[i]);
            // A ray that meets the plane out of range passes over the last points of a floor.
            let leaves = range > point.range_max;
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
            let nearest = plane * g / (g + angle * (1.0 - g * g).sqrt());
            let rough = plane * angle;
            if inflated >= nearest - rough {
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
    reach_squared: f32,
    range_max: f32,
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
    // Rounded by cutting off, which is the fast way; the offset keeps it positive.
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
