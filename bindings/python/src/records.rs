//! Records of robots: scans with poses, as arrays.

use std::path::PathBuf;

use flockmap_io::RecordOptions;
use numpy::{PyArray2, PyArray3, PyArrayMethods};
use pyo3::prelude::*;

use crate::arrays::rows;
use crate::errors::{self, Error};
use crate::given::pose_rows;
use crate::shared::Shared;

/// Stamps (N,) in seconds, and poses (N, 4, 4).
type Track<'py> = (Vec<f64>, Bound<'py, PyArray3<f64>>);

/// A recording of one robot. An iterator of Frames, in the order of their stamps, read from the file as they are asked for.
#[pyclass(frozen, module = "flockmap", name = "Record")]
pub(crate) struct Record {
    /// A name for the robot: the file or folder without its ending.
    #[pyo3(get)]
    name: String,
    /// Scans found.
    #[pyo3(get)]
    scans: u64,
    /// Scans left out because no pose was known for their time.
    #[pyo3(get)]
    scans_without_pose: u64,
    /// Seconds from the first to the last frame.
    #[pyo3(get)]
    duration: f64,
    /// Metres from frame to frame.
    #[pyo3(get)]
    path: f64,
    /// Topic of the scans, if it is a bag.
    #[pyo3(get)]
    points_topic: Option<String>,
    /// Frame of the poses, if it is a bag.
    #[pyo3(get)]
    map_frame: Option<String>,
    /// Damage found while the file was opened; what can be read is read.
    #[pyo3(get)]
    damages: Vec<String>,
    track: Vec<(flockmap::Stamp, flockmap::Pose)>,
    frames: Shared<flockmap_io::Frames>,
}

#[pymethods]
impl Record {
    const fn __iter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
        slf
    }

    /// The next frame. Raises FileError for a part that cannot be read; the next call goes on behind it.
    fn __next__(&self, py: Python<'_>) -> PyResult<Option<Frame>> {
        let next = self.frames.with(py, Iterator::next)?;
        let Some(frame) = next.transpose().map_err(errors::file)? else { return Ok(None) };
        let pose: Vec<Vec<f64>> = pose_rows(&frame.t_map_sensor).iter().map(|row| row.to_vec()).collect();
        Ok(Some(Frame {
            stamp: frame.scan.stamp.seconds(),
            points: rows(py, frame.scan.points)?.unbind(),
            no_returns: rows(py, frame.scan.no_returns)?.unbind(),
            T_map_sensor: PyArray2::from_vec2(py, &pose).map_err(errors::refused)?.unbind(),
            points_dropped: frame.points_dropped,
        }))
    }

    /// Number of frames, unless a scan turns out to be damaged.
    fn __len__(&self) -> usize {
        self.track.len()
    }

    /// Stamps of all frames in seconds, and poses T_map_sensor: (N, 4, 4) float64. Known before the scans are read.
    fn poses<'py>(&self, py: Python<'py>) -> PyResult<Track<'py>> {
        let stamps = self.track.iter().map(|(stamp, _)| stamp.seconds()).collect();
        let numbers: Vec<f64> =
            self.track.iter().flat_map(|(_, pose)| pose_rows(pose).into_iter().flatten()).collect();
        let poses = numpy::PyArray1::from_vec(py, numbers).reshape([self.track.len(), 4, 4])?;
        Ok((stamps, poses))
    }

    /// Lets go of the file. Calls after this raise ClosedError.
    fn close(&self, py: Python<'_>) -> PyResult<()> {
        let frames = self.frames.take(py)?;
        py.detach(|| drop(frames));
        Ok(())
    }

    fn __enter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    #[pyo3(signature = (*_exception))]
    fn __exit__(&self, py: Python<'_>, _exception: &Bound<'_, PyAny>) -> PyResult<()> {
        self.close(py)
    }

    fn __repr__(&self) -> String {
        format!("Record({:?}, {} frames, {:.1} s)", self.name, self.track.len(), self.duration)
    }
}

/// A scan and where the sensor was.
#[pyclass(frozen, module = "flockmap", name = "Frame", get_all)]
#[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
pub(crate) struct Frame {
    /// When it was taken, in seconds.
    stamp: f64,
    /// (N, 3) float32, metres in the frame of the sensor.
    points: Py<PyArray2<f32>>,
    /// (M, 3) float32: for each ray that came back with nothing a point far out along it.
    no_returns: Py<PyArray2<f32>>,
    /// (4, 4) float64, the pose of the sensor in the map.
    T_map_sensor: Py<PyArray2<f64>>,
    /// Points left out because a coordinate was not a finite number.
    points_dropped: u64,
}

#[pymethods]
impl Frame {
    fn __repr__(&self, py: Python<'_>) -> PyResult<String> {
        let points = self.points.bind(py).len()?;
        Ok(format!("Frame(stamp={}, {points} points)", self.stamp))
    }
}

/// Opens a record: an `.mcap` file (ROS 2 PointCloud2 with Odometry or tf; also `.mcap.zstd`), the folder that `ros2 bag record`
/// makes, or a folder with `Scans/*.pcd`, a KITTI pose file and `times.txt`. It is read through once for its poses.
///
/// points_topic, odometry_topic, map_frame: of a bag; None: found by type.
/// poses: pose file of a folder. scan_period: seconds between two scans of a folder without `times.txt`.
/// pose_gap_max: poses are interpolated over at most so many seconds.
#[pyfunction]
#[pyo3(signature = (path, *, points_topic=None, odometry_topic=None, map_frame=None, poses=None, scan_period=None,
    pose_gap_max=0.5))]
#[expect(clippy::too_many_arguments, reason = "they are keywords")]
pub(crate) fn open_record(
    py: Python<'_>,
    path: PathBuf,
    points_topic: Option<String>,
    odometry_topic: Option<String>,
    map_frame: Option<String>,
    poses: Option<PathBuf>,
    scan_period: Option<f64>,
    pose_gap_max: f64,
) -> PyResult<Record> {
    let is_time = |seconds: f64| seconds > 0.0 && seconds.is_finite();
    for (what, seconds) in [("scan_period", scan_period), ("pose_gap_max", Some(pose_gap_max))] {
        if seconds.is_some_and(|seconds| !is_time(seconds)) {
            return Err(Error::new_err(format!("{what} is no time, expected more than 0 seconds")));
        }
    }
    let options = RecordOptions {
        points_topic,
        odometry_topic,
        map_frame,
        poses,
        scan_period_s: scan_period,
        pose_gap_max_s: pose_gap_max,
        ..RecordOptions::default()
    };
    let record = py.detach(|| flockmap_io::open_record(&path, &options)).map_err(errors::file)?;
    let summary = &record.summary;
    Ok(Record {
        scans: summary.scans,
        scans_without_pose: summary.scans_without_pose,
        duration: summary.duration_s(),
        path: summary.path_m,
        points_topic: summary.points_topic.clone(),
        map_frame: summary.map_frame.clone(),
        damages: summary.damages.iter().map(ToString::to_string).collect(),
        name: record.name,
        track: record.poses,
        frames: Shared::new("record", record.frames),
    })
}
