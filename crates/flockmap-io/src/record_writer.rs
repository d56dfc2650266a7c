//! Writing a record as an MCAP file that other programs read too.

use std::fs::File;
use std::io::{BufWriter, Seek, Write};
use std::path::{Path, PathBuf};

use flockmap_grid::{Pose, Resolution, Scan, Stamp, Voxel};
use mcap::records::MessageHeader;

use crate::error::WriteError;
use crate::record_scan::{
    MAP_FRAME, ODOMETRY, POINTS, SUBMAPS, TRANSFORMS, check_stamp, scan_messages, submaps_message,
};
use crate::record_view::{ColouredPoint, Travelled, VIEW_VOXELS_MAX, ViewSchedule, map_points};
use crate::ros::{self, Header, cloud_of_coloured_points, encode};

/// Writes what a robot saw as an MCAP file of ROS 2 messages: `/NAME/points` (`sensor_msgs/msg/PointCloud2`,
/// x y z as `f32`, in the frame `NAME/lidar`), `/NAME/odometry` (`nav_msgs/msg/Odometry`, `map` →
/// `NAME/lidar`), `/tf`, and `/NAME/no_returns` for the rays that came back with nothing, if there are any.
/// [`Self::write_view`] adds pictures for people: `/NAME/viewer/map` and `/NAME/viewer/path`, coloured
/// PointCloud2 in the frame `map`. [`Self::write_submaps`] adds `/NAME/submaps`, `geometry_msgs/msg/PoseArray`.
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
    /// Schemas of PointCloud2, Odometry and TFMessage.
    schemas: [u16; 3],
    sequence: u32,
    schedule: ViewSchedule,
    travelled: Travelled,
}

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
        let robot = robot.to_owned();
        let (schedule, travelled) = Default::default();
        let mut writer = Self { path, mcap, robot, schemas, sequence: 0, schedule, travelled };
        let [cloud, odometry, transforms] = schemas;
        writer.channel(cloud, &writer.topic(POINTS))?;
        writer.channel(odometry, &writer.topic(ODOMETRY))?;
        writer.channel(transforms, TRANSFORMS)?;
        Ok(writer)
    }

    /// Writes a scan and `T_map_sensor` at its time. The stamp must lie between 0 and 2³¹ s, as ROS 2 counts it.
    pub fn write(&mut self, scan: &Scan, t_map_sensor: &Pose) -> Result<(), WriteError> {
        check_stamp(&self.path, scan.stamp)?;
        self.sequence = self.sequence.wrapping_add(1);
        let (robot, path) = (self.robot.clone(), self.path.clone());
        scan_messages(&path, &robot, scan, t_map_sensor, |topic, schema, data| {
            let schema = self.schema(schema);
            self.message(schema, topic, scan.stamp, data)
        })?;
        self.schedule.scan_written(12 * (scan.points.len() + scan.no_returns.len()));
        self.travelled.push(t_map_sensor.translation());
        Ok(())
    }

    /// Writes `T_map_submap` of all submaps of the robot, in their order, as they are from now on: before the scan of
    /// the same stamp, wherever that is written. Where there are more than the last time, more begin; at most
    /// [`SubmapId::COUNT`](flockmap_grid::SubmapId::COUNT). Reading them back takes
    /// [`RecordOptions::submaps_topic`](crate::RecordOptions::submaps_topic).
    pub fn write_submaps(&mut self, now: Stamp, t_map_submaps: &[Pose]) -> Result<(), WriteError> {
        let message = submaps_message(&self.path, now, t_map_submaps)?;
        let definition = ros::definition(ros::POSES).as_bytes();
        let schema = self.mcap.add_schema(ros::POSES, "ros2msg", definition);
        let schema = schema.map_err(WriteError::mcap(&self.path))?;
        self.message(schema, &self.topic(SUBMAPS), now, &message)
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
        check_stamp(&self.path, now)?;
        let header = Header::new(now, MAP_FRAME);
        let [cloud, ..] = self.schemas;
        let pictures: [(String, Vec<ColouredPoint>); 2] = [
            (
                self.topic(VIEW_MAP),
                map_points(resolution, occupied.into_iter().map(|v| (v, None)), VIEW_VOXELS_MAX),
            ),
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

    fn schema(&self, name: &str) -> u16 {
        let [cloud, odometry, transforms] = self.schemas;
        match name {
            ros::ODOMETRY => odometry,
            ros::TRANSFORMS => transforms,
            _ => cloud,
        }
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
