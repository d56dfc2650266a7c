//! Opening a record of any kind.

use std::path::Path;

use crate::error::{Fault, Place, ReadError};
use crate::file::{ending, unknown_ending};
use crate::record::{Record, RecordOptions};
use crate::{record_folder, record_mcap};

/// Opens a record: an `.mcap` file (ROS 2 PointCloud2 with Odometry or tf), or a folder with `Scans/*.pcd`, a
/// KITTI pose file and `times.txt`.
///
/// An MCAP file is read through once here for its poses and stamps, and once more by [`Record::frames`] for
/// its scans. Memory: 64 bytes for each pose (at most 4,194,304), 152 for each scan (at most 4,194,304), one
/// chunk, and as many scans as are out of order (at most 256).
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
    let metadata = std::fs::metadata(path).map_err(|e| Fault::io(&e).in_file(path))?;
    if metadata.is_dir() {
        return record_folder::open(path, options);
    }
    let expected = match ending(path).as_str() {
        "mcap" => return record_mcap::open(path, options),
        "db3" | "bag" => {
            let expected =
                "an .mcap file or a folder of scans (`ros2 bag convert`, or `rosbags-convert`, makes one)";
            return Err(Fault::foreign(Place::Whole, expected, "another kind of bag").in_file(path));
        }
        _ => "a record: an .mcap file, or a folder with Scans/*.pcd, poses and times.txt",
    };
    Err(unknown_ending(path, expected))
}
