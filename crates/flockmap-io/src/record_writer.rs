//! Writing a record as an MCAP file that other programs read too.

use std::fs::File;
use std::io::{BufWriter, Seek, Write};
use std::path::{Path, PathBuf};

use flockmap_grid::{Pose, Resolution, Scan, Stamp, Voxel};
use mcap::records::MessageHeader;

use crate::error::WriteError;
use crate::record_mcap::NO_RETURNS;
use crate::record_view::{ColouredPoint, VIEW_VOXELS_MAX, ViewSchedule, Way, map_points};
use crate::ros::{self, Header, Transform};

/// Writes what a robot saw as an MCAP file of ROS 2 messages: `/NAME/points` (`sensor_msgs/msg/PointCloud2`, x y z as
/// `f32`, in the frame `NAME/lidar`), `/NAME/odometry` (`nav_msgs/msg/Odometry`, `map` → `NAME/lidar`), `/tf`, and
/// `/NAME/no_returns` for the rays that came back with nothing, if there are any. [`Self::write_view`] adds pictures for people:
/// `/NAME/viewer/map` and `/NAME/viewer/way`, coloured PointCloud2 in the frame `map`.
///
/// [`crate::open_record`] reads it back bit for bit, and so do ROS 2, Foxglove and Rerun. The same input gives the same bytes on
/// any machine. Memory: one chunk of about 1 MiB, one scan or one picture (4 MiB), and 16 bytes a message for the index.
///
/// ```
/// use flockmap_grid::{Pose, Resolution, Scan, Stamp, Voxel};
/// use flockmap_io::RecordWriter;
///
/// let file = std::io::Cursor::new(Vec::new());
/// let mut writer = RecordWriter::new(file, "robot1.mcap", "robot1")?;
/// let scan = Scan { stamp: Stamp(100_000), points: vec![[3.0, 0.0, 0.5]], no_returns: Vec::new() };
/// writer.write(&scan, &Pose::IDENTITY)?;
/// if writer.is_view_due(scan.stamp) {
///     let resolution = Resolution::from_metres(0.1).unwrap();
///     writer.write_view(scan.stamp, resolution, [Voxel::new(30, 0, 5)])?;
/// }
/// writer.finish()?;
/// # Ok::<(), flockmap_io::WriteError>(())
/// ```
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
    robot: String,
    /// Channels of map and way, made with the first picture.
    view: Option<[u16; 2]>,
    schedule: ViewSchedule,
    way: Way,
}

const MAP_FRAME: &str = "map";
const VIEW_MAP: &str = "/viewer/map";
const VIEW_WAY: &str = "/viewer/way";

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
            robot: robot.to_owned(),
            view: None,
            schedule: ViewSchedule::default(),
            way: Way::default(),
        })
    }

    /// Writes a scan and `T_map_sensor` at its time. The stamp must lie between 0 and 2³¹ s, as ROS 2 counts it.
    pub fn write(&mut self, scan: &Scan, t_map_sensor: &Pose) -> Result<(), WriteError> {
        self.check_stamp(scan.stamp)?;
        let most = (u32::MAX / 12) as usize;
        if scan.points.len().max(scan.no_returns.len()) > most {
            return Err(self.unfit("a scan".into(), "a PointCloud2 holds at most 2³² bytes"));
        }
        let in_sensor = Header { stamp: scan.stamp, frame: self.sensor_frame.clone() };
        let transform = Transform {
            header: Header { stamp: scan.stamp, frame: MAP_FRAME.into() },
            child: self.sensor_frame.clone(),
            pose: *t_map_sensor,
        };
        self.sequence = self.sequence.wrapping_add(1);
        // The pose first: a program that plays the file knows where the sensor is when the scan comes.
        self.message(self.odometry, scan.stamp, &ros::encode_odometry(&transform))?;
        self.message(self.transforms, scan.stamp, &ros::encode_transforms(&[transform]))?;
        if !scan.no_returns.is_empty() {
            let channel = match self.no_returns {
                Some(channel) => channel,
                None => {
                    let topic = self.no_returns_topic.clone();
                    let made = self.add_cloud_channel(&topic)?;
                    *self.no_returns.insert(made)
                }
            };
            self.message(channel, scan.stamp, &ros::encode_points(&in_sensor, &scan.no_returns))?;
        }
        self.message(self.points, scan.stamp, &ros::encode_points(&in_sensor, &scan.points))?;
        self.schedule.scan_written(12 * (scan.points.len() + scan.no_returns.len()));
        self.way.push(t_map_sensor.translation());
        Ok(())
    }

    /// Whether it is time for [`Self::write_view`]: every 2 s, and less often where pictures would take more bytes than scans.
    pub fn is_view_due(&self, now: Stamp) -> bool {
        self.schedule.is_due(now)
    }

    /// Writes a picture for people who open the file in a viewer: the occupied voxels of the robot's map as they are now, coloured by
    /// height, and the way flown so far. Readers of records pass it over. A map of more than 262,144 voxels is shown in voxels
    /// of twice, four times … the side. Cost: sorting the voxels.
    pub fn write_view(
        &mut self,
        now: Stamp,
        resolution: Resolution,
        occupied: impl IntoIterator<Item = Voxel>,
    ) -> Result<(), WriteError> {
        self.check_stamp(now)?;
        let [map, way] = match self.view {
            Some(channels) => channels,
            None => {
                let map = self.add_cloud_channel(&format!("/{}{VIEW_MAP}", self.robot))?;
                let way = self.add_cloud_channel(&format!("/{}{VIEW_WAY}", self.robot))?;
                *self.view.insert([map, way])
            }
        };
        let header = Header { stamp: now, frame: MAP_FRAME.into() };
        let pictures: [(u16, Vec<ColouredPoint>); 2] =
            [(map, map_points(resolution, occupied, VIEW_VOXELS_MAX)), (way, self.way.points())];
        let mut bytes = 0;
        for (channel, points) in pictures {
            let message = ros::encode_coloured_points(&header, &points);
            bytes += message.len();
            self.message(channel, now, &message)?;
        }
        self.schedule.view_written(now, bytes);
        Ok(())
    }

    /// Writes the index and ends the file. A writer that is dropped instead does the same but cannot tell of errors.
    pub fn finish(mut self) -> Result<(), WriteError> {
        self.mcap.finish().map_err(|source| WriteError::Mcap { path: self.path.clone(), source })?;
        let path = self.path;
        self.mcap.into_inner().flush().map_err(WriteError::io(&path))
    }

    fn add_cloud_channel(&mut self, topic: &str) -> Result<u16, WriteError> {
        let made = self.mcap.add_channel(self.point_schema, topic, "cdr", &Default::default());
        made.map_err(|source| self.failed(source))
    }

    fn check_stamp(&self, stamp: Stamp) -> Result<(), WriteError> {
        if ros::can_be_written(stamp) {
            return Ok(());
        }
        Err(self.unfit(format!("the stamp {stamp:?}"), "ROS 2 counts seconds from 0 to 2³¹ − 1"))
    }

    fn message(&mut self, channel_id: u16, stamp: Stamp, data: &[u8]) -> Result<(), WriteError> {
        let time = stamp.0.unsigned_abs() * 1_000;
        let header =
            MessageHeader { channel_id, sequence: self.sequence, log_time: time, publish_time: time };
        self.mcap.write_to_known_channel(&header, data).map_err(|source| self.failed(source))
    }

    fn unfit(&self, what: String, why: &str) -> WriteError {
        WriteError::Unfit { path: self.path.clone(), what, why: why.into() }
    }

    fn failed(&self, source: mcap::McapError) -> WriteError {
        WriteError::Mcap { path: self.path.clone(), source }
    }
}

impl<W: Write + Seek> core::fmt::Debug for RecordWriter<W> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "RecordWriter of {} into {}", self.robot, self.path.display())
    }
}
