//! Maps in three dimensions as pictures, without a graphics card: for reports and for who has no browser.

mod camera;
mod canvas;

use anyhow::{Result, ensure};
use flockmap::grid::Resolution;
use flockmap::{MapView, State, Voxel};

use crate::robot_record::occupied;

pub use camera::Camera;
pub use canvas::{Canvas, Face};

/// Most pixels of a picture along an edge. While it is made a pixel takes up to 100 bytes: 1.7 GB.
pub const PICTURE_SIDE_MAX: usize = 4_096;

/// Each pixel is made of so many by so many.
const OVERSAMPLING: usize = 2;
/// Free around the map, as a part of the picture.
const MARGIN: f64 = 0.04;
/// How bright faces are that look along x, y and up.
const LIGHT: [f64; 3] = [0.62, 0.78, 1.0];
/// How much darker a face is for each of the eight neighbours of the voxel before it that is there too.
const SHADE: f64 = 0.07;

/// How a map is drawn.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Style {
    /// Pixels across and down, 16 to [`PICTURE_SIDE_MAX`].
    pub size: [usize; 2],
    /// From where.
    pub camera: Camera,
    /// Only what is between these heights, in metres: to look into a building.
    pub heights_m: [f64; 2],
    /// On black in place of white.
    pub is_dark: bool,
}

/// Red, green, blue, row by row from the top.
#[derive(Clone, PartialEq, Debug)]
pub struct Picture {
    /// Pixels across and down.
    pub size: [usize; 2],
    /// The pixels.
    pub pixels: Vec<[u8; 3]>,
    /// Occupied voxels in it, hidden ones too.
    pub voxels: usize,
    /// How long a pixel is, in metres.
    pub metres_per_pixel: f64,
}

/// Draws the occupied voxels of a map as lit cubes, coloured by height. O(occupied voxels, and pixels that their faces
/// cover).
///
/// # Errors
/// A size out of its range; no occupied voxel between the heights.
pub fn render(view: &MapView, style: &Style) -> Result<Picture> {
    let [width, height] = style.size;
    ensure!(
        style.size.iter().all(|side| (16..=PICTURE_SIDE_MAX).contains(side)),
        "a picture of {width} × {height} pixels, expected 16 to {PICTURE_SIDE_MAX} along each edge"
    );
    let scene = Scene::of(view, style)?;
    let mut canvas = Canvas::new(width * OVERSAMPLING, height * OVERSAMPLING);
    for voxel in &scene.voxels {
        scene.draw(*voxel, &mut canvas);
    }
    let background = if style.is_dark { [17, 20, 26] } else { [255, 255, 255] };
    let fine: Vec<[u8; 3]> = canvas.pixels().map(|colour| colour.unwrap_or(background)).collect();
    let pixels = (0..width * height).map(|at| averaged(&fine, width, [at % width, at / width])).collect();
    let metres_per_pixel = OVERSAMPLING as f64 / scene.scale * view.resolution().metres();
    Ok(Picture { size: style.size, pixels, voxels: scene.voxels.len(), metres_per_pixel })
}

/// What is drawn, and how it lies on the canvas.
struct Scene<'a> {
    view: &'a MapView,
    camera: Camera,
    voxels: Vec<Voxel>,
    /// Pixels of the canvas for a voxel's side.
    scale: f64,
    /// What is in the middle of the canvas: to the right and up, in voxels.
    middle: [f64; 2],
    canvas: [f64; 2],
    /// Lowest and highest of the colours, in voxels.
    heights: [f64; 2],
    /// Only what is between these is there, in voxels.
    cut: [i32; 2],
}

impl<'a> Scene<'a> {
    fn of(view: &'a MapView, style: &Style) -> Result<Self> {
        let [low, high] = style.heights_m;
        let cut = [layer(view.resolution(), low), layer(view.resolution(), high)];
        let is_within = |voxel: &Voxel| (cut[0]..=cut[1]).contains(&voxel.z);
        let voxels: Vec<Voxel> = occupied(view.blocks()).filter(is_within).collect();
        ensure!(!voxels.is_empty(), "nothing to draw: no voxel between {low} and {high} m is occupied");
        // Each corner of each cube must be in the picture.
        let (mut least, mut most) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for voxel in &voxels {
            let centre = [voxel.x, voxel.y, voxel.z].map(|v| f64::from(v) + 0.5);
            let [x, y, _] = style.camera.project(centre);
            for (axis, at) in [x, y].into_iter().enumerate() {
                // Half a diagonal.
                least[axis] = least[axis].min(at - 0.87);
                most[axis] = most[axis].max(at + 0.87);
            }
        }
        let canvas = style.size.map(|side| (side * OVERSAMPLING) as f64);
        let room = |axis: usize| canvas[axis] * (1.0 - 2.0 * MARGIN) / (most[axis] - least[axis]);
        // What hangs alone far above or below takes no colours from the rest.
        let mut heights: Vec<i32> = voxels.iter().map(|voxel| voxel.z).collect();
        heights.sort_unstable();
        let share = |of: usize| f64::from(heights[(heights.len() - 1) * of / 100]);
        Ok(Self {
            view,
            camera: style.camera,
            scale: room(0).min(room(1)),
            middle: [0, 1].map(|axis| (least[axis] + most[axis]) / 2.0),
            canvas,
            heights: [share(2), share(98)],
            cut,
            voxels,
        })
    }

    /// Draws the faces of a voxel that are seen.
    fn draw(&self, voxel: Voxel, canvas: &mut Canvas<[u8; 3]>) {
        let at = [voxel.x, voxel.y, voxel.z];
        for (axis, side) in self.camera.seen_faces().into_iter().enumerate() {
            let Some(side) = side else { continue };
            let mut before = at;
            before[axis] += side;
            if self.is_there(before) {
                continue;
            }
            let mut corner = at.map(f64::from);
            corner[axis] += f64::from(side.max(0));
            let others = [(axis + 1) % 3, (axis + 2) % 3];
            let edge = |along: usize| {
                let mut edge = [0.0; 3];
                edge[along] = 1.0;
                let [right, up, near] = self.camera.project(edge);
                [right * self.scale, -up * self.scale, near]
            };
            let [right, up, near] = self.camera.project(corner);
            let corner = [
                (right - self.middle[0]) * self.scale + self.canvas[0] / 2.0,
                (self.middle[1] - up) * self.scale + self.canvas[1] / 2.0,
                near,
            ];
            let bright = LIGHT[axis] * (1.0 - SHADE * f64::from(self.neighbours(before, others)));
            canvas.draw(&Face { corner, edges: others.map(edge) }, self.colour(voxel.z, bright));
        }
    }

    /// How many of the eight around a place are there, in the plane of these axes.
    fn neighbours(&self, place: [i32; 3], axes: [usize; 2]) -> u32 {
        let around = (0..9).filter(|step| *step != 4).filter(|step| {
            let mut at = place;
            at[axes[0]] += step % 3 - 1;
            at[axes[1]] += step / 3 - 1;
            self.is_there(at)
        });
        around.count() as u32
    }

    fn is_there(&self, [x, y, z]: [i32; 3]) -> bool {
        (self.cut[0]..=self.cut[1]).contains(&z) && self.view.state(Voxel::new(x, y, z)) == State::Occupied
    }

    fn colour(&self, z: i32, bright: f64) -> [u8; 3] {
        let [low, high] = self.heights;
        let share = ((f64::from(z) - low) / (high - low).max(1.0)).clamp(0.0, 1.0);
        let at = share * (COLOURS.len() - 1) as f64;
        let below = (at as usize).min(COLOURS.len() - 2);
        let mix = |channel: usize| {
            let [a, b] = [COLOURS[below], COLOURS[below + 1]].map(|colour| f64::from(colour[channel]));
            ((a + (b - a) * (at - below as f64)) * bright) as u8
        };
        [mix(0), mix(1), mix(2)]
    }
}

/// From low to high: blue, green, yellow, orange, which people with any eyes tell apart by brightness too.
const COLOURS: [[u8; 3]; 5] = [[58, 84, 160], [48, 138, 165], [74, 180, 128], [190, 208, 84], [248, 178, 84]];

/// The layer of voxels that has this height; what is beyond all voxels is the last layer.
fn layer(resolution: Resolution, height_m: f64) -> i32 {
    let limit = f64::from(flockmap::grid::VOXEL_LIMIT);
    (height_m / resolution.metres()).floor().clamp(-limit, limit) as i32
}

fn averaged(fine: &[[u8; 3]], width: usize, [x, y]: [usize; 2]) -> [u8; 3] {
    let mut sum = [0u32; 3];
    for (dy, dx) in (0..OVERSAMPLING * OVERSAMPLING).map(|at| (at / OVERSAMPLING, at % OVERSAMPLING)) {
        let pixel = fine[(y * OVERSAMPLING + dy) * width * OVERSAMPLING + x * OVERSAMPLING + dx];
        sum = core::array::from_fn(|channel| sum[channel] + u32::from(pixel[channel]));
    }
    sum.map(|sum| (sum / (OVERSAMPLING * OVERSAMPLING) as u32) as u8)
}

#[cfg(test)]
mod tests;
