//! Opening a record of any kind.

use std::path::Path;

use crate::error::{Fault, Place, ReadError};
use crate::file::{ending, unknown_ending};
use crate::mcap_parts::McapParts;
use crate::record::{Record, RecordOptions};
use crate::{record_folder, record_mcap, rosbag};

/// The kinds of records, by how they lie on disk.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum RecordKind {
    /// An MCAP file.
    Mcap,
    /// A rosbag2 folder with MCAP files.
    Bag,
    /// A folder of scans.
    Scans,
}

impl RecordKind {
    /// The kind of record at a path, by the ending of a file and by what is in a folder.
    pub fn of(path: impl AsRef<Path>) -> Result<Self, ReadError> {
        let path = path.as_ref();
        let metadata = std::fs::metadata(path).map_err(|e| Fault::io(&e).in_file(path))?;
        if metadata.is_dir() {
            return Ok(if rosbag::is_bag(path) { Self::Bag } else { Self::Scans });
        }
        let expected = match ending(path).as_str() {
            _ if rosbag::is_mcap(path) => return Ok(Self::Mcap),
            "db3" | "bag" => {
                return Err(
                    Fault::foreign(Place::Whole, rosbag::CONVERT, "another kind of bag").in_file(path)
                );
            }
            "yaml" => "a record: of a bag, name the folder",
            _ => {
                "a record: an .mcap file, a rosbag2 folder, or a folder with Scans/*.pcd, poses and times.txt"
            }
        };
        Err(unknown_ending(path, expected))
    }

    /// The MCAP files of a record; `None` if it has none.
    pub(crate) fn parts(self, path: &Path) -> Result<Option<McapParts>, ReadError> {
        match self {
            Self::Mcap => Ok(Some(McapParts::single(path))),
            Self::Bag => rosbag::parts(path).map(Some),
            Self::Scans => Ok(None),
        }
    }
}

/// Opens a record: an `.mcap` file (ROS 2 PointCloud2 with Odometry or tf; also packed as `.mcap.zstd`), a
/// rosbag2 folder with such files, or a folder with `Scans/*.pcd`, a KITTI pose file and `times.txt`.
///
/// The files of a bag are one record, in the order of `metadata.yaml`. One that is missing or damaged is left
/// out and reported as damage. Only files in the folder are read, whatever the metadata names.
///
/// An MCAP file is read through once here for its poses and stamps, and once more by [`Record::frames`] for
/// its scans. Memory: 64 bytes for each pose (72 for one of a submap; at most 4,194,304), 152 for each scan
/// (at most 4,194,304), one chunk, and as many scans as are out of order (at most 256); of a bag
/// `metadata.yaml` (at most 16 MiB), and up to 128 MiB where a file is packed as a whole.
///
/// ```no_run
/// let record = flockmap_io::open_record("robot1.mcap", &Default::default())?;
/// println!("{}: {} frames", record.name, record.summary.frames);
/// for frame in record.frames {
///     let frame = frame?;
///     println!("{:?}: {} points", frame.scan.stamp, frame.scan.points.len());
/// }
/// # Ok::<(), flockmap_io::ReadError>(())
/// ```
pub fn open_record(path: impl AsRef<Path>, options: &RecordOptions) -> Result<Record, ReadError> {
    let path = path.as_ref();
    match RecordKind::of(path)?.parts(path)? {
        Some(parts) => record_mcap::open(path, parts, options),
        None => record_folder::open(path, options),
    }
}
