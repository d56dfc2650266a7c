//! Records in MCAP files: once through for poses and stamps; the scans come from a second pass, when they are asked for.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use flockmap_grid::{Pose, Stamp};

use crate::error::{Fault, Place, ReadError};
use crate::mcap_file::{Channel, McapReader, Message};
use crate::mcap_frames::{Entry, McapFrames};
use crate::record::{Frames, Record, RecordOptions, RecordSummary, name_of};
use crate::ros;
use crate::track::{FrameTree, Reach, Track};

/// Most poses, and most scans of a topic, that are kept.
const ENTRIES_MAX: usize = 1 << 22;
/// Most scans that may have to wait for an earlier one that lies behind them in the file.
const WAITING_MAX: usize = 256;
/// Most frames that the scans of one topic may be in.
const CLOUD_FRAMES_MAX: usize = 64;
/// Most damages that are told apart.
pub(crate) const DAMAGES_MAX: usize = 16;
/// A pose this near in time is taken as it is, in microseconds.
const NEAR_MICROS: i64 = 10_000;
/// Ending of the topic of rays that came back with nothing, beside the topic of the points.
pub(crate) const NO_RETURNS: &str = "/no_returns";

/// What one pass through an MCAP file tells.
#[derive(Default)]
pub(crate) struct McapIndex {
    /// Each channel with the number of its messages, and whether it is one we could read.
    pub(crate) channels: BTreeMap<Channel, u64>,
    clouds: BTreeMap<String, CloudTopic>,
    odometries: BTreeMap<String, OdometryTopic>,
    transforms: FrameTree,
    poses: usize,
    pub(crate) damages: Vec<ReadError>,
}

#[derive(Default)]
struct CloudTopic {
    frames: Vec<String>,
    /// One for each message: its stamp and the number of its frame in `frames`; `None` if it cannot be read.
    scans: Vec<Option<(Stamp, u16)>>,
    points: u64,
}

struct OdometryTopic {
    parent: String,
    child: String,
    track: Track,
}

pub(crate) fn index(path: &Path, chunk_bytes_max: u64) -> Result<McapIndex, ReadError> {
    let mut index = McapIndex::default();
    let mut reader = McapReader::open(path, chunk_bytes_max).map_err(|fault| fault.in_file(path))?;
    while let Some(message) = reader.next_message() {
        let taken = message.and_then(|message| index.take(&message));
        match taken {
            Ok(()) => {}
            Err(fault @ Fault { problem: crate::Problem::TooLarge { .. }, place: Place::Whole }) => {
                return Err(fault.in_file(path));
            }
            Err(fault) => {
                if index.damages.len() < DAMAGES_MAX {
                    index.damages.push(fault.in_file(path));
                }
            }
        }
    }
    for odometry in index.odometries.values_mut() {
        odometry.track.sort();
    }
    index.transforms.sort();
    Ok(index)
}

impl McapIndex {
    fn take(&mut self, message: &Message<'_>) -> Result<(), Fault> {
        let channel = &*message.channel;
        let number = match self.channels.get_mut(channel) {
            Some(count) => {
                *count += 1;
                *count
            }
            None => {
                self.channels.insert(channel.clone(), 1);
                1
            }
        };
        if channel.encoding != "cdr" {
            return Ok(());
        }
        let in_message = |fault: Fault| fault.in_message(&channel.topic, number);
        match channel.schema.as_str() {
            ros::POINT_CLOUD => {
                let topic = entry(&mut self.clouds, &channel.topic);
                limit("the number of scans", topic.scans.len())?;
                topic.scans.push(None);
                let cloud = ros::CloudHeader::decode(message.data).map_err(in_message)?;
                topic.points = topic.points.saturating_add(cloud.points);
                let frame = topic.frames.iter().position(|f| *f == cloud.header.frame);
                let frame = match frame {
                    Some(frame) => frame,
                    None if topic.frames.len() >= CLOUD_FRAMES_MAX => {
                        let expected = format!("scans in at most {CLOUD_FRAMES_MAX} frames");
                        return Err(in_message(Fault::damaged(Place::Whole, expected, "one more")));
                    }
                    None => {
                        topic.frames.push(cloud.header.frame);
                        topic.frames.len() - 1
                    }
                };
                if let Some(scan) = topic.scans.last_mut() {
                    *scan = Some((cloud.header.stamp, frame as u16));
                }
            }
            ros::ODOMETRY => {
                limit("the number of poses", self.poses)?;
                let odometry = ros::decode_odometry(message.data).map_err(in_message)?;
                self.poses += 1;
                if !self.odometries.contains_key(&channel.topic) {
                    let topic = OdometryTopic {
                        parent: odometry.header.frame,
                        child: odometry.child,
                        track: Track::default(),
                    };
                    self.odometries.insert(channel.topic.clone(), topic);
                }
                if let Some(topic) = self.odometries.get_mut(&channel.topic) {
                    topic.track.push(odometry.header.stamp, odometry.pose);
                }
            }
            ros::TRANSFORMS => {
                limit("the number of poses", self.poses + self.transforms.poses())?;
                let fixed = channel.topic.ends_with("tf_static");
                for t in ros::decode_transforms(message.data).map_err(in_message)? {
                    self.transforms.push(t.header.frame, t.child, t.header.stamp, t.pose, fixed);
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// The topics of the file in words, for messages.
    fn topics(&self) -> String {
        let mut topics: Vec<String> = self
            .channels
            .keys()
            .take(20)
            .map(|c| format!("{} ({}, encoding {})", c.topic, c.schema, c.encoding))
            .collect();
        if topics.is_empty() {
            topics.push("no message".into());
        }
        topics.join(", ")
    }

    /// Of several topics, those in a frame that moves: what lies in the frame of the map is a map, or a picture for viewers.
    /// A single one may be in the map: scans that were taken there beforehand.
    fn only_scans<'a>(&self, clouds: Vec<(&'a String, &'a CloudTopic)>) -> Vec<(&'a String, &'a CloudTopic)> {
        let moves = |frame: &String| {
            !self.transforms.ancestors(frame).is_empty()
                || self.odometries.values().any(|o| o.child == *frame)
        };
        let in_sensor: Vec<_> =
            clouds.iter().filter(|(_, cloud)| cloud.frames.iter().any(moves)).copied().collect();
        if clouds.len() > 1 && !in_sensor.is_empty() { in_sensor } else { clouds }
    }

    fn choose_cloud(&self, options: &RecordOptions) -> Result<(&str, &CloudTopic), Fault> {
        let is_no_returns = |topic: &str| {
            topic.strip_suffix(NO_RETURNS).is_some_and(|base| {
                self.clouds.keys().any(|other| other != topic && other.starts_with(&format!("{base}/")))
            })
        };
        let chosen: Vec<(&String, &CloudTopic)> = match &options.points_topic {
            Some(topic) => self.clouds.get_key_value(topic).into_iter().collect(),
            None => self.only_scans(self.clouds.iter().filter(|(topic, _)| !is_no_returns(topic)).collect()),
        };
        match chosen.as_slice() {
            [(topic, cloud)] => Ok((topic, cloud)),
            [] => {
                let wanted =
                    |c: &&Channel| options.points_topic.as_ref().is_none_or(|topic| *topic == c.topic);
                let foreign = self.channels.keys().filter(wanted).find(|c| {
                    c.encoding != "cdr"
                        && (c.schema == ros::POINT_CLOUD || c.schema == "sensor_msgs/PointCloud2")
                });
                if let Some(channel) = foreign {
                    return Err(ros::wrong_encoding(&channel.topic, &channel.schema, &channel.encoding));
                }
                let expected = match &options.points_topic {
                    Some(topic) => {
                        format!("scans on the topic {topic} ({} in the encoding \"cdr\")", ros::POINT_CLOUD)
                    }
                    None => format!("a topic with {} in the encoding \"cdr\"", ros::POINT_CLOUD),
                };
                Err(Fault::foreign(Place::Whole, expected, self.topics()))
            }
            several => {
                let names: Vec<&str> = several.iter().map(|(topic, _)| topic.as_str()).collect();
                Err(Fault::foreign(
                    Place::Whole,
                    "one topic of scans, or the name of the one to take",
                    names.join(", "),
                ))
            }
        }
    }

    /// Where the poses of scans in `frame` come from.
    fn choose_poses<'a>(
        &'a self,
        frame: &'a str,
        options: &'a RecordOptions,
    ) -> Result<PoseSource<'a>, Fault> {
        let above = self.transforms.ancestors(frame);
        let fits_map = |o: &OdometryTopic| options.map_frame.as_ref().is_none_or(|map| *map == o.parent);
        let candidates: Vec<(&String, &OdometryTopic)> = self
            .odometries
            .iter()
            .filter(|(topic, o)| {
                options.odometry_topic.as_ref().map_or_else(|| fits_map(o), |wanted| wanted == *topic)
            })
            .collect();
        if let Some(topic) = &options.odometry_topic
            && candidates.is_empty()
        {
            let expected = format!("{} on the topic {topic}", ros::ODOMETRY);
            return Err(Fault::foreign(Place::Whole, expected, self.topics()));
        }
        type Fits = fn(&OdometryTopic, &str, &[&str]) -> bool;
        // In this order: the sensor itself, a frame that the sensor is fixed to, and points that are already in the map.
        let ways: [Fits; 3] = [
            |o, frame, _| o.child == frame || o.child.is_empty(),
            |o, _, above| above.contains(&o.child.as_str()),
            |o, frame, _| o.parent == frame,
        ];
        for (way, fits) in ways.into_iter().enumerate() {
            let found: Vec<_> = candidates.iter().filter(|(_, o)| fits(o, frame, &above)).collect();
            match found.as_slice() {
                [] => {}
                [(topic, odometry)] => {
                    return Ok(PoseSource::Odometry { topic, odometry, frame, registered: way == 2 });
                }
                several => {
                    let names: Vec<&str> = several.iter().map(|(topic, _)| topic.as_str()).collect();
                    return Err(Fault::foreign(
                        Place::Whole,
                        "one topic of odometry for the scans, or the name of the one to take",
                        names.join(", "),
                    ));
                }
            }
        }
        let map = match &options.map_frame {
            Some(map) => above.iter().find(|f| *f == map).copied(),
            None => above.last().copied(),
        };
        if let Some(map) = map
            && options.odometry_topic.is_none()
        {
            return Ok(PoseSource::Transforms { map, frame });
        }
        let mut links: Vec<String> = self
            .odometries
            .iter()
            .map(|(topic, o)| format!("{} → {} ({topic})", o.parent, o.child))
            .collect();
        links.extend(self.transforms.links().into_iter().take(16).map(|link| format!("{link} (tf)")));
        if links.is_empty() {
            links.push("no odometry and no tf".into());
        }
        let to = options.map_frame.as_ref().map(|map| format!(" to \"{map}\"")).unwrap_or_default();
        Err(Fault::foreign(
            Place::Whole,
            format!("odometry or tf that leads from the frame of the scans, \"{frame}\",{to} to a map"),
            links.join(", "),
        ))
    }
}

fn entry<'a, V: Default>(map: &'a mut BTreeMap<String, V>, key: &str) -> &'a mut V {
    if !map.contains_key(key) {
        map.insert(key.to_owned(), V::default());
    }
    map.entry(key.to_owned()).or_default()
}

fn limit(what: &'static str, held: usize) -> Result<(), Fault> {
    if held >= ENTRIES_MAX {
        return Err(Fault::too_large(Place::Whole, what, held as u64 + 1, ENTRIES_MAX as u64));
    }
    Ok(())
}

enum PoseSource<'a> {
    Odometry { topic: &'a str, odometry: &'a OdometryTopic, frame: &'a str, registered: bool },
    Transforms { map: &'a str, frame: &'a str },
}

impl PoseSource<'_> {
    fn pose(&self, index: &McapIndex, stamp: Stamp, reach: Reach) -> Option<Pose> {
        match self {
            Self::Odometry { odometry, frame, registered, .. } => {
                let t_map_child = odometry.track.at(stamp, reach)?;
                if *registered || odometry.child == *frame || odometry.child.is_empty() {
                    return Some(t_map_child);
                }
                let t_child_sensor = index.transforms.pose(&odometry.child, frame, stamp, reach)?;
                Some(t_map_child.compose(&t_child_sensor))
            }
            Self::Transforms { map, frame } => index.transforms.pose(map, frame, stamp, reach),
        }
    }

    const fn registered(&self) -> bool {
        matches!(self, Self::Odometry { registered: true, .. })
    }

    fn describe(&self) -> String {
        match self {
            Self::Odometry { topic, odometry, frame, registered } => {
                let parent = &odometry.parent;
                if *registered {
                    format!("odometry {topic}, points taken back from \"{parent}\"")
                } else if odometry.child == *frame || odometry.child.is_empty() {
                    format!("odometry {topic}: \"{parent}\" → \"{frame}\"")
                } else {
                    format!("odometry {topic} and tf: \"{parent}\" → \"{}\" → \"{frame}\"", odometry.child)
                }
            }
            Self::Transforms { map, frame } => format!("tf: \"{map}\" → \"{frame}\""),
        }
    }
}

pub(crate) fn open(path: &Path, options: &RecordOptions) -> Result<Record, ReadError> {
    let index = index(path, options.chunk_bytes_max)?;
    plan(path, options, index).map_err(|fault| fault.in_file(path))
}

/// The record that an index makes possible, or why there is none.
pub(crate) fn plan(path: &Path, options: &RecordOptions, index: McapIndex) -> Result<Record, Fault> {
    let (topic, cloud) = match index.choose_cloud(options) {
        Ok(chosen) => chosen,
        // Where nothing could be read at all, the damage is the better answer.
        Err(fault) => match index.damages.first() {
            Some(damage) if index.clouds.is_empty() => {
                return Err(Fault { place: damage.place.clone(), problem: damage.problem.clone() });
            }
            _ => return Err(fault),
        },
    };
    let reach = Reach { gap_max: (options.pose_gap_max_s * 1e6) as i64, near: NEAR_MICROS };
    let mut sources = Vec::new();
    for frame in &cloud.frames {
        sources.push(index.choose_poses(frame, options)?);
    }
    let mut entries: Vec<Entry> = Vec::with_capacity(cloud.scans.len());
    let mut order: Vec<u32> = Vec::new();
    for (i, scan) in cloud.scans.iter().enumerate() {
        let mut entry =
            Entry { stamp: Stamp::default(), rank: None, pose: Pose::IDENTITY, registered: false };
        if let Some((stamp, frame)) = *scan {
            entry.stamp = stamp;
            let source = sources.get(usize::from(frame));
            if let Some((source, pose)) = source.and_then(|s| s.pose(&index, stamp, reach).map(|p| (s, p))) {
                entry.pose = pose;
                entry.registered = source.registered();
                order.push(i as u32);
            }
        }
        entries.push(entry);
    }
    let in_file: Vec<u32> = order.clone();
    order.sort_by_key(|&i| entries.get(i as usize).map(|e| e.stamp));
    let in_order = order.iter().filter_map(|&i| entries.get(i as usize));
    let poses: Vec<(Stamp, Pose)> = in_order.map(|e| (e.stamp, e.pose)).collect();
    let mut summary = RecordSummary::from_poses(&poses);
    for (rank, &i) in order.iter().enumerate() {
        if let Some(entry) = entries.get_mut(i as usize) {
            entry.rank = Some(rank as u32);
        }
    }
    // How many scans lie in the file before one that comes before them in time.
    let mut waiting = BTreeSet::new();
    let mut next = 0;
    for &i in &in_file {
        waiting.extend(entries.get(i as usize).and_then(|e| e.rank));
        while waiting.remove(&next) {
            next += 1;
        }
        if waiting.len() > WAITING_MAX {
            let what = "the number of scans that lie out of order in the file";
            return Err(Fault::too_large(Place::Whole, what, waiting.len() as u64, WAITING_MAX as u64));
        }
    }
    let described: BTreeSet<String> = sources.iter().map(PoseSource::describe).collect();
    summary.scans = cloud.scans.len() as u64;
    summary.scans_without_pose = cloud.scans.iter().flatten().count() as u64 - summary.frames;
    summary.points = Some(cloud.points);
    summary.poses_from = described.into_iter().collect::<Vec<_>>().join("; ");
    summary.damages.clone_from(&index.damages);
    let no_returns =
        topic.rfind('/').map(|at| format!("{}{NO_RETURNS}", topic.get(..at).unwrap_or_default()));
    let no_returns = no_returns.filter(|t| t != topic && index.clouds.contains_key(t));
    let frames = McapFrames::new(path, options, topic, no_returns, entries, index.damages.clone());
    Ok(Record { name: name_of(path), summary, poses, frames: Frames::new(frames) })
}
