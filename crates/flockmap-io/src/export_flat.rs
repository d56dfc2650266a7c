//! Two-dimensional products of a map as files: occupancy for Nav2, heights, distances.

use std::path::{Path, PathBuf};

use flockmap_grid::{Resolution, VoxelBox};
use flockmap_plan::{HeightMap, OccupancyGrid};

use crate::error::WriteError;
use crate::file::ending;
use crate::image::{Pixels, upside_down, write_pgm, write_png};

/// Shades of Unknown, Free and Occupied cells, as `map_saver` writes them.
const SHADES: [u8; 3] = [205, 254, 0];

/// A cell of which so much is black is Occupied …
const OCCUPIED_THRESH: f64 = 0.65;
/// … and of which less than this is, Free: shade 205 is 0.1961 black. (The 0.25 that Nav2's `map_saver` writes by
/// default makes such a cell Free when it is read.)
const FREE_THRESH: f64 = 0.196;

/// A pixel of a height map stands for so many metres.
const HEIGHT_STEP_M: f64 = 0.001;

/// Colours from the least to the greatest value.
const COLOURS: [[u8; 3]; 5] = [[43, 60, 120], [38, 130, 142], [76, 184, 110], [206, 220, 70], [240, 120, 40]];

/// Where nothing is known, and where it is known that there is nothing.
const NO_COLOUR: [[u8; 3]; 2] = [[205, 205, 205], [246, 246, 246]];

/// The `.yaml` that belongs to the picture of an occupancy grid: the same path with that ending.
pub fn occupancy_yaml(picture: impl AsRef<Path>) -> PathBuf {
    picture.as_ref().with_extension("yaml")
}

/// Writes an occupancy grid for Nav2's `map_server`: a picture by the ending of the path, `.pgm` or `.png`, and beside
/// it a `.yaml` ([`occupancy_yaml`]) with `mode: trinary`, resolution, origin and thresholds. A pixel is a cell; the
/// lower left one lies at the origin. `map_server` makes of it the [`OccupancyGrid::to_ros`] that it was made of.
/// Memory: two bytes a cell.
pub fn export_occupancy(path: impl AsRef<Path>, grid: &OccupancyGrid) -> Result<(), WriteError> {
    let (path, [width, _]) = (path.as_ref(), grid.size());
    let grey = upside_down(&grid.to_bytes(SHADES), width);
    let heights = heights_of(grid.resolution(), grid.region());
    let note = format!("Flockmap, voxels of {} m from {heights} m", grid.resolution().metres());
    match ending(path).as_str() {
        "pgm" => write_pgm(path, grid.size(), &grey, &note)?,
        "png" => write_png(path, grid.size(), &Pixels::Grey(grey), &note)?,
        _ => return Err(WriteError::unfit(path, "a file with this ending", ".pgm or .png can be written")),
    }
    let name = path.file_name().map(|name| name.to_string_lossy()).unwrap_or_default();
    let [x, y] = grid.origin_m();
    let yaml = format!(
        "# {note}\nimage: {}\nmode: trinary\nresolution: {:?}\norigin: [{x:?}, {y:?}, 0.0]\nnegate: 0\n\
         occupied_thresh: {OCCUPIED_THRESH}\nfree_thresh: {FREE_THRESH}\n",
        quoted(&name),
        grid.resolution().metres(),
    );
    let yaml_path = occupancy_yaml(path);
    std::fs::write(&yaml_path, yaml).map_err(WriteError::io(&yaml_path))
}

/// Writes a height map as a grey `.png` of 16 bits. A pixel that is not 0 is a column with something Occupied: its
/// value is the height of the upper face of the highest voxel above the lower face of the box, in millimetres. The
/// `Description` in the file says so, and at which height 0 is.
///
/// # Errors
/// Beside those of writing: the box is higher than 65.535 m.
pub fn export_heights(path: impl AsRef<Path>, heights: &HeightMap) -> Result<(), WriteError> {
    let path = path.as_ref();
    must_be_png(path)?;
    let (side, [width, height]) = (heights.resolution().metres(), heights.size());
    let low = heights.region().min().z;
    let high_m = f64::from(heights.region().size()[2]) * side;
    if high_m > f64::from(u16::MAX) * HEIGHT_STEP_M {
        let why = "16 bits hold 65.535 m in millimetres: take a lower band";
        return Err(WriteError::unfit(path, format!("a height map of a band {high_m:.1} m high"), why));
    }
    let value = |z: i32| (f64::from(z - low + 1) * side / HEIGHT_STEP_M).round() as u16;
    let cells = (0..height).flat_map(|y| (0..width).map(move |x| heights.highest(x, y).map_or(0, value)));
    let pixels = Pixels::Deep(upside_down(&cells.collect::<Vec<_>>(), width));
    let note = format!(
        "Flockmap heights: {} m + value mm; 0: nothing there; voxels of {side} m, lower left corner {:?} m",
        f64::from(low) * side,
        [heights.region().min().x, heights.region().min().y].map(|v| f64::from(v) * side),
    );
    write_png(path, heights.size(), &pixels, &note)
}

/// How values become colours: from blue at `low` to orange at `high`.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Scale {
    /// The value of the first colour; lower ones have it too.
    pub low: f32,
    /// The value of the last colour; higher ones have it too.
    pub high: f32,
}

impl Scale {
    /// From the least to the greatest of some values; those that are not finite do not count. From 0 to 1 if there
    /// are none.
    pub fn of(values: &[f32]) -> Self {
        let finite = || values.iter().copied().filter(|value| value.is_finite());
        let ends = finite().reduce(f32::min).zip(finite().reduce(f32::max));
        let (low, high) = ends.unwrap_or((0.0, 1.0));
        Self { low, high }
    }

    fn colour(self, value: f32) -> [u8; 3] {
        let share = ((value - self.low) / (self.high - self.low)).clamp(0.0, 1.0);
        // All values the same: the first colour.
        let at = if share.is_nan() { 0.0 } else { share * (COLOURS.len() - 1) as f32 };
        let first = (at as usize).min(COLOURS.len() - 2);
        let part = at - first as f32;
        core::array::from_fn(|i| {
            let [from, to] = [COLOURS[first][i], COLOURS[first + 1][i]].map(f32::from);
            (from + (to - from) * part).round() as u8
        })
    }
}

/// Writes values of cells (row by row from the lowest y, x fastest) as a coloured `.png`, for people: heights,
/// distances. Where a value is NaN the pixel is grey, or nearly white if `is_known` says so of the cell. `what`
/// names the values and their unit in the `Description` in the file, beside the scale.
///
/// # Errors
/// Beside those of writing: there are not as many values as cells.
pub fn export_values(
    path: impl AsRef<Path>,
    [width, height]: [usize; 2],
    values: &[f32],
    is_known: impl Fn(usize, usize) -> bool,
    scale: Scale,
    what: &str,
) -> Result<(), WriteError> {
    let path = path.as_ref();
    must_be_png(path)?;
    if width.checked_mul(height) != Some(values.len()) {
        let why = format!("they do not fill {width} × {height} cells");
        return Err(WriteError::unfit(path, format!("{} values", values.len()), why));
    }
    let colour = |(cell, value): (usize, &f32)| {
        if value.is_nan() {
            NO_COLOUR[usize::from(is_known(cell % width, cell / width))]
        } else {
            scale.colour(*value)
        }
    };
    let cells: Vec<[u8; 3]> = values.iter().enumerate().map(colour).collect();
    let note = format!("Flockmap {what}: blue {} to orange {}", scale.low, scale.high);
    write_png(path, [width, height], &Pixels::Colour(upside_down(&cells, width)), &note)
}

fn must_be_png(path: &Path) -> Result<(), WriteError> {
    let fits = ending(path) == "png";
    fits.then_some(())
        .ok_or_else(|| WriteError::unfit(path, "a file with this ending", ".png can be written"))
}

/// Lower and upper face of a box.
fn heights_of(resolution: Resolution, region: &VoxelBox) -> String {
    let side = resolution.metres();
    format!("{:.3} to {:.3}", f64::from(region.min().z) * side, f64::from(region.max().z + 1) * side)
}

/// A string in YAML, whatever is in it.
fn quoted(text: &str) -> String {
    let mut quoted = String::from("\"");
    for c in text.chars() {
        match c {
            '"' | '\\' => quoted.extend(['\\', c]),
            c if c.is_control() => quoted.push_str(&format!("\\u{:04x}", c as u32)),
            c => quoted.push(c),
        }
    }
    quoted + "\""
}
