//! A scan and its pose, and how submaps lie, as messages of ROS 2, as they stand in records.

use std::path::Path;

use flockmap_grid::{Pose, Scan, Stamp, SubmapId};

use crate::error::WriteError;
use crate::ros::{
    self, Header, Odometry, PoseArray, PoseWithCovariance, TFMessage, TransformStamped, cloud_of_points,
    encode,
};

/// The frame in which poses and maps are.
pub(crate) const MAP_FRAME: &str = "map";
/// Topic of scans, behind the name of the robot.
pub(crate) const POINTS: &str = "/points";
/// Topic of poses, behind the name of the robot.
pub(crate) const ODOMETRY: &str = "/odometry";
/// Topic of poses, of all robots.
pub(crate) const TRANSFORMS: &str = "/tf";

/// Topic of how submaps lie, behind the name of the robot.
pub(crate) const SUBMAPS: &str = "/submaps";

/// Gives each message of a scan to `write`: its topic, its schema, its bytes. The pose comes first: a program that
/// plays them knows where the sensor is when the scan comes.
pub(crate) fn scan_messages(
    path: &Path,
    robot: &str,
    scan: &Scan,
    t_map_sensor: &Pose,
    mut write: impl FnMut(&str, &'static str, &[u8]) -> Result<(), WriteError>,
) -> Result<(), WriteError> {
    let most = (u32::MAX / 12) as usize;
    if scan.points.len().max(scan.no_returns.len()) > most {
        let why = "a PointCloud2 holds at most 2³² bytes";
        return Err(WriteError::unfit(path, "a scan", why));
    }
    let sensor_frame = format!("{robot}/lidar");
    let in_sensor = Header::new(scan.stamp, &sensor_frame);
    let transform = TransformStamped {
        header: Header::new(scan.stamp, MAP_FRAME),
        child_frame_id: sensor_frame.clone(),
        transform: (*t_map_sensor).into(),
    };
    // No covariance and no velocity.
    let odometry = Odometry {
        header: transform.header.clone(),
        child_frame_id: sensor_frame,
        pose: PoseWithCovariance { pose: transform.transform, ..Default::default() },
        ..Default::default()
    };
    let transforms = TFMessage { transforms: vec![transform] };
    write(&format!("/{robot}{ODOMETRY}"), ros::ODOMETRY, &encode(&odometry))?;
    write(TRANSFORMS, ros::TRANSFORMS, &encode(&transforms))?;
    for (topic, points) in [(ros::NO_RETURNS, &scan.no_returns), (POINTS, &scan.points)] {
        if topic == POINTS || !points.is_empty() {
            let message = encode(&cloud_of_points(in_sensor.clone(), points));
            write(&format!("/{robot}{topic}"), ros::POINT_CLOUD, &message)?;
        }
    }
    Ok(())
}

/// The message that says how all submaps of a robot lie from a time on.
pub(crate) fn submaps_message(path: &Path, now: Stamp, poses: &[Pose]) -> Result<Vec<u8>, WriteError> {
    check_stamp(path, now)?;
    if poses.len() > SubmapId::COUNT {
        let why = format!("a run has at most {}", SubmapId::COUNT);
        return Err(WriteError::unfit(path, format!("{} submaps", poses.len()), why));
    }
    // As a robot has them, so that they are read back bit for bit.
    let poses = poses.iter().map(|pose| pose.rounded().map(Into::into)).collect::<Result<_, _>>();
    let poses = poses.map_err(|error| WriteError::unfit(path, "a pose of a submap", error.to_string()))?;
    Ok(encode(&PoseArray { header: Header::new(now, MAP_FRAME), poses }))
}

/// Whether ROS 2 has a time for a stamp.
pub(crate) fn check_stamp(path: &Path, stamp: Stamp) -> Result<(), WriteError> {
    if (0..1i64 << 31).contains(&stamp.0.div_euclid(1_000_000)) {
        return Ok(());
    }
    let why = "ROS 2 counts seconds from 0 to 2³¹ − 1";
    Err(WriteError::unfit(path, format!("the stamp {stamp:?}"), why))
}
