//! Maps seen from above, as pictures.

use std::borrow::Borrow;
use std::collections::{BTreeMap, HashMap};

use base64::Engine;
use flockmap::grid::{BLOCK_SIDE, BlockIndex, StateBlock, set_bits};
use flockmap::{MapView, Robot, Stamp, State};

/// A robot's fused map at one moment, and which part of it the robot has seen itself.
pub struct MapPicture {
    pub at: Stamp,
    view: MapView,
    /// For each block column, the columns (bit 8 y + x) in which the own sensor has seen something.
    own: HashMap<(i32, i32), u64>,
}

/// Obstacles are drawn from this height above the ground: lower ones are ground …
const HEIGHT_FROM_M: f64 = 0.4;
/// … to this one: what hangs above is no obstacle to a robot that flies below 2.5 m.
const HEIGHT_TO_M: f64 = 2.5;
/// A picture is at most this wide and high; a pixel is as many voxels as that needs.
const PIXELS_MAX: i32 = 900;
/// Shades of an obstacle by height.
const SHADES: usize = 6;

impl MapPicture {
    /// The robot's map as it is now.
    pub fn take(robot: &Robot, at: Stamp) -> Self {
        let mut own = HashMap::new();
        for (index, block) in robot.mapper().blocks() {
            let seen = block.known().iter().fold(0, |all, plane| all | plane);
            *own.entry((index.x, index.y)).or_default() |= seen;
        }
        Self { at, view: robot.view(), own }
    }

    /// Voxels that are free, and occupied.
    pub fn count(&self) -> (usize, usize) {
        self.view.count()
    }

    /// Columns, as voxel indices, that the picture would span: lowest and highest x, y.
    fn span(&self) -> Option<[i32; 4]> {
        let mut span: Option<[i32; 4]> = None;
        for (index, _) in self.view.blocks() {
            let (x, y) = (index.x * BLOCK_SIDE, index.y * BLOCK_SIDE);
            let s = span.get_or_insert([x, y, x, y]);
            *s = [s[0].min(x), s[1].min(y), s[2].max(x + BLOCK_SIDE - 1), s[3].max(y + BLOCK_SIDE - 1)];
        }
        span
    }
}

/// A picture as PNG, how large a pixel is, and where in the map's frame its lower left corner lies.
pub struct Picture {
    pub png: Vec<u8>,
    pub width: u32,
    pub height: u32,
    pub pixel_m: f64,
    pub corner_m: [f64; 2],
}

impl Picture {
    /// As the source of an `img`.
    pub fn data_url(&self) -> String {
        format!("data:image/png;base64,{}", base64::engine::general_purpose::STANDARD.encode(&self.png))
    }

    /// Where a place of the map lies, in pixels from the upper left corner.
    pub fn pixel_of(&self, place: [f64; 3]) -> [f64; 2] {
        let [x, y] = [0, 1].map(|axis| (place[axis] - self.corner_m[axis]) / self.pixel_m);
        [x, f64::from(self.height) - y]
    }
}

/// Draws snapshots of one robot, all over the same ground, which is that of the last one.
pub fn draw(snapshots: &[MapPicture]) -> anyhow::Result<Vec<Picture>> {
    let Some(canvas) = snapshots.last().and_then(Canvas::of) else { return Ok(Vec::new()) };
    snapshots.iter().map(|snapshot| canvas.draw(snapshot.view.blocks(), &snapshot.own)).collect()
}

/// Draws what a robot has seen itself over the ground of its fused map.
pub fn draw_own(robot: &Robot, fused: &MapPicture) -> anyhow::Result<Option<Picture>> {
    let draw = |canvas: Canvas| canvas.draw(robot.mapper().blocks(), &fused.own);
    Canvas::of(fused).map(draw).transpose()
}

/// Lowest occupied voxel of each block column.
fn ground(view: &MapView) -> HashMap<(i32, i32), i32> {
    let mut lowest = HashMap::new();
    for (index, block) in view.blocks() {
        if let Some(z) = (0..8).find(|z| block.occupied()[*z] != 0) {
            let z = index.z * BLOCK_SIDE + z as i32;
            let known: &mut i32 = lowest.entry((index.x, index.y)).or_insert(z);
            *known = z.min(*known);
        }
    }
    lowest
}

/// What a pixel shows, red, green and blue. Order of the palette: nothing, own free, received free, own
/// obstacles, received obstacles.
const PALETTE: [u32; 3 + 2 * SHADES] = [
    0x000000, 0xcfcbf2, 0xbfe6c2, 0x867adb, 0x7062cc, 0x5b4cba, 0x4839a3, 0x362886, 0x241866, 0x6dbb7a,
    0x54a666, 0x3e8f52, 0x2b7740, 0x1a5e2f, 0x0b441f,
];

/// What several pictures have in common.
struct Canvas {
    /// Side of a voxel in metres.
    side: f64,
    /// Lowest and highest columns: x, y, x, y.
    span: [i32; 4],
    ground: HashMap<(i32, i32), i32>,
}

impl Canvas {
    /// Of a map with anything in it.
    fn of(snapshot: &MapPicture) -> Option<Self> {
        let span = snapshot.span()?;
        Some(Self { side: snapshot.view.resolution().metres(), span, ground: ground(&snapshot.view) })
    }

    fn draw(
        &self,
        blocks: impl Iterator<Item = (BlockIndex, impl Borrow<StateBlock>)>,
        own_columns: &HashMap<(i32, i32), u64>,
    ) -> anyhow::Result<Picture> {
        let Self { side, span, ground } = self;
        let [columns, rows] = [span[2] - span[0] + 1, span[3] - span[1] + 1];
        let scale = ((columns.max(rows) + PIXELS_MAX - 1) / PIXELS_MAX).max(1);
        let (width, height) = ((columns + scale - 1) / scale, (rows + scale - 1) / scale);
        let mut pixels = vec![0u8; width as usize * height as usize];
        let (from, to) = ((HEIGHT_FROM_M / side).round() as i32, (HEIGHT_TO_M / side).round() as i32);

        // Highest obstacle in the band of heights above the ground, by column; −1: only free.
        let mut block_columns: BTreeMap<(i32, i32), [i32; 64]> = BTreeMap::new();
        for (index, block) in blocks {
            let near = (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| (index.x + dx, index.y + dy)));
            let ground = near.filter_map(|at| ground.get(&at)).min().copied();
            let column = block_columns.entry((index.x, index.y)).or_insert([-2; 64]);
            let block = block.borrow();
            for bit in set_bits(&block.known()) {
                let above = ground.map_or(from, |ground| index.voxel(bit).z - ground);
                let is_obstacle = block.get(bit) == State::Occupied && (from..=to).contains(&above);
                let height = &mut column[bit % 64];
                *height = (*height).max(if is_obstacle { above } else { -1 });
            }
        }
        for ((x, y), heights) in block_columns {
            let own = own_columns.get(&(x, y)).copied().unwrap_or(0);
            for (bit, above) in heights.into_iter().enumerate().filter(|(_, above)| *above >= -1) {
                let (column, row) =
                    (x * BLOCK_SIDE + bit as i32 % 8 - span[0], y * BLOCK_SIDE + bit as i32 / 8 - span[1]);
                if column < 0 || row < 0 || column >= columns || row >= rows {
                    continue;
                }
                let received = own >> bit & 1 == 0;
                let colour = if above < 0 {
                    1 + u8::from(received)
                } else {
                    let shade = (above - from) as usize * SHADES / ((to - from) as usize + 1);
                    (3 + shade.min(SHADES - 1) + if received { SHADES } else { 0 }) as u8
                };
                // North up: y grows upwards.
                let pixel = &mut pixels[((height - 1 - row / scale) * width + column / scale) as usize];
                // Where a pixel is several columns, an obstacle hides free space.
                if *pixel < 3 || colour >= 3 {
                    *pixel = colour;
                }
            }
        }
        let mut png = Vec::new();
        let mut encoder = png::Encoder::new(&mut png, width as u32, height as u32);
        encoder.set_color(png::ColorType::Indexed);
        encoder.set_depth(png::BitDepth::Eight);
        let colours = PALETTE.iter().flat_map(|colour| colour.to_be_bytes().into_iter().skip(1));
        encoder.set_palette(colours.collect::<Vec<_>>());
        encoder.set_trns(vec![0]);
        encoder.set_compression(png::Compression::High);
        encoder.write_header()?.write_image_data(&pixels)?;
        let corner_m = [f64::from(span[0]) * side, f64::from(span[1]) * side];
        Ok(Picture {
            png,
            width: width as u32,
            height: height as u32,
            pixel_m: side * f64::from(scale),
            corner_m,
        })
    }
}
