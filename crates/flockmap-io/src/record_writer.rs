//! Writing a record as an MCAP file that other programs read too.

use std::fs::File;
use std::io::{BufWriter, Seek, Write};
use std::path::{Path, PathBuf};

use flockmap_grid::{Pose, Resolution, Scan, Stamp, Voxel};
use mcap::records::MessageHeader;

use crate::error::WriteError;
use crate::record_view::{ColouredPoint, Travelled, VIEW_VOXELS_MAX, ViewSchedule, map_points};
use crate::ros::{
    self, Header, Odometry, PoseWithCovariance, TFMessage, TransformStamped, cloud_of_coloured_points,
    cloud_of_points, encode,
};

/// Writes what a robot saw as an MCAP file of ROS 2 messages: `/NAME/points` (`sensor_msgs/msg/PointCloud2`,
/// x y z as `f32`, in the frame `NAME/lidar`), `/NAME/odometry` (`nav_msgs/msg/Odometry`, `map` →
/// `NAME/lidar`), `/tf`, and `/NAME/no_returns` for the rays that came back with nothing, if there are any.
/// [`Self::write_view`] adds pictures for people: `/NAME/viewer/map` and `/NAME/viewer/path`, coloured
/// PointCloud2 in the frame `map`.
///
/// [`crate::open_record`] reads it back bit for bit, and so do ROS 2, Foxglove and Rerun. The same input
/// gives the same bytes on any machine. Memory: one chunk of about 1 MiB, one scan or one picture (4 MiB),
/// and 16 bytes a message for the index.
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
    robot: String,
    sensor_frame: String,
    /// Schemas of PointCloud2, Odometry and TFMessage.
    schemas: [u16; 3],
    sequence: u32,
    schedule: ViewSchedule,
    travelled: Travelled,
}

const MAP_FRAME: &str = "map";
const POINTS: &str = "/points";
const ODOMETRY: &str = "/odometry";
const TRANSFORMS: &str = "/tf";
const VIEW_MAP: &str = "/viewer/map";
const VIEW_PATH: &str = "/viewer/path";

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
        let make = || {
            let mut mcap = options.create(out)?;
            let mut schema = |name| mcap.add_schema(name, "ros2msg", ros::definition(name).as_bytes());
            let schemas = [schema(ros::POINT_CLOUD)?, schema(ros::ODOMETRY)?, schema(ros::TRANSFORMS)?];
            Ok((mcap, schemas))
        };
        let (mcap, schemas) = make().map_err(WriteError::mcap(&path))?;
        let (robot, sensor_frame) = (robot.to_owned(), format!("{robot}/lidar"));
        let (schedule, travelled) = Default::default();
        let mut writer = Self { path, mcap, robot, sensor_frame, schemas, sequence: 0, schedule, travelled };
        let [cloud, odometry, transforms] = schemas;
        writer.channel(cloud, &writer.topic(POINTS))?;
        writer.channel(odometry, &writer.topic(ODOMETRY))?;
        writer.channel(transforms, TRANSFORMS)?;
        Ok(writer)
    }

    /// Writes a scan and `T_map_sensor` at its time. The stamp must lie between 0 and 2³¹ s, as ROS 2 counts it.
    pub fn write(&mut self, scan: &Scan, t_map_sensor: &Pose) -> Result<(), WriteError> {
        self.check_stamp(scan.stamp)?;
        let most = (u32::MAX / 12) as usize;
        if scan.points.len().max(scan.no_returns.len()) > most {
            let why = "a PointCloud2 holds at most 2³² bytes";
            return Err(WriteError::unfit(&self.path, "a scan", why));
        }
        let in_sensor = Header::new(scan.stamp, &self.sensor_frame);
        let transform = TransformStamped {
            header: Header::new(scan.stamp, MAP_FRAME),
            child_frame_id: self.sensor_frame.clone(),
            transform: (*t_map_sensor).into(),
        };
        // No covariance and no velocity.
        let odometry = Odometry {
            header: transform.header.clone(),
            child_frame_id: self.sensor_frame.clone(),
            pose: PoseWithCovariance { pose: transform.transform, ..Default::default() },
            ..Default::default()
        };
        let transforms = TFMessage { transforms: vec![transform] };
        self.sequence = self.sequence.wrapping_add(1);
        // The pose first: a program that plays the file knows where the sensor is when the scan comes.
        let [cloud, of_odometry, of_transforms] = self.schemas;
        self.message(of_odometry, &self.topic(ODOMETRY), scan.stamp, &encode(&odometry))?;
        self.message(of_transforms, TRANSFORMS, scan.stamp, &encode(&transforms))?;
        for (topic, points) in [(ros::NO_RETURNS, &scan.no_returns), (POINTS, &scan.points)] {
            if topic == POINTS || !points.is_empty() {
                let message = encode(&cloud_of_points(in_sensor.clone(), points));
                self.message(cloud, &self.topic(topic), scan.stamp, &message)?;
            }
        }
        self.schedule.scan_written(12 * (scan.points.len() + scan.no_returns.len()));
        self.travelled.push(t_map_sensor.translation());
        Ok(())
    }

    /// Whether it is time for [`Self::write_view`]: every 2 s, and less often where pictures would take more
    /// bytes than scans.
    pub fn is_view_due(&self, now: Stamp) -> bool {
        self.schedule.is_due(now)
    }

    /// Writes a picture for people who open the file in a viewer: the occupied voxels of the robot's map as
    /// they are now, coloured by height, and the path flown so far. Readers of records pass it over. A map of
    /// more than 262,144 voxels is shown in voxels of twice, four times … the side. Cost: sorting the voxels.
    pub fn write_view(
        &mut self,
        now: Stamp,
        resolution: Resolution,
        occupied: impl IntoIterator<Item = Voxel>,
    ) -> Result<(), WriteError> {
        self.check_stamp(now)?;
        let header = Header::new(now, MAP_FRAME);
        let [cloud, ..] = self.schemas;
        let pictures: [(String, Vec<ColouredPoint>); 2] = [
            (self.topic(VIEW_MAP), map_points(resolution, occupied, VIEW_VOXELS_MAX)),
            (self.topic(VIEW_PATH), self.travelled.points()),
        ];
        // Both channels come before both messages.
        for (topic, _) in &pictures {
            self.channel(cloud, topic)?;
        }
        let mut bytes = 0;
        for (topic, points) in pictures {
            let message = encode(&cloud_of_coloured_points(header.clone(), &points));
            bytes += message.len();
            self.message(cloud, &topic, now, &message)?;
        }
        self.schedule.view_written(now, bytes);
        Ok(())
    }

    /// Writes the index and ends the file. A writer that is dropped instead does the same but cannot report
    /// errors.
    pub fn finish(mut self) -> Result<(), WriteError> {
        self.mcap.finish().map_err(WriteError::mcap(&self.path))?;
        self.mcap.into_inner().flush().map_err(WriteError::io(&self.path))
    }

    fn topic(&self, name: &str) -> String {
        format!("/{}{name}", self.robot)
    }

    /// The channel of a topic, which is made when it is asked for the first time.
    fn channel(&mut self, schema: u16, topic: &str) -> Result<u16, WriteError> {
        let channel = self.mcap.add_channel(schema, topic, "cdr", &Default::default());
        channel.map_err(WriteError::mcap(&self.path))
    }

    fn check_stamp(&self, stamp: Stamp) -> Result<(), WriteError> {
        if (0..1i64 << 31).contains(&stamp.0.div_euclid(1_000_000)) {
            return Ok(());
        }
        let why = "ROS 2 counts seconds from 0 to 2³¹ − 1";
        Err(WriteError::unfit(&self.path, format!("the stamp {stamp:?}"), why))
    }

    fn message(&mut self, schema: u16, topic: &str, stamp: Stamp, data: &[u8]) -> Result<(), WriteError> {
        let channel_id = self.channel(schema, topic)?;
        let time = stamp.0.unsigned_abs() * 1_000;
        let header =
            MessageHeader { channel_id, sequence: self.sequence, log_time: time, publish_time: time };
        self.mcap.write_to_known_channel(&header, data).map_err(WriteError::mcap(&self.path))
    }
}

impl<W: Write + Seek> core::fmt::Debug for RecordWriter<W> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "RecordWriter of {} into {}", self.robot, self.path.display())
    }
}
