//! Writing a record as an MCAP file that other programs read too.

use std::borrow::Cow;
use std::fs::File;
use std::io::{BufWriter, Seek, Write};
use std::path::{Path, PathBuf};

use flockmap_grid::{Pose, Scan};
use mcap::records::MessageHeader;

use crate::error::WriteError;
use crate::record_mcap::NO_RETURNS;
use crate::ros::{self, Header, Transform};

/// Writes what a robot saw as an MCAP file of ROS 2 messages: `/NAME/points` (`sensor_msgs/msg/PointCloud2`, x y z as
/// `f32`, in the frame `NAME/lidar`), `/NAME/odometry` (`nav_msgs/msg/Odometry`, `map` → `NAME/lidar`), `/tf`, and
/// `/NAME/no_returns` for the rays that came back with nothing, if there are any.
///
/// [`crate::open_record`] reads it back, and so do ROS 2, Foxglove and Rerun. The same input gives the same bytes on
/// any machine. Memory: one chunk of about 1 MiB or one scan, and 16 bytes a message for the index.
pub struct RecordWriter<W: Write + Seek = BufWriter<File>> {
    path: PathBuf,
    mcap: mcap::Writer<W>,
    sensor_frame: String,
    points: u16,
    odometry: u16,
    transforms: u16,
    /// Channel of the rays without a return, made when the first of them comes.
    no_returns: Option<u16>,
    no_returns_topic: String,
    point_schema: u16,
    sequence: u32,
}

const MAP_FRAME: &str = "map";

impl RecordWriter {
    /// Makes the file, or overwrites it. `robot` names topics and frames, for example `robot1`.
    pub fn create(path: impl AsRef<Path>, robot: &str) -> Result<Self, WriteError> {
        let path = path.as_ref();
        let file = File::create(path).map_err(WriteError::io(path))?;
        Self::new(BufWriter::new(file), path, robot)
    }
}

impl<W: Write + Seek> RecordWriter<W> {
    /// Writes to anything that can be written and sought; `path` is what errors name.
    pub fn new(out: W, path: impl AsRef<Path>, robot: &str) -> Result<Self, WriteError> {
        let path = path.as_ref().to_owned();
        let options = mcap::WriteOptions::new()
            .profile("ros2")
            .library("flockmap")
            .compression(Some(mcap::Compression::Zstd))
            // Threads would make the bytes depend on the machine.
            .compression_threads(0);
        let made = (|| {
            let mut mcap = options.create(out)?;
            let mut schema = |name| mcap.add_schema(name, "ros2msg", ros::definition(name).as_bytes());
            let (cloud, odometry, tf) =
                (schema(ros::POINT_CLOUD)?, schema(ros::ODOMETRY)?, schema(ros::TRANSFORMS)?);
            let none = Default::default();
            let points = mcap.add_channel(cloud, &format!("/{robot}/points"), "cdr", &none)?;
            let odometry = mcap.add_channel(odometry, &format!("/{robot}/odometry"), "cdr", &none)?;
            let transforms = mcap.add_channel(tf, "/tf", "cdr", &none)?;
            Ok((mcap, cloud, points, odometry, transforms))
        })();
        let (mcap, point_schema, points, odometry, transforms) = match made {
            Ok(made) => made,
            Err(source) => return Err(WriteError::Mcap { path, source }),
        };
        Ok(Self {
            path,
            mcap,
            sensor_frame: format!("{robot}/lidar"),
            points,
            odometry,
            transforms,
            no_returns: None,
            no_returns_topic: format!("/{robot}{NO_RETURNS}"),
            point_schema,
            sequence: 0,
        })
    }

    /// Writes a scan and `T_map_sensor` at its time. The stamp must lie between 0 and 2³¹ s, as ROS 2 counts it.
    pub fn write(&mut self, scan: &Scan, t_map_sensor: &Pose) -> Result<(), WriteError> {
        let unfit =
            |what: String, why: &str| WriteError::Unfit { path: self.path.clone(), what, why: why.into() };
        if !ros::can_be_written(scan.stamp) {
            return Err(unfit(
                format!("the stamp {:?}", scan.stamp),
                "ROS 2 counts seconds from 0 to 2³¹ − 1",
            ));
        }
        let most = (u32::MAX / 12) as usize;
        if scan.points.len().max(scan.no_returns.len()) > most {
            return Err(unfit("a scan".into(), "a PointCloud2 holds at most 2³² bytes"));
        }
        let in_sensor = Header { stamp: scan.stamp, frame: self.sensor_frame.clone() };
        let transform = Transform {
            header: Header { stamp: scan.stamp, frame: MAP_FRAME.into() },
            child: self.sensor_frame.clone(),
            pose: *t_map_sensor,
        };
        self.sequence = self.sequence.wrapping_add(1);
        // The pose first: a program that plays the file knows where the sensor is when the scan comes.
        self.message(self.odometry, scan, &ros::encode_odometry(&transform))?;
        self.message(self.transforms, scan, &ros::encode_transforms(&[transform]))?;
        if !scan.no_returns.is_empty() {
            let channel = match self.no_returns {
                Some(channel) => channel,
                None => {
                    let (schema, topic) = (self.point_schema, self.no_returns_topic.clone());
                    let made = self.mcap.add_channel(schema, &topic, "cdr", &Default::default());
                    let channel = made.map_err(|source| self.failed(source))?;
                    *self.no_returns.insert(channel)
                }
            };
            self.message(channel, scan, &ros::encode_points(&in_sensor, &scan.no_returns))?;
        }
        self.message(self.points, scan, &ros::encode_points(&in_sensor, &scan.points))
    }

    /// Writes the index and ends the file. A writer that is dropped instead does the same but cannot tell of errors.
    pub fn finish(mut self) -> Result<(), WriteError> {
        self.mcap.finish().map_err(|source| WriteError::Mcap { path: self.path.clone(), source })?;
        let path = self.path;
        self.mcap.into_inner().flush().map_err(WriteError::io(&path))
    }

    fn message(&mut self, channel_id: u16, scan: &Scan, data: &[u8]) -> Result<(), WriteError> {
        let time = scan.stamp.0.unsigned_abs() * 1_000;
        let header =
            MessageHeader { channel_id, sequence: self.sequence, log_time: time, publish_time: time };
        self.mcap.write_to_known_channel(&header, data).map_err(|source| self.failed(source))
    }

    fn failed(&self, source: mcap::McapError) -> WriteError {
        WriteError::Mcap { path: self.path.clone(), source }
    }
}

impl<W: Write + Seek> core::fmt::Debug for RecordWriter<W> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let topic = Cow::Borrowed(self.no_returns_topic.trim_end_matches(NO_RETURNS));
        write!(f, "RecordWriter of {topic} into {}", self.path.display())
    }
}
