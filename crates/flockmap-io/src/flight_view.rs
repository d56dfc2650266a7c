//! What people see of the feed of a node: messages that both Foxglove and Rerun show. They go to a file or to an app.

use std::collections::BTreeMap;

use flockmap_feed::{Event, Link, Mirror, SeenScan};
use flockmap_grid::{Pose, RobotId, Stamp, State, Voxel};

use crate::foxglove::{self, point_cloud, point_cloud_schema};
use crate::protobuf::{Field, Kind, Message, ProtoFile, Schema};
use crate::record_scan::{MAP_FRAME, TRANSFORMS};
use crate::record_view::{ColouredPoint, SCAN_COLOUR, Travelled, VIEW_VOXELS_MAX, map_points, robot_colour};
use crate::ros::{self, Header, TFMessage, TransformStamped, encode};

/// Most robots whose ways are drawn, and whose links are written.
const ROBOTS_MAX: usize = 64;
/// Most counters that are written. Names are cut after 64 letters.
const COUNTERS_MAX: usize = 512;
const NAME_LETTERS_MAX: usize = 64;

/// Where messages go.
pub trait ViewSink {
    /// A topic with its type.
    type Channel: Copy;
    /// Why a message cannot be written.
    type Error;

    /// The channel of a topic. Asked for again with the same schema, it is the same one. `encoding` is that of the
    /// messages; a schema has a name, an encoding and its bytes.
    ///
    /// # Errors
    /// There can be no such channel.
    fn channel(
        &mut self,
        topic: &str,
        encoding: &str,
        schema: (&str, &str, &[u8]),
    ) -> Result<Self::Channel, Self::Error>;

    /// Takes a message.
    ///
    /// # Errors
    /// It cannot be written.
    fn message(&mut self, channel: Self::Channel, stamp: Stamp, data: &[u8]) -> Result<(), Self::Error>;
}

/// What is shown beside the map, the ways, the robots, counters and links, which always are.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct ViewOptions {
    /// The map in the colours of the robots that saw it last, in place of those of its height. The mirror must ask
    /// for origins.
    pub origins: bool,
    /// Scans, thinned as the feed has them. The mirror must ask for scans.
    pub scans: bool,
}

/// Makes messages of what a [`Mirror`] took. `docs/flights.md` has the topics.
///
/// Memory: the ways of 64 robots (6 MB), and while the map is drawn 16 bytes for each occupied voxel and pictures of
/// 8 MiB.
#[derive(Debug)]
pub struct FlightView<C> {
    robot: String,
    options: ViewOptions,
    /// The version of the map that was drawn last.
    drawn: u64,
    ways: BTreeMap<RobotId, Travelled>,
    map: C,
    paths: C,
    transforms: C,
    scan: Option<C>,
    /// The names of its fields, once they are known.
    counters: Option<(C, Vec<String>)>,
    links: BTreeMap<RobotId, C>,
}

impl<C: Copy> FlightView<C> {
    /// `robot` names topics and frames.
    ///
    /// # Errors
    /// Of the sink.
    pub fn new<S: ViewSink<Channel = C>>(
        sink: &mut S,
        robot: &str,
        options: ViewOptions,
    ) -> Result<Self, S::Error> {
        let cloud = point_cloud_schema();
        let mut picture =
            |name| sink.channel(&format!("/{robot}/viewer/{name}"), "protobuf", cloud_schema(&cloud));
        let (map, paths) = (picture("map")?, picture("paths")?);
        let scan = if options.scans { Some(picture("scan")?) } else { None };
        let transforms = sink.channel(TRANSFORMS, "cdr", ros_schema(ros::TRANSFORMS))?;
        Ok(Self {
            robot: robot.to_owned(),
            options,
            drawn: 0,
            ways: BTreeMap::new(),
            map,
            paths,
            transforms,
            scan,
            counters: None,
            links: BTreeMap::new(),
        })
    }

    /// Writes what a frame of the feed has brought, but for the map. `now` is the time of the messages.
    ///
    /// # Errors
    /// Of the sink.
    pub fn note<S: ViewSink<Channel = C>>(
        &mut self,
        sink: &mut S,
        mirror: &Mirror,
        event: Event,
        now: Stamp,
    ) -> Result<(), S::Error> {
        match event {
            // Another version of the node may count other things.
            Event::Hello => self.counters = None,
            Event::Poses => self.write_poses(sink, mirror, now)?,
            Event::Counters => self.write_counters(sink, mirror, now)?,
            Event::Links => self.write_links(sink, mirror, now)?,
            Event::Scan => self.write_scan(sink, mirror, now)?,
            _ => {}
        }
        Ok(())
    }

    /// Whether the map is another than the one that was drawn last.
    pub fn is_changed(&self, mirror: &Mirror) -> bool {
        mirror.map().is_some_and(|map| self.drawn != map.version())
    }

    /// The occupied voxels and the ways as they are now, each with its channel. Nothing before the node has said who
    /// it is.
    pub fn picture(&mut self, mirror: &Mirror, now: Stamp) -> Vec<(C, Vec<u8>)> {
        let Some(map) = mirror.map() else { return Vec::new() };
        self.drawn = map.version();
        let origin = |voxel| if self.options.origins { mirror.origin(voxel) } else { None };
        let occupied = map.voxels().filter(|(_, state)| *state == State::Occupied);
        let voxels: Vec<(Voxel, Option<RobotId>)> =
            occupied.map(|(voxel, _)| (voxel, origin(voxel))).collect();
        let points = map_points(map.resolution(), voxels, VIEW_VOXELS_MAX);
        let map = point_cloud(now, MAP_FRAME, &Pose::IDENTITY, &points);
        let paths: Vec<ColouredPoint> = self
            .ways
            .iter()
            .flat_map(|(robot, way)| way.points().into_iter().map(|(at, _)| (at, robot_colour(*robot))))
            .collect();
        let paths = point_cloud(now, MAP_FRAME, &Pose::IDENTITY, &paths);
        vec![(self.map, map), (self.paths, paths)]
    }

    /// The place of each robot as a frame of its own.
    fn write_poses<S: ViewSink<Channel = C>>(
        &mut self,
        sink: &mut S,
        mirror: &Mirror,
        now: Stamp,
    ) -> Result<(), S::Error> {
        let own = mirror.node().map(|node| node.robot);
        let name = &self.robot;
        let transforms = mirror.robots().iter().take(ROBOTS_MAX).filter_map(|pose| {
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
        for pose in mirror.robots() {
            let robot = pose.stream.origin;
            if self.ways.contains_key(&robot) || self.ways.len() < ROBOTS_MAX {
                self.ways.entry(robot).or_default().push(pose.position);
            }
        }
        sink.message(self.transforms, now, &message)
    }

    fn write_counters<S: ViewSink<Channel = C>>(
        &mut self,
        sink: &mut S,
        mirror: &Mirror,
        now: Stamp,
    ) -> Result<(), S::Error> {
        let counts = &mirror.counts().counters;
        let (channel, names) = match &self.counters {
            Some(known) => known,
            None => {
                let names: Vec<String> =
                    counts.iter().take(COUNTERS_MAX).map(|(name, _)| field_name(name)).collect();
                let fields: Vec<Field<'_>> =
                    (1..).zip(&names).map(|(number, name)| (name.as_str(), number, Kind::Double)).collect();
                let schema = numbers_schema("Counters", &fields);
                let schema = ("flockmap.Counters", "protobuf", &schema[..]);
                let channel = sink.channel(&format!("/{}/counters", self.robot), "protobuf", schema)?;
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
        sink.message(*channel, now, &message.into_bytes())
    }

    fn write_links<S: ViewSink<Channel = C>>(
        &mut self,
        sink: &mut S,
        mirror: &Mirror,
        now: Stamp,
    ) -> Result<(), S::Error> {
        for link in mirror.links() {
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
                    let channel = sink.channel(&topic, "protobuf", schema)?;
                    self.links.insert(robot, channel);
                    channel
                }
            };
            let mut message = Message::default();
            (1..).zip(numbers_of(link)).for_each(|(number, (_, value))| message.double(number, value));
            sink.message(channel, now, &message.into_bytes())?;
        }
        Ok(())
    }

    fn write_scan<S: ViewSink<Channel = C>>(
        &self,
        sink: &mut S,
        mirror: &Mirror,
        now: Stamp,
    ) -> Result<(), S::Error> {
        let (Some(channel), Some(scan)) = (self.scan, mirror.scan()) else { return Ok(()) };
        let SeenScan { position, orientation, points, .. } = scan;
        // What the feed says of a pose may be no turn.
        let Some(t_map_sensor) = Pose::new(*position, *orientation) else { return Ok(()) };
        let points: Vec<ColouredPoint> = points.iter().map(|point| (*point, SCAN_COLOUR)).collect();
        sink.message(channel, now, &point_cloud(now, MAP_FRAME, &t_map_sensor, &points))
    }
}

fn cloud_schema(bytes: &[u8]) -> (&str, &str, &[u8]) {
    (foxglove::POINT_CLOUD, "protobuf", bytes)
}

pub(crate) fn ros_schema(name: &'static str) -> (&'static str, &'static str, &'static [u8]) {
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
