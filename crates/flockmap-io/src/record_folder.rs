//! Records as folders: `Scans/*.pcd`, poses in KITTI's form, `times.txt`.

use std::path::{Path, PathBuf};

use flockmap_grid::{Pose, Scan, Stamp};

use crate::error::{Fault, Place, ReadError, check_room, excerpt};
use crate::file::{name_of, read_whole};
use crate::pcd;
use crate::record::{Frame, Frames, Record, RecordOptions, RecordSummary};
use crate::record_submaps::SubmapPoses;

/// Most scans in a folder, and most rows of poses.
const ROWS_MAX: usize = 1 << 22;
/// Largest text file and largest scan in bytes.
const FILE_BYTES_MAX: u64 = 1 << 30;
const POSE_FILES: [&str; 3] = ["optimized_poses.txt", "odom_poses.txt", "poses.txt"];

pub(crate) fn open(folder: &Path, options: &RecordOptions) -> Result<Record, ReadError> {
    let scans = scan_files(folder)?;
    let in_folder = || POSE_FILES.iter().map(|name| folder.join(name)).find(|path| path.is_file());
    let poses_path = options.poses.clone().or_else(in_folder).ok_or_else(|| {
        let expected = format!("a pose file: {}", POSE_FILES.join(", "));
        Fault::foreign(Place::Whole, expected, "none of them").in_file(folder)
    })?;
    let poses = read_rows(&poses_path, kitti_pose)?;
    let rows = rows(&scans, poses.len()).map_err(|fault| fault.in_file(folder))?;
    let stamps = stamps(folder, options, &rows)?;
    let mut entries: Vec<((Stamp, Pose), PathBuf)> = scans
        .into_iter()
        .zip(rows)
        .zip(stamps)
        .map(|((path, row), stamp)| ((stamp, poses.get(row).copied().unwrap_or_default()), path))
        .collect();
    entries.sort_by_key(|((stamp, _), _)| *stamp);
    let poses: Vec<(Stamp, Pose)> = entries.iter().map(|(at, _)| *at).collect();
    let mut summary = RecordSummary::from_poses(&poses);
    summary.scans = summary.frames;
    summary.poses_from = poses_path.display().to_string();
    let points_max = options.scan_points_max;
    let frames = entries.into_iter().map(move |(at, path)| read_frame(at, &path, points_max));
    Ok(Record {
        name: name_of(folder),
        files: vec![folder.to_owned()],
        summary,
        poses,
        submaps: SubmapPoses::default(),
        frames: Frames::new(frames),
    })
}

fn read_frame((stamp, pose): (Stamp, Pose), path: &Path, points_max: u64) -> Result<Frame, ReadError> {
    let bytes = read_whole(path, FILE_BYTES_MAX)?;
    let parsed = pcd::parse(&bytes, points_max).map_err(|fault| fault.in_file(path))?;
    if parsed.viewpoint != Pose::IDENTITY {
        let expected = "VIEWPOINT 0 0 0 1 0 0 0: the pose of a scan comes from the pose file";
        let place = Place::Line(parsed.viewpoint_line);
        return Err(Fault::foreign(place, expected, "another pose").in_file(path));
    }
    if !parsed.points.free.is_empty() {
        let found = "points with the state 0: a map with free voxels";
        return Err(Fault::foreign(Place::Whole, "a scan: points where the sensor met something", found)
            .in_file(path));
    }
    let stored = parsed.points.solid;
    let mut points = Vec::with_capacity(stored.len());
    let finite = stored.iter().filter(|p| p.iter().all(|v| v.is_finite()));
    points.extend(finite.map(|p| p.map(|v| v as f32)));
    let points_dropped = (stored.len() - points.len()) as u64;
    let scan = Scan { stamp, points, no_returns: Vec::new() };
    Ok(Frame { scan, t_map_sensor: pose, points_dropped })
}

/// The scans of the folder in the order of their names, numbers taken as numbers.
fn scan_files(folder: &Path) -> Result<Vec<PathBuf>, ReadError> {
    let scans = ["Scans", "scans"].iter().map(|name| folder.join(name)).find(|path| path.is_dir());
    let scans = scans.ok_or_else(|| {
        let expected = "a rosbag2 folder with metadata.yaml, or a folder Scans with .pcd files in it";
        Fault::foreign(Place::Whole, expected, "neither").in_file(folder)
    })?;
    let io = |error: std::io::Error| Fault::io(&error).in_file(&scans);
    let mut files = Vec::new();
    for file in std::fs::read_dir(&scans).map_err(io)? {
        let path = file.map_err(io)?.path();
        if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("pcd")) {
            check_room("the number of scans", files.len(), ROWS_MAX)
                .map_err(|fault| fault.in_file(&scans))?;
            files.push(path);
        }
    }
    if files.is_empty() {
        return Err(Fault::foreign(Place::Whole, "files *.pcd", "none").in_file(&scans));
    }
    files.sort_by_cached_key(|path| (number(path).unwrap_or(u64::MAX), path.clone()));
    Ok(files)
}

fn number(path: &Path) -> Option<u64> {
    path.file_stem()?.to_str()?.parse().ok()
}

/// The row of each scan. A scan that is named by its number has the row of that number (from 0); where that
/// does not fit, the first scan has the first row, if there are just as many rows as scans.
fn rows(scans: &[PathBuf], rows: usize) -> Result<Vec<usize>, Fault> {
    let numbers: Option<Vec<usize>> =
        scans.iter().map(|path| number(path).and_then(|n| usize::try_from(n).ok())).collect();
    match numbers {
        Some(numbers) if numbers.iter().all(|&n| n < rows) => Ok(numbers),
        _ if scans.len() == rows => Ok((0..rows).collect()),
        _ => Err(Fault::foreign(
            Place::Whole,
            format!("as many poses as scans ({}), or scans named by their row from 0", scans.len()),
            format!("{rows} poses"),
        )),
    }
}

/// The stamp of each scan, from its row of `times.txt` or from the period.
fn stamps(folder: &Path, options: &RecordOptions, rows: &[usize]) -> Result<Vec<Stamp>, ReadError> {
    let path = folder.join("times.txt");
    if !path.is_file() {
        let period = options.scan_period_s.filter(|&period| period > 0.0 && period < 1e6);
        let period = period.ok_or_else(|| {
            let expected = "a time in seconds in each row, or the time between two scans in the options";
            Fault::foreign(Place::Whole, expected, "no such file").in_file(&path)
        })?;
        return Ok(rows.iter().map(|&row| Stamp::from_seconds(row as f64 * period)).collect());
    }
    let stamps = read_rows(&path, |line| {
        let seconds: f64 = line.trim().parse().ok()?;
        (seconds.abs() < 1e12).then(|| Stamp::from_seconds(seconds))
    })?;
    let of_row = |&row: &usize| {
        stamps.get(row).copied().ok_or_else(|| {
            let expected = format!("a time for each scan, so at least {} rows", row + 1);
            let end = Place::Line(stamps.len() as u64 + 1);
            Fault::truncated(end, expected, format!("{} rows", stamps.len())).in_file(&path)
        })
    };
    rows.iter().map(of_row).collect()
}

/// Twelve numbers: a 3 × 4 matrix, row by row.
fn kitti_pose(line: &str) -> Option<Pose> {
    let words = line.split_ascii_whitespace().take(13);
    let numbers: Vec<f64> = words.map(|word| word.parse().ok()).collect::<Option<_>>()?;
    Pose::from_rows(numbers.try_into().ok()?)
}

/// One value for each line; empty lines at the end are left out.
fn read_rows<T>(path: &Path, parse: impl Fn(&str) -> Option<T>) -> Result<Vec<T>, ReadError> {
    let bytes = read_whole(path, FILE_BYTES_MAX)?;
    let text = bytes.trim_ascii_end();
    // No line at all, where an empty text would be one empty line.
    let lines = text.split(|&b| b == b'\n').filter(|_| !text.is_empty());
    let mut rows = Vec::new();
    for (line, number) in lines.zip(1u64..) {
        check_room("the number of rows", rows.len(), ROWS_MAX).map_err(|fault| fault.in_file(path))?;
        let row = core::str::from_utf8(line).ok().and_then(&parse).ok_or_else(|| {
            let expected =
                "a pose (12 numbers: a rotation and a place, row by row) or a time (1 number, seconds)";
            Fault::damaged(Place::Line(number), expected, excerpt(line)).in_file(path)
        })?;
        rows.push(row);
    }
    Ok(rows)
}
