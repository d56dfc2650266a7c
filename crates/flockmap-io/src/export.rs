//! Taking a map elsewhere: `.ply`, `.pcd`, `.bt`.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use flockmap_grid::{Resolution, State, Voxel};

use crate::cloud::{PointCloud, STATE, voxels_note};
use crate::error::WriteError;
use crate::file::ending;
use crate::octomap::octomap_bytes;

/// How to export a map.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct ExportOptions {
    /// Whether `.ply` and `.pcd` hold free voxels too. Each point then has a `state` (1 occupied, 0 free),
    /// and in `.ply` a colour. Default: only occupied voxels. A `.bt` always holds both.
    /// [`read_map`](crate::read_map) reads them back.
    pub free: bool,
}

/// Writes a map by the ending of the path: `.ply` or `.pcd` with the centre of each voxel in metres (binary;
/// `f32`, or `f64` where the map reaches so far that `f32` would be off by more than 1/16 voxel), or an
/// OctoMap `.bt`. A comment in the header of `.ply` and `.pcd` tells the side of a voxel.
///
/// Voxels may come in any order, each once; they are written in ascending order, so equal maps give equal
/// files. Unknown voxels are left out. Returns the number of voxels written. Memory: 16 bytes a voxel, 24 for
/// `.bt`.
pub fn export_map(
    path: impl AsRef<Path>,
    resolution: Resolution,
    voxels: impl IntoIterator<Item = (Voxel, State)>,
    options: &ExportOptions,
) -> Result<u64, WriteError> {
    let path = path.as_ref();
    let form = Form::of(path)?;
    if form == Form::Bt {
        let mut count = 0;
        let counted = voxels.into_iter().filter(|(_, s)| *s != State::Unknown).inspect(|_| count += 1);
        let bytes = octomap_bytes(path, resolution, counted)?;
        std::fs::write(path, bytes).map_err(WriteError::io(path))?;
        return Ok(count);
    }
    let mut kept: Vec<(Voxel, State)> = voxels
        .into_iter()
        .filter(|(_, state)| *state == State::Occupied || (options.free && *state == State::Free))
        .collect();
    kept.sort_unstable_by_key(|(voxel, _)| *voxel);
    // An f32 has 24 bits: up to index 2²⁰ a sixteenth of a voxel is left.
    let far = |v: &Voxel| [v.x, v.y, v.z].iter().any(|i| i.unsigned_abs() >= 1 << 20);
    let double = kept.iter().any(|(v, _)| far(v));
    let layout = Layout { double, state: options.free, voxels: Some(resolution) };
    let rows = kept.iter().map(|&(voxel, state)| (resolution.centre(voxel), state));
    layout.write(path, form, kept.len(), rows)?;
    Ok(kept.len() as u64)
}

/// Writes a point cloud by the ending of the path: `.ply` or `.pcd`, binary; `f64` if the cloud has an
/// origin, else `f32`. Free points have the `state` 0, and the others then 1.
pub fn write_cloud(path: impl AsRef<Path>, cloud: &PointCloud) -> Result<(), WriteError> {
    let path = path.as_ref();
    let form = Form::of(path)?;
    let (double, state) = (cloud.origin != [0.0; 3], !cloud.free.is_empty());
    let layout = Layout { double, state, voxels: cloud.voxels };
    let place = |p: &[f32; 3]| core::array::from_fn(|axis| cloud.origin[axis] + f64::from(p[axis]));
    let solid = cloud.points.iter().map(|p| (place(p), State::Occupied));
    let rows = solid.chain(cloud.free.iter().map(|p| (place(p), State::Free)));
    match form {
        Form::Bt => Err(unknown_ending(path, ".ply or .pcd")),
        form => layout.write(path, form, cloud.points.len() + cloud.free.len(), rows),
    }
}

#[derive(Clone, Copy, PartialEq)]
enum Form {
    Ply,
    Pcd,
    Bt,
}

impl Form {
    fn of(path: &Path) -> Result<Self, WriteError> {
        match ending(path).as_str() {
            "ply" => Ok(Self::Ply),
            "pcd" => Ok(Self::Pcd),
            "bt" => Ok(Self::Bt),
            _ => Err(unknown_ending(path, ".ply, .pcd or .bt")),
        }
    }
}

fn unknown_ending(path: &Path, known: &str) -> WriteError {
    WriteError::unfit(path, "a file with this ending", format!("{known} can be written"))
}

/// What is written of each point: `f32` or `f64`, and whether its state; and whether they are centres of
/// voxels.
#[derive(Clone, Copy)]
struct Layout {
    double: bool,
    state: bool,
    voxels: Option<Resolution>,
}

impl Layout {
    fn write(
        self,
        path: &Path,
        form: Form,
        count: usize,
        rows: impl Iterator<Item = ([f64; 3], State)>,
    ) -> Result<(), WriteError> {
        let write = || {
            let mut out = BufWriter::new(File::create(path)?);
            let header = if form == Form::Ply { self.ply_header(count) } else { self.pcd_header(count) };
            out.write_all(header.as_bytes())?;
            for (point, state) in rows {
                for v in point {
                    if self.double {
                        out.write_all(&v.to_le_bytes())?;
                    } else {
                        out.write_all(&(v as f32).to_le_bytes())?;
                    }
                }
                let is_occupied = state == State::Occupied;
                let after: &[u8] = match form {
                    _ if !self.state => &[],
                    Form::Ply if is_occupied => &[214, 69, 43, 1],
                    Form::Ply => &[150, 190, 220, 0],
                    _ if is_occupied => &[1],
                    _ => &[0],
                };
                out.write_all(after)?;
            }
            out.flush()
        };
        write().map_err(WriteError::io(path))
    }

    fn ply_header(self, count: usize) -> String {
        let number = if self.double { "double" } else { "float" };
        let state = if self.state {
            format!("property uchar red\nproperty uchar green\nproperty uchar blue\nproperty uchar {STATE}\n")
        } else {
            String::new()
        };
        let note = self.voxels.map_or_else(|| "Flockmap".to_owned(), voxels_note);
        format!(
            "ply\nformat binary_little_endian 1.0\ncomment {note}\nelement vertex {count}\n\
             property {number} x\nproperty {number} y\nproperty {number} z\n{state}end_header\n"
        )
    }

    fn pcd_header(self, count: usize) -> String {
        let size = if self.double { 8 } else { 4 };
        let [name, bytes, kind, one] = if self.state { [" state", " 1", " U", " 1"] } else { [""; 4] };
        let note = self.voxels.map(|side| format!("# {}\n", voxels_note(side))).unwrap_or_default();
        format!(
            "# .PCD v0.7 - Point Cloud Data file format\n{note}VERSION 0.7\nFIELDS x y z{name}\n\
             SIZE {size} {size} {size}{bytes}\nTYPE F F F{kind}\nCOUNT 1 1 1{one}\n\
             WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n"
        )
    }
}
