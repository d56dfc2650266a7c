//! What a node sees and sends, recorded while it flies.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use flockmap_feed::{Event, FRAME_BYTES_MAX, Link, Mirror, MirrorOptions, Splitter};
use flockmap_grid::{Pose, RobotId, Scan, Stamp, State, Voxel};

use crate::error::WriteError;
use crate::flight_file::{ChannelId, FlightFile};
use crate::foxglove::{self, point_cloud, point_cloud_schema};
use crate::protobuf::{Field, Kind, Message, ProtoFile, Schema};
use crate::record_scan::{MAP_FRAME, TRANSFORMS, check_stamp, scan_messages};
use crate::record_view::{ColouredPoint, Travelled, VIEW_VOXELS_MAX, ViewSchedule, map_points, robot_colour};
use crate::ros::{self, Header, TFMessage, TransformStamped, encode};

/// Schema of the messages that hold the feed.
pub(crate) const FEED_SCHEMA: &str = "flockmap.FeedFrame";
/// In such a message, the field with the frame.
pub(crate) const FEED_FIELD: u32 = 1;

/// Most robots whose ways are drawn, and whose links are recorded.
const ROBOTS_MAX: usize = 64;
/// Most counters that are recorded. Names are cut after 64 letters.
const COUNTERS_MAX: usize = 512;
const NAME_LETTERS_MAX: usize = 64;

/// What is recorded.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct FlightOptions {
    /// Whether scans are: as [`RecordWriter`](crate::RecordWriter) has them, and a part of them in the feed.
    pub scans: bool,
    /// Whether it is asked who saw each voxel last: the feed has it then, and the map is drawn in the colours of the
    /// robots. The node pays for that.
    pub origins: bool,
    /// The map is drawn so often at most, for people. Zero: never.
    pub picture_period: Duration,
    /// Bytes that the file may have.
    pub bytes_max: u64,
}

impl Default for FlightOptions {
    /// No scans, no origins, a picture each 2 s, 2 GiB.
    fn default() -> Self {
        Self { scans: false, origins: false, picture_period: Duration::from_secs(2), bytes_max: 2 << 30 }
    }
}

/// Writes a flight as an MCAP file: the feed of the node as it comes, for [`open_flight`](crate::open_flight), and
/// for people what Foxglove and Rerun both show. `docs/flights.md` has the topics. Reads the feed as any reader does:
/// [`Self::hello`] goes to the node, and what comes from it is [pushed](Self::push).
///
/// A map that has no room in a mirror (2²⁰ blocks) is not drawn any more, nor is what stands beside it; its feed is
/// recorded all the same.
///
/// Memory: a [`Mirror`] of the map, a chunk of 1 MiB and a message, a picture of 8 MiB while it is drawn and 16 bytes
/// for each occupied voxel, the ways of 64 robots (6 MB), and 1 kB for each chunk of the file, which is 3.6 MB an hour.
pub struct FlightRecorder {
    file: FlightFile,
    robot: String,
    options: FlightOptions,
    splitter: Splitter,
    mirror: Mirror,
    /// Nothing is drawn any more: the mirror has no room.
    is_blind: bool,
    schedule: ViewSchedule,
    /// Of the picture that was drawn last.
    drawn: u64,
    ways: BTreeMap<RobotId, Travelled>,
    feed: ChannelId,
    map: ChannelId,
    paths: ChannelId,
    transforms: ChannelId,
    /// The names of its fields, once they are known.
    counters: Option<(ChannelId, Vec<String>)>,
    links: BTreeMap<RobotId, ChannelId>,
}

impl FlightRecorder {
    /// Makes a file; if there is one of that name, the new one gets a number: `flight-2.mcap`. `robot` names topics
    /// and frames.
    ///
    /// # Errors
    /// The file cannot be made.
    pub fn create(path: impl AsRef<Path>, robot: &str, options: FlightOptions) -> Result<Self, WriteError> {
        let mut file = FlightFile::create(path.as_ref(), options.bytes_max)?;
        let frame = ProtoFile::new("flockmap/feed_frame.proto", "flockmap", &[])
            .message("FeedFrame", &[("frame", FEED_FIELD, Kind::Bytes)]);
        let frame = Schema::default().file(frame).into_bytes();
        let cloud = point_cloud_schema();
        let cloud = (foxglove::POINT_CLOUD, "protobuf", &cloud[..]);
        let feed = file.channel(&format!("/{robot}/feed"), "protobuf", (FEED_SCHEMA, "protobuf", &frame))?;
        let map = file.channel(&format!("/{robot}/viewer/map"), "protobuf", cloud)?;
        let paths = file.channel(&format!("/{robot}/viewer/paths"), "protobuf", cloud)?;
        let transforms = file.channel(TRANSFORMS, "cdr", ros_schema(ros::TRANSFORMS))?;
        let mirror = MirrorOptions {
            origins: options.origins,
            links: true,
            scans: options.scans,
            ..Default::default()
        };
        Ok(Self {
            file,
            robot: robot.to_owned(),
            options,
            splitter: Splitter::new(FRAME_BYTES_MAX),
            mirror: Mirror::new(mirror),
            is_blind: false,
            schedule: ViewSchedule::new(options.picture_period),
            drawn: 0,
            ways: BTreeMap::new(),
            feed,
            map,
            paths,
            transforms,
            counters: None,
            links: BTreeMap::new(),
        })
    }

    /// Where it is written.
    pub fn path(&self) -> &Path {
        self.file.path()
    }

    /// Bytes that are safe from the end of the program, and of the power.
    pub const fn bytes(&self) -> u64 {
        self.file.bytes()
    }

    /// What to send to the node first, and all there is to send.
    pub fn hello(&mut self) -> Vec<u8> {
        self.splitter = Splitter::new(FRAME_BYTES_MAX);
        self.mirror.connect()
    }

    /// Records what the node sent, cut anywhere. `now` is the time on its clock.
    ///
    /// # Errors
    /// [`WriteError::Full`]: the file has reached its size; [finish](Self::finish) it. Any other: it cannot be
    /// written; [abandon](Self::abandon) it. What is no feed is an error too.
    pub fn push(&mut self, now: Stamp, mut bytes: &[u8]) -> Result<(), WriteError> {
        loop {
            let unfit = |error| WriteError::unfit(self.file.path(), "a frame of the feed", error);
            let frame = match self.splitter.next(&mut bytes).map_err(|e| unfit(e.to_string()))? {
                None => return Ok(()),
                Some((kind, body)) => {
                    let length = (body.len() + 1) as u32;
                    [&length.to_le_bytes()[..], &[kind], body].concat()
                }
            };
            self.write_frame(now, &frame)?;
            if self.is_blind {
                continue;
            }
            match self.mirror.push(&mut &frame[..]) {
                Ok(Some(Event::Poses)) => self.write_poses(now)?,
                Ok(Some(Event::Counters)) => self.write_counters(now)?,
                Ok(Some(Event::Links)) => self.write_links(now)?,
                Ok(_) => {}
                // The feed goes on to be recorded.
                Err(_) => self.is_blind = true,
            }
            if self.schedule.is_due(now) {
                self.draw(now)?;
            }
        }
    }

    /// Records a scan and `T_map_sensor` at its time.
    ///
    /// # Errors
    /// As of [`Self::push`]. A stamp that ROS 2 has no time for.
    pub fn write_scan(&mut self, scan: &Scan, t_map_sensor: &Pose) -> Result<(), WriteError> {
        check_stamp(self.file.path(), scan.stamp)?;
        let path = self.path().to_owned();
        let file = &mut self.file;
        scan_messages(&path, &self.robot, scan, t_map_sensor, |topic, schema, data| {
            let channel = file.channel(topic, "cdr", ros_schema(schema))?;
            file.message(channel, scan.stamp, data)
        })?;
        self.schedule.scan_written(12 * (scan.points.len() + scan.no_returns.len()));
        Ok(())
    }

    /// Makes what was recorded safe from the end of the program, and of the power. To be called about once a second.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn flush(&mut self) -> Result<(), WriteError> {
        self.file.flush()
    }

    /// Draws the map as it is at the end, writes the index and ends the file.
    ///
    /// # Errors
    /// It cannot be written; it ends behind what was flushed last.
    pub fn finish(mut self, now: Stamp) -> Result<(), WriteError> {
        if !self.options.picture_period.is_zero()
            && let Err(error) = self.draw(now)
        {
            self.file.abandon();
            return Err(error);
        }
        self.file.finish()
    }

    /// Ends the file behind what was flushed last, after an error.
    pub fn abandon(self) {
        self.file.abandon();
    }

    fn write_frame(&mut self, now: Stamp, frame: &[u8]) -> Result<(), WriteError> {
        let mut message = Message::default();
        message.bytes(FEED_FIELD, frame);
        self.file.message(self.feed, now, &message.into_bytes())?;
        self.schedule.scan_written(frame.len());
        Ok(())
    }

    /// The place of each robot as a frame of its own.
    fn write_poses(&mut self, now: Stamp) -> Result<(), WriteError> {
        let own = self.mirror.node().map(|node| node.robot);
        let name = &self.robot;
        let transforms = self.mirror.robots().iter().take(ROBOTS_MAX).filter_map(|pose| {
            let robot = pose.stream.origin;
            let age = i64::try_from(pose.age.as_micros()).unwrap_or(i64::MAX);
            // How the others are turned is not known.
            let turned = pose.orientation.unwrap_or([0.0, 0.0, 0.0, 1.0]);
            Some(TransformStamped {
                header: Header::new(Stamp(now.0.saturating_sub(age).max(0)), MAP_FRAME),
                child_frame_id: if own == Some(robot) {
                    name.clone()
                } else {
                    format!("{name}/robot{robot}")
                },
                transform: Pose::new(pose.position, turned)?.into(),
            })
        });
        let message = encode(&TFMessage { transforms: transforms.collect() });
        for pose in self.mirror.robots() {
            let robot = pose.stream.origin;
            if self.ways.contains_key(&robot) || self.ways.len() < ROBOTS_MAX {
                self.ways.entry(robot).or_default().push(pose.position);
            }
        }
        self.file.message(self.transforms, now, &message)
    }

    fn write_counters(&mut self, now: Stamp) -> Result<(), WriteError> {
        let counts = &self.mirror.counts().counters;
        let (channel, names) = match &self.counters {
            Some(known) => known,
            None => {
                let names: Vec<String> =
                    counts.iter().take(COUNTERS_MAX).map(|(name, _)| field_name(name)).collect();
                let fields: Vec<Field<'_>> =
                    (1..).zip(&names).map(|(number, name)| (name.as_str(), number, Kind::Double)).collect();
                let schema = numbers_schema("Counters", &fields);
                let schema = ("flockmap.Counters", "protobuf", &schema[..]);
                let channel = self.file.channel(&format!("/{}/counters", self.robot), "protobuf", schema)?;
                self.counters.insert((channel, names))
            }
        };
        let mut message = Message::default();
        // They are the same ones in the same order for as long as the node runs.
        for ((number, name), (counter, value)) in (1..).zip(names).zip(counts) {
            if *name == field_name(counter) {
                message.double(number, *value as f64);
            }
        }
        self.file.message(*channel, now, &message.into_bytes())
    }

    fn write_links(&mut self, now: Stamp) -> Result<(), WriteError> {
        for link in self.mirror.links() {
            let robot = link.stream.origin;
            let channel = match self.links.get(&robot) {
                Some(channel) => *channel,
                None if self.links.len() >= ROBOTS_MAX => continue,
                None => {
                    let names = (1..).zip(numbers_of(link));
                    let fields: Vec<Field<'_>> =
                        names.map(|(number, (name, _))| (name, number, Kind::Double)).collect();
                    let schema = numbers_schema("Link", &fields);
                    let schema = ("flockmap.Link", "protobuf", &schema[..]);
                    let topic = format!("/{}/links/robot{robot}", self.robot);
                    let channel = self.file.channel(&topic, "protobuf", schema)?;
                    self.links.insert(robot, channel);
                    channel
                }
            };
            let mut message = Message::default();
            (1..).zip(numbers_of(link)).for_each(|(number, (_, value))| message.double(number, value));
            self.file.message(channel, now, &message.into_bytes())?;
        }
        Ok(())
    }

    /// Draws the occupied voxels and the ways, if the map is another than the one drawn last.
    fn draw(&mut self, now: Stamp) -> Result<(), WriteError> {
        let Some(map) = self.mirror.map().filter(|map| map.version() != self.drawn) else { return Ok(()) };
        self.drawn = map.version();
        let origin = |voxel| if self.options.origins { self.mirror.origin(voxel) } else { None };
        let occupied = map.voxels().filter(|(_, state)| *state == State::Occupied);
        let voxels: Vec<(Voxel, Option<RobotId>)> =
            occupied.map(|(voxel, _)| (voxel, origin(voxel))).collect();
        let map = point_cloud(now, MAP_FRAME, &map_points(map.resolution(), voxels, VIEW_VOXELS_MAX));
        let paths: Vec<ColouredPoint> = self
            .ways
            .iter()
            .flat_map(|(robot, way)| way.points().into_iter().map(|(at, _)| (at, robot_colour(*robot))))
            .collect();
        let paths = point_cloud(now, MAP_FRAME, &paths);
        self.schedule.view_written(now, map.len() + paths.len());
        for (channel, picture) in [(self.map, map), (self.paths, paths)] {
            match self.file.message(channel, now, &picture) {
                // What is smaller may still have room.
                Ok(()) | Err(WriteError::Full { .. }) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }
}

impl core::fmt::Debug for FlightRecorder {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "FlightRecorder of {} into {}", self.robot, self.path().display())
    }
}

fn ros_schema(name: &'static str) -> (&'static str, &'static str, &'static [u8]) {
    (name, "ros2msg", ros::definition(name).as_bytes())
}

fn numbers_schema(name: &str, fields: &[Field<'_>]) -> Vec<u8> {
    let file = ProtoFile::new(&format!("flockmap/{name}.proto"), "flockmap", &[]);
    Schema::default().file(file.message(name, fields)).into_bytes()
}

/// A name that protobuf allows.
fn field_name(name: &str) -> String {
    let letter = |c: char| if c.is_ascii_alphanumeric() { c } else { '_' };
    name.chars().take(NAME_LETTERS_MAX).map(letter).collect()
}

fn numbers_of(link: &Link) -> [(&'static str, f64); 8] {
    [
        ("hears_us", f64::from(u8::from(link.hears_us))),
        ("round_trip_s", link.round_trip.unwrap_or_default().as_secs_f64()),
        ("loss", f64::from(link.loss) / 65_536.0),
        ("bytes_in", link.bytes_in as f64),
        ("bytes_out", link.bytes_out as f64),
        ("missing", f64::from(link.missing)),
        ("unconfirmed", f64::from(link.unconfirmed)),
        ("silence_s", link.silence.as_secs_f64()),
    ]
}
