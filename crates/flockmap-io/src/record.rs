//! Recordings of a robot: scans with the pose of the sensor at each.

use std::fmt;
use std::path::PathBuf;

use flockmap_grid::{Pose, Scan, Stamp};

use crate::error::ReadError;
use crate::record_submaps::SubmapPoses;

/// How to read a record. `RecordOptions::default()` fits most.
#[derive(Clone, Debug)]
pub struct RecordOptions {
    /// Topic of the scans in an MCAP. Default: the only one with `sensor_msgs/msg/PointCloud2`, or of
    /// several the only one in a frame that odometry or tf leads to (maps and pictures for viewers lie in the
    /// frame of the map).
    pub points_topic: Option<String>,
    /// Topic of `nav_msgs/msg/Odometry` in an MCAP. Default: the one that gives the frame of the scans; of
    /// several the one whose namespace begins most like that of the scans (`/robot1/odometry` for
    /// `/robot1/points`).
    pub odometry_topic: Option<String>,
    /// Frame in which poses are wanted, in an MCAP file. Default: the parent frame of the odometry, or else
    /// the root of tf.
    pub map_frame: Option<String>,
    /// Topic of `geometry_msgs/msg/PoseArray` in an MCAP with `T_map_submap` of each submap of the robot, in
    /// their order, at most 4,096: where a list has more than the one before, more submaps begin. Default: none,
    /// since such lists may be anything.
    pub submaps_topic: Option<String>,
    /// Pose file of a folder, in KITTI's form. Default: `optimized_poses.txt`, `odom_poses.txt` or
    /// `poses.txt` in it.
    pub poses: Option<PathBuf>,
    /// Time between two scans of a folder without `times.txt`, in seconds. Default: `times.txt` is needed.
    pub scan_period_s: Option<f64>,
    /// Longest gap between two poses across which a pose is interpolated, in seconds. Default 0.5.
    pub pose_gap_max_s: f64,
    /// Most points in a scan; one with more is an error. Default 4,194,304 (48 MB as points).
    pub scan_points_max: u64,
    /// Largest chunk or message of an MCAP file, packed and unpacked, in bytes. Default 64 MiB. Reading holds
    /// up to twice as much at a time.
    pub chunk_bytes_max: u64,
}

impl Default for RecordOptions {
    fn default() -> Self {
        Self {
            points_topic: None,
            odometry_topic: None,
            map_frame: None,
            submaps_topic: None,
            poses: None,
            scan_period_s: None,
            pose_gap_max_s: 0.5,
            scan_points_max: 1 << 22,
            chunk_bytes_max: 64 << 20,
        }
    }
}

/// A scan and where the sensor was.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Frame {
    /// Points in the frame of the sensor, and when they were taken.
    pub scan: Scan,
    /// `T_map_sensor`, the pose of the sensor at that time.
    pub t_map_sensor: Pose,
    /// Points of the scan left out because a coordinate was not a finite number.
    pub points_dropped: u64,
}

/// A recording of one robot.
#[derive(Debug)]
pub struct Record {
    /// A name for the robot: the file or folder without its ending.
    pub name: String,
    /// The files with the scans; of a folder of scans, the folder.
    pub files: Vec<PathBuf>,
    /// What is known of the record before its scans are read.
    pub summary: RecordSummary,
    /// Stamp and `T_map_sensor` of each frame, in order: where the robot was, known before the scans are
    /// read. 64 bytes each.
    pub poses: Vec<(Stamp, Pose)>,
    /// How the submaps lie, if [`RecordOptions::submaps_topic`] names where it is said.
    pub submaps: SubmapPoses,
    /// The scans, in the order of their stamps.
    pub frames: Frames,
}

/// What is known of a record before its scans are read.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct RecordSummary {
    /// Scans found.
    pub scans: u64,
    /// Scans with a pose: so many frames there are, unless a scan turns out to be damaged.
    pub frames: u64,
    /// Scans left out because no pose was known for their time.
    pub scans_without_pose: u64,
    /// Points of all scans, where the record says it without reading them.
    pub points: Option<u64>,
    /// Stamps of the first and of the last frame.
    pub span: Option<(Stamp, Stamp)>,
    /// Length of the path from frame to frame, in metres.
    pub path_m: f64,
    /// Topic of the scans, in an MCAP.
    pub points_topic: Option<String>,
    /// Frame of the poses, in an MCAP; `None` where scans are in several.
    pub map_frame: Option<String>,
    /// Where the poses come from, as text.
    pub poses_from: String,
    /// Damage found while reading the file; what could be read is in the frames. At most 16 kept.
    pub damages: Vec<ReadError>,
}

impl RecordSummary {
    /// Time from the first to the last frame, in seconds.
    pub fn duration_s(&self) -> f64 {
        self.span.map_or(0.0, |(first, last)| last.micros_since(first) as f64 / 1e6)
    }

    pub(crate) fn from_poses(poses: &[(Stamp, Pose)]) -> Self {
        let steps = poses.iter().zip(poses.iter().skip(1)).map(|((_, a), (_, b))| {
            let (a, b) = (a.translation(), b.translation());
            a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
        });
        Self {
            frames: poses.len() as u64,
            span: poses.first().zip(poses.last()).map(|((first, _), (last, _))| (*first, *last)),
            path_m: steps.fold(0.0, |path, step| path + step),
            ..Self::default()
        }
    }
}

/// The frames of a record in the order of their stamps, read from the file as they are asked for.
///
/// An error is a part that could not be read; the next call goes on with what can still be read. The damage
/// of an MCAP file (a truncated end, a broken chunk) comes after all its frames.
pub struct Frames {
    inner: Box<dyn Iterator<Item = Result<Frame, ReadError>> + Send>,
}

impl Frames {
    /// Frames from any source, for example a simulation. They should come in the order of their stamps.
    pub fn new(frames: impl Iterator<Item = Result<Frame, ReadError>> + Send + 'static) -> Self {
        Self { inner: Box::new(frames) }
    }
}

impl Iterator for Frames {
    type Item = Result<Frame, ReadError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.inner.next()
    }
}

impl fmt::Debug for Frames {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Frames")
    }
}
