//! What is in a file, for `flockmap info`.

use std::fmt;
use std::path::{Path, PathBuf};

use flockmap_grid::{Resolution, State};

use crate::cloud_reader::read_cloud;
use crate::error::{Fault, ReadError};
use crate::file::{ending, unknown_ending};
use crate::mcap_index::McapIndex;
use crate::octomap::OctoMap;
use crate::record::{RecordOptions, RecordSummary};
use crate::record_mcap;
use crate::record_reader::{RecordKind, open_record};

/// What is in a file or folder. `Display` gives it as lines of text.
#[derive(Clone, PartialEq, Debug)]
pub struct Description {
    /// The file or folder.
    pub path: PathBuf,
    /// Its size in bytes; of a rosbag2 folder that of its MCAP files, of a folder of scans zero.
    pub bytes: u64,
    /// What it holds.
    pub content: Content,
}

/// What a file holds.
#[derive(Clone, PartialEq, Debug)]
#[non_exhaustive]
pub enum Content {
    /// An MCAP file, or a rosbag2 folder.
    Mcap {
        /// Number of files.
        files: usize,
        /// Its topics in the order of their names.
        topics: Vec<Topic>,
        /// As a record, or why it is none.
        record: Result<RecordSummary, ReadError>,
    },
    /// A folder of scans.
    Folder(RecordSummary),
    /// A point cloud.
    Cloud {
        /// Number of points where something is.
        points: u64,
        /// Number of points where the file says that nothing is ([`PointCloud::free`](crate::PointCloud)).
        free: u64,
        /// Side of the voxels whose centres the points are, in an exported map.
        voxels: Option<Resolution>,
        /// Points left out because a coordinate was not a finite number.
        dropped: u64,
        /// Lowest and highest corner in metres, in the coordinates of the file.
        bounds: Option<[[f64; 3]; 2]>,
    },
    /// An OctoMap.
    OctoMap {
        /// Side of a voxel.
        resolution: Resolution,
        /// Nodes of the tree.
        nodes: u64,
        /// Leaves of the tree: cubes of voxels with one state.
        leaves: u64,
        /// Free voxels of the finest size.
        free: u64,
        /// Occupied voxels of the finest size.
        occupied: u64,
        /// Lowest and highest corner of what is known, in metres.
        bounds: Option<[[f64; 3]; 2]>,
    },
}

/// A topic of an MCAP file.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Topic {
    /// Its name.
    pub name: String,
    /// Type of its messages.
    pub schema: String,
    /// Encoding of its messages.
    pub encoding: String,
    /// Number of its messages.
    pub messages: u64,
}

/// Looks into a file that this crate reads: a record, a point cloud or an OctoMap. Reads the whole file;
/// memory is that of the reader of its kind.
pub fn describe(path: impl AsRef<Path>) -> Result<Description, ReadError> {
    let path = path.as_ref();
    let metadata = std::fs::metadata(path).map_err(|e| Fault::io(&e).in_file(path))?;
    let options = RecordOptions::default();
    let mut bytes = if metadata.is_dir() { 0 } else { metadata.len() };
    let content = match ending(path).as_str() {
        "pcd" | "ply" | "las" | "laz" => {
            let cloud = read_cloud(path)?;
            Content::Cloud {
                points: cloud.points.len() as u64,
                free: cloud.free.len() as u64,
                voxels: cloud.voxels,
                dropped: cloud.dropped,
                bounds: cloud.bounds(),
            }
        }
        "bt" => {
            let map = OctoMap::read(path)?;
            Content::OctoMap {
                resolution: map.resolution(),
                nodes: map.nodes(),
                leaves: map.cubes().len() as u64,
                free: map.voxel_count(State::Free),
                occupied: map.voxel_count(State::Occupied),
                bounds: map.bounds(),
            }
        }
        _ => match RecordKind::of(path).map_err(|error| unknown(path, error))?.parts(path)? {
            None => Content::Folder(open_record(path, &options)?.summary),
            Some(parts) => {
                bytes = parts.bytes();
                let files = parts.files.len();
                let index = McapIndex::read(&parts, &options)?;
                let topics = index.channels.iter().map(|(channel, &messages)| Topic {
                    name: channel.topic.clone(),
                    schema: channel.schema.clone(),
                    encoding: channel.encoding.clone(),
                    messages,
                });
                let topics = topics.collect();
                let record = record_mcap::plan(path, parts, &options, index).map(|record| record.summary);
                Content::Mcap { files, topics, record }
            }
        },
    };
    Ok(Description { path: path.to_owned(), bytes, content })
}

/// Why a path is nothing that is read here.
fn unknown(path: &Path, error: ReadError) -> ReadError {
    let is_known = matches!(ending(path).as_str(), "db3" | "bag" | "yaml");
    let expected = "a record (.mcap, rosbag2 folder, folder of scans), a cloud (.pcd, .ply, .las, .laz) or an OctoMap (.bt)";
    if is_known || path.is_dir() { error } else { unknown_ending(path, expected) }
}

impl fmt::Display for Description {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let kind = match &self.content {
            Content::Mcap { files, .. } if self.path.is_dir() => {
                &format!("rosbag2 folder, {files} {}", if *files == 1 { "file" } else { "files" })
            }
            Content::Mcap { .. } => "MCAP file",
            Content::Folder(_) => "folder of scans",
            Content::Cloud { .. } => "point cloud",
            Content::OctoMap { .. } => "OctoMap",
        };
        let bytes = if self.bytes > 0 { format!(", {} bytes", self.bytes) } else { String::new() };
        writeln!(f, "{}: {kind}{bytes}", self.path.display())?;
        match &self.content {
            Content::Mcap { topics, record, .. } => {
                for Topic { name, schema, encoding, messages } in topics {
                    writeln!(f, "  {name}: {messages} × {schema} ({encoding})")?;
                }
                match record {
                    Ok(summary) => write_summary(f, summary),
                    Err(error) => writeln!(f, "  no record: {}{}", error.place, error.problem),
                }
            }
            Content::Folder(summary) => write_summary(f, summary),
            Content::Cloud { points, free, voxels, dropped, bounds } => {
                if let Some(side) = voxels {
                    writeln!(f, "  a map: centres of voxels of {} m", side.metres())?;
                }
                let free = if *free > 0 { format!(", {free} more of free space") } else { String::new() };
                writeln!(f, "  {points} points{free}, {dropped} without a finite place")?;
                write_bounds(f, bounds)
            }
            Content::OctoMap { resolution, nodes, leaves, free, occupied, bounds } => {
                writeln!(f, "  resolution {resolution:?}, {nodes} nodes, {leaves} leaves")?;
                writeln!(f, "  {occupied} occupied and {free} free voxels")?;
                write_bounds(f, bounds)
            }
        }
    }
}

fn write_summary(f: &mut fmt::Formatter<'_>, summary: &RecordSummary) -> fmt::Result {
    let RecordSummary { scans, frames, scans_without_pose, path_m, poses_from, .. } = summary;
    writeln!(f, "  {frames} frames of {scans} scans ({scans_without_pose} without a pose)")?;
    if let Some(points) = summary.points {
        writeln!(f, "  {points} points, {} a scan", points / (*scans).max(1))?;
    }
    writeln!(f, "  {:.3} s, {path_m:.2} m, poses from {poses_from}", summary.duration_s())?;
    for damage in &summary.damages {
        writeln!(f, "  damage: {}{}", damage.place, damage.problem)?;
    }
    Ok(())
}

fn write_bounds(f: &mut fmt::Formatter<'_>, bounds: &Option<[[f64; 3]; 2]>) -> fmt::Result {
    let Some([low, high]) = bounds else { return writeln!(f, "  empty") };
    let size: [f64; 3] = core::array::from_fn(|axis| high[axis] - low[axis]);
    writeln!(
        f,
        "  from ({:.3}, {:.3}, {:.3}) to ({:.3}, {:.3}, {:.3}) m",
        low[0], low[1], low[2], high[0], high[1], high[2]
    )?;
    writeln!(f, "  {:.2} × {:.2} × {:.2} m", size[0], size[1], size[2])
}
