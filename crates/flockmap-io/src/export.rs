//! Taking a map elsewhere: `.ply`, `.pcd`, `.bt`.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use flockmap_grid::{Resolution, State, Voxel};

use crate::cloud::PointCloud;
use crate::error::WriteError;
use crate::octomap::write_octomap;

/// How to export a map.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct ExportOptions {
    /// Whether `.ply` and `.pcd` hold free voxels too. Each point then has a `state` (1 occupied, 0 free), and in `.ply` a
    /// colour. Default: occupied voxels alone. A `.bt` always holds both.
    pub free: bool,
}

/// Writes a map by the ending of the path: `.ply` or `.pcd` with the centre of each voxel in metres (binary; `f32`, or
/// `f64` where the map reaches so far that `f32` would be off by more than 1/16 voxel), or an OctoMap `.bt`.
///
/// Voxels may come in any order, each once; they are written in ascending order, so equal maps give equal files. Unknown
/// voxels are left out. Returns the number of voxels written. Memory: 16 bytes a voxel, 24 for `.bt`.
pub fn export_map(
    path: impl AsRef<Path>,
    resolution: Resolution,
    voxels: impl IntoIterator<Item = (Voxel, State)>,
    options: &ExportOptions,
) -> Result<u64, WriteError> {
    let path = path.as_ref();
    let write = Form::of(path)?;
    if let Form::Bt = write {
        let mut count = 0;
        let counted = voxels.into_iter().filter(|(_, s)| *s != State::Unknown).inspect(|_| count += 1);
        let mut bytes = Vec::new();
        write_octomap(&mut bytes, path, resolution, counted)?;
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
    let layout = Layout { double: kept.iter().any(|(v, _)| far(v)), state: options.free };
    let rows = kept.iter().map(|&(voxel, state)| (resolution.centre(voxel), state));
    write_file(path, |out| match write {
        Form::Ply => write_ply(out, kept.len(), layout, rows),
        _ => write_pcd(out, kept.len(), layout, rows),
    })?;
    Ok(kept.len() as u64)
}

/// Writes a point cloud by the ending of the path: `.ply` or `.pcd`, binary; `f64` if the cloud has an origin, else `f32`.
pub fn write_cloud(path: impl AsRef<Path>, cloud: &PointCloud) -> Result<(), WriteError> {
    let path = path.as_ref();
    let form = Form::of(path)?;
    let layout = Layout { double: cloud.origin != [0.0; 3], state: false };
    let place = |p: &[f32; 3]| core::array::from_fn(|axis| cloud.origin[axis] + f64::from(p[axis]));
    let rows = cloud.points.iter().map(|p| (place(p), State::Occupied));
    match form {
        Form::Ply => write_file(path, |out| write_ply(out, cloud.points.len(), layout, rows)),
        Form::Pcd => write_file(path, |out| write_pcd(out, cloud.points.len(), layout, rows)),
        Form::Bt => Err(unknown_ending(path, ".ply or .pcd")),
    }
}

enum Form {
    Ply,
    Pcd,
    Bt,
}

impl Form {
    fn of(path: &Path) -> Result<Self, WriteError> {
        let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
        match extension.as_deref() {
            Some("ply") => Ok(Self::Ply),
            Some("pcd") => Ok(Self::Pcd),
            Some("bt") => Ok(Self::Bt),
            _ => Err(unknown_ending(path, ".ply, .pcd or .bt")),
        }
    }
}

fn unknown_ending(path: &Path, known: &str) -> WriteError {
    WriteError::Unfit {
        path: path.to_owned(),
        what: "a file with this ending".into(),
        why: format!("{known} can be written"),
    }
}

fn write_file(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> Result<(), WriteError> {
    let mut out = BufWriter::new(File::create(path).map_err(WriteError::io(path))?);
    write(&mut out).and_then(|()| out.flush()).map_err(WriteError::io(path))
}

#[derive(Clone, Copy)]
struct Layout {
    double: bool,
    state: bool,
}

impl Layout {
    fn point(self, out: &mut impl Write, point: [f64; 3]) -> io::Result<()> {
        for v in point {
            if self.double {
                out.write_all(&v.to_le_bytes())?;
            } else {
                out.write_all(&(v as f32).to_le_bytes())?;
            }
        }
        Ok(())
    }
}

type Row = ([f64; 3], State);

fn write_ply(
    out: &mut impl Write,
    count: usize,
    layout: Layout,
    rows: impl Iterator<Item = Row>,
) -> io::Result<()> {
    let number = if layout.double { "double" } else { "float" };
    writeln!(out, "ply\nformat binary_little_endian 1.0\ncomment Flockmap\nelement vertex {count}")?;
    for axis in ["x", "y", "z"] {
        writeln!(out, "property {number} {axis}")?;
    }
    if layout.state {
        for name in ["red", "green", "blue", "state"] {
            writeln!(out, "property uchar {name}")?;
        }
    }
    writeln!(out, "end_header")?;
    for (point, state) in rows {
        layout.point(out, point)?;
        if layout.state {
            out.write_all(if state == State::Occupied { &[214, 69, 43, 1] } else { &[150, 190, 220, 0] })?;
        }
    }
    Ok(())
}

fn write_pcd(
    out: &mut impl Write,
    count: usize,
    layout: Layout,
    rows: impl Iterator<Item = Row>,
) -> io::Result<()> {
    let size = if layout.double { 8 } else { 4 };
    let [name, bytes, kind, one] = if layout.state { [" state", " 1", " U", " 1"] } else { [""; 4] };
    writeln!(out, "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z{name}")?;
    writeln!(out, "SIZE {size} {size} {size}{bytes}\nTYPE F F F{kind}\nCOUNT 1 1 1{one}")?;
    writeln!(out, "WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary")?;
    for (point, state) in rows {
        layout.point(out, point)?;
        if layout.state {
            out.write_all(&[u8::from(state == State::Occupied)])?;
        }
    }
    Ok(())
}
