//! Records in MCAP: which topic has the scans, and where their poses come from.

use std::collections::BTreeSet;
use std::path::Path;

use flockmap_grid::{Pose, Stamp};

use crate::error::{Fault, Place, Problem, ReadError, TopicOf};
use crate::file::name_of;
use crate::flight_recorder::FEED_SCHEMA;
use crate::mcap_file::Channel;
use crate::mcap_frames::{Entry, McapFrames};
use crate::mcap_index::{CloudTopic, McapIndex, OdometryTopic};
use crate::mcap_parts::McapParts;
use crate::record::{Frames, Record, RecordOptions, RecordSummary};
use crate::record_submaps::SubmapPoses;
use crate::ros::{self, FrameTree, Reach};

/// Most scans that may have to wait for an earlier one that lies behind them in the file.
const WAITING_MAX: usize = 256;
/// A pose this near in time is taken as it is, in microseconds.
const NEAR_MICROS: i64 = 10_000;

/// Most topics that an error names as those to choose from.
const NAMED_MAX: usize = 64;

/// Opens the record at `path`, which is in these files.
pub(crate) fn open(path: &Path, parts: McapParts, options: &RecordOptions) -> Result<Record, ReadError> {
    let index = McapIndex::read(&parts, options)?;
    plan(path, parts, options, index)
}

/// The record that an index makes possible, or why there is none.
pub(crate) fn plan(
    path: &Path,
    parts: McapParts,
    options: &RecordOptions,
    mut index: McapIndex,
) -> Result<Record, ReadError> {
    let damages = core::mem::take(&mut index.damages);
    let submaps = core::mem::take(&mut index.submaps).into_poses();
    // Where nothing could be read at all, the damage is the better answer.
    let instead = damages.first().filter(|_| index.clouds.is_empty()).cloned();
    let record = plan_undamaged(path, parts, options, &index, damages);
    let record = record.map_err(|fault| instead.unwrap_or_else(|| fault.in_file(path)))?;
    Ok(Record { submaps, ..record })
}

fn plan_undamaged(
    path: &Path,
    parts: McapParts,
    options: &RecordOptions,
    index: &McapIndex,
    damages: Vec<ReadError>,
) -> Result<Record, Fault> {
    let (topic, cloud) = choose_cloud(index, options)?;
    check_submaps(index, options)?;
    let tree = index.transforms.seen_from(topic);
    let reach = Reach { gap_max: (options.pose_gap_max_s * 1e6) as i64, near: NEAR_MICROS };
    let frames = cloud.frames.iter();
    let sources = frames.map(|frame| choose_poses(index, &tree, (topic, frame), options));
    let sources: Vec<PoseSource<'_>> = sources.collect::<Result<_, _>>()?;
    let entry = |stamp: Stamp, frame: u16| {
        let source = sources.get(usize::from(frame))?;
        let pose = source.pose(&tree, stamp, reach)?;
        Some(Entry { stamp, rank: 0, pose, registered: source.registered })
    };
    let mut entries: Vec<Option<Entry>> =
        cloud.scans.iter().map(|scan| scan.and_then(|(stamp, frame)| entry(stamp, frame))).collect();
    let mut in_order: Vec<&mut Entry> = entries.iter_mut().flatten().collect();
    in_order.sort_by_key(|entry| entry.stamp);
    for (rank, entry) in (0..).zip(&mut in_order) {
        entry.rank = rank;
    }
    let poses: Vec<(Stamp, Pose)> = in_order.iter().map(|e| (e.stamp, e.pose)).collect();
    // How many scans lie in the file before one that comes before them in time.
    let mut waiting = BTreeSet::new();
    let mut next = 0;
    for entry in entries.iter().flatten() {
        waiting.insert(entry.rank);
        while waiting.remove(&next) {
            next += 1;
        }
        if waiting.len() > WAITING_MAX {
            let what = "the number of scans that lie out of order in the file";
            return Err(Fault::too_large(Place::Whole, what, waiting.len() as u64, WAITING_MAX as u64));
        }
    }
    let mut summary = RecordSummary::from_poses(&poses);
    summary.scans = cloud.scans.len() as u64;
    summary.scans_without_pose = cloud.scans.iter().flatten().count() as u64 - summary.frames;
    summary.points = Some(cloud.points);
    let described: BTreeSet<&str> = sources.iter().map(|source| source.described.as_str()).collect();
    summary.poses_from = described.into_iter().collect::<Vec<_>>().join("; ");
    summary.damages.clone_from(&damages);
    summary.points_topic = Some(topic.to_owned());
    let maps: BTreeSet<Option<&str>> = sources.iter().map(PoseSource::map).collect();
    summary.map_frame = maps.first().copied().flatten().filter(|_| maps.len() == 1).map(str::to_owned);
    let no_returns = topic.rsplit_once('/').map(|(base, _)| format!("{base}{}", ros::NO_RETURNS));
    let no_returns = no_returns.filter(|t| t != topic && index.clouds.contains_key(t));
    let files = parts.files.clone();
    let frames = McapFrames::new(parts, options.clone(), topic.into(), no_returns, entries, damages);
    let submaps = SubmapPoses::default();
    Ok(Record { name: name_of(path), files, summary, poses, submaps, frames: Frames::new(frames) })
}

/// Whether the topic that is to say how submaps lie does so.
fn check_submaps(index: &McapIndex, options: &RecordOptions) -> Result<(), Fault> {
    let Some(topic) = &options.submaps_topic else { return Ok(()) };
    let fits = |c: &Channel| c.topic == *topic && c.schema == ros::POSES && c.encoding == "cdr";
    if index.channels.keys().any(fits) {
        return Ok(());
    }
    let expected = format!("poses of submaps on the topic {topic} ({} in the encoding \"cdr\")", ros::POSES);
    Err(Fault::foreign(Place::Whole, expected, index.pose_topics()))
}

fn choose_cloud<'a>(
    index: &'a McapIndex,
    options: &RecordOptions,
) -> Result<(&'a str, &'a CloudTopic), Fault> {
    let is_no_returns = |topic: &str| {
        topic.strip_suffix(ros::NO_RETURNS).is_some_and(|base| {
            index.clouds.keys().any(|other| other != topic && other.starts_with(&format!("{base}/")))
        })
    };
    let mut chosen: Vec<(&str, &CloudTopic)> =
        index.clouds.iter().map(|(topic, cloud)| (topic.as_str(), cloud)).collect();
    match &options.points_topic {
        Some(wanted) => chosen.retain(|(topic, _)| topic == wanted),
        None => chosen.retain(|(topic, _)| !is_no_returns(topic)),
    }
    // Of several topics, those in a frame that moves: what lies in the frame of the map is a map, or a
    // picture for viewers. A single one may be in the map: scans that were taken there beforehand.
    let moves = |(topic, cloud): &(&str, &CloudTopic)| {
        let tree = index.transforms.seen_from(topic);
        let is_child = |frame: &String| index.odometries.values().any(|o| o.child == *frame);
        cloud.frames.iter().any(|frame| !tree.ancestors(frame).is_empty() || is_child(frame))
    };
    if chosen.iter().any(moves) && chosen.len() > 1 {
        chosen.retain(moves);
    }
    if let Some(only) = only(&chosen, TopicOf::Scans)? {
        return Ok(only);
    }
    let wanted = |c: &&Channel| options.points_topic.as_ref().is_none_or(|topic| *topic == c.topic);
    let is_cloud = |c: &&Channel| [ros::POINT_CLOUD, "sensor_msgs/PointCloud2"].contains(&c.schema.as_str());
    let foreign = |c: &&Channel| c.encoding != "cdr" && is_cloud(c);
    if let Some(c) = index.channels.keys().filter(wanted).find(foreign) {
        let expected = format!("messages of {} ({}) in the encoding \"cdr\" of ROS 2", c.topic, c.schema);
        return Err(Fault::foreign(Place::Whole, expected, format!("the encoding \"{}\"", c.encoding)));
    }
    if options.points_topic.is_none() && index.channels.keys().any(|c| c.schema == FEED_SCHEMA) {
        let expected = "scans, which the flight of a node has with `scans = true` in its [record]";
        return Err(Fault::foreign(Place::Whole, expected, "the feed of a flight without"));
    }
    let expected = match &options.points_topic {
        Some(topic) => format!("scans on the topic {topic} ({} in the encoding \"cdr\")", ros::POINT_CLOUD),
        None => format!("a topic with {} in the encoding \"cdr\"", ros::POINT_CLOUD),
    };
    Err(Fault::foreign(Place::Whole, expected, index.topics()))
}

/// The only one of these topics; `None` if there is none.
fn only<'a, T: Copy>(topics: &[(&'a str, T)], of: TopicOf) -> Result<Option<(&'a str, T)>, Fault> {
    match topics {
        [] => Ok(None),
        [only] => Ok(Some(*only)),
        several => {
            let topics = several.iter().take(NAMED_MAX).map(|(topic, _)| (*topic).to_owned()).collect();
            Err(Fault { place: Place::Whole, problem: Problem::SeveralTopics { of, topics } })
        }
    }
}

/// Where the poses of scans in one frame come from: odometry, tf, or both one after the other.
#[derive(Default)]
struct PoseSource<'a> {
    frame: &'a str,
    odometry: Option<&'a OdometryTopic>,
    /// The frame from which tf leads to that of the scans.
    tf_from: Option<&'a str>,
    /// Whether the points are in the map already.
    registered: bool,
    described: String,
}

impl PoseSource<'_> {
    /// The frame in which the poses are.
    fn map(&self) -> Option<&str> {
        self.odometry.map(|odometry| odometry.parent.as_str()).or(self.tf_from)
    }

    fn pose(&self, tree: &FrameTree<'_>, stamp: Stamp, reach: Reach) -> Option<Pose> {
        let odometry = self.odometry.map(|odometry| odometry.track.at(stamp, reach).ok());
        let tf = self.tf_from.map(|from| tree.pose(from, self.frame, stamp, reach).ok());
        match (odometry, tf) {
            (Some(t_map_child), Some(t_child_sensor)) => Some(t_map_child?.compose(&t_child_sensor?)),
            (odometry, tf) => odometry.or(tf)?,
        }
    }
}

/// Whether odometry seems to be of another robot: other scans in a frame of this name are nearer to it.
fn is_of_others(index: &McapIndex, odometry: &str, (points_topic, frame): (&str, &str)) -> bool {
    let own = ros::shared_names(odometry, points_topic);
    let is_nearer = |(topic, cloud): (&String, &CloudTopic)| {
        ros::shared_names(odometry, topic) > own && cloud.frames.iter().any(|other| other == frame)
    };
    !ros::is_within(ros::namespace(odometry), ros::namespace(points_topic))
        && index.clouds.iter().any(is_nearer)
}

fn choose_poses<'a>(
    index: &'a McapIndex,
    tree: &FrameTree<'a>,
    (points_topic, frame): (&str, &'a str),
    options: &RecordOptions,
) -> Result<PoseSource<'a>, Fault> {
    let above = tree.ancestors(frame);
    let mut candidates: Vec<(&str, &OdometryTopic)> =
        index.odometries.iter().map(|(topic, odometry)| (topic.as_str(), odometry)).collect();
    match (&options.odometry_topic, &options.map_frame) {
        (Some(wanted), _) => candidates.retain(|(topic, _)| topic == wanted),
        (None, Some(map)) => candidates.retain(|(_, o)| o.parent == *map),
        (None, None) => {}
    }
    if let Some(topic) = &options.odometry_topic
        && candidates.is_empty()
    {
        let expected = format!("{} on the topic {topic}", ros::ODOMETRY);
        return Err(Fault::foreign(Place::Whole, expected, index.topics()));
    }
    let is_of_others = |topic: &str| is_of_others(index, topic, (points_topic, frame));
    let fitting = |fits: &dyn Fn(&OdometryTopic) -> bool| {
        let mut found: Vec<_> = candidates.iter().filter(|(_, o)| fits(o)).copied().collect();
        if options.odometry_topic.is_none() {
            // Robots may have the same names of frames, each in a namespace of its own.
            let shared = |topic: &str| ros::shared_names(topic, points_topic);
            let nearest = found.iter().map(|(topic, _)| shared(topic)).max();
            found.retain(|(topic, _)| Some(shared(topic)) == nearest && !is_of_others(topic));
        }
        only(&found, TopicOf::Odometry)
    };
    let source = PoseSource { frame, ..PoseSource::default() };
    // In this order: the sensor itself, a frame that the sensor is fixed to, and points that are already in
    // the map.
    if let Some((topic, o)) = fitting(&|o| o.child == frame || o.child.is_empty())? {
        let described = format!("odometry {topic}: \"{}\" → \"{frame}\"", o.parent);
        return Ok(PoseSource { odometry: Some(o), described, ..source });
    }
    if let Some((topic, o)) = fitting(&|o| above.contains(&o.child.as_str()))? {
        let described = format!("odometry {topic} and tf: \"{}\" → \"{}\" → \"{frame}\"", o.parent, o.child);
        return Ok(PoseSource { odometry: Some(o), tf_from: Some(&o.child), described, ..source });
    }
    if let Some((topic, o)) = fitting(&|o| o.parent == frame)? {
        let described = format!("odometry {topic}, points taken back from \"{frame}\"");
        return Ok(PoseSource { odometry: Some(o), registered: true, described, ..source });
    }
    let map = match &options.map_frame {
        Some(map) => above.iter().find(|f| *f == map).copied(),
        None => above.last().copied(),
    };
    if let (Some(map), None) = (map, &options.odometry_topic) {
        let described = format!("tf: \"{map}\" → \"{frame}\"");
        return Ok(PoseSource { tf_from: Some(map), described, ..source });
    }
    let others =
        candidates.iter().filter(|(topic, _)| options.odometry_topic.is_none() && is_of_others(topic));
    let others: Vec<String> = others.take(NAMED_MAX).map(|(topic, _)| (*topic).to_owned()).collect();
    if !others.is_empty() {
        let problem = Problem::SeveralTopics { of: TopicOf::Odometry, topics: others };
        return Err(Fault { place: Place::Whole, problem });
    }
    let to = options.map_frame.as_ref().map(|map| format!(" to \"{map}\"")).unwrap_or_default();
    let expected =
        format!("odometry or tf that leads from the frame of the scans, \"{frame}\",{to} to a map");
    Err(Fault::foreign(Place::Whole, expected, index.links()))
}
