//! What one pass through an MCAP record finds: its topics, the stamps of its scans, and its poses.

use std::collections::BTreeMap;

use flockmap_grid::Stamp;

use crate::error::{Fault, Place, Problem, ReadError, check_room};
use crate::mcap_file::Channel;
use crate::mcap_parts::{McapParts, Message, PartsReader};
use crate::record::RecordOptions;
use crate::record_submaps::SubmapLists;
use crate::ros::{self, FrameForest, Track};

/// Most poses, and most scans of a topic, that are kept.
const ENTRIES_MAX: usize = 1 << 22;
/// Most frames that the scans of one topic may be in.
const CLOUD_FRAMES_MAX: usize = 64;
/// Most damages that are kept.
pub(crate) const DAMAGES_MAX: usize = 16;

#[derive(Default)]
pub(crate) struct McapIndex {
    /// Each channel with the number of its messages, whether they can be read or not.
    pub(crate) channels: BTreeMap<Channel, u64>,
    pub(crate) clouds: BTreeMap<String, CloudTopic>,
    pub(crate) odometries: BTreeMap<String, OdometryTopic>,
    pub(crate) transforms: FrameForest,
    poses: usize,
    /// The topic of the poses of submaps, if they are wanted, and what it says.
    submaps_topic: Option<String>,
    pub(crate) submaps: SubmapLists,
    /// Stamp of the scan that was read last, of any topic.
    last_scan: Option<Stamp>,
    pub(crate) damages: Vec<ReadError>,
}

#[derive(Default)]
pub(crate) struct CloudTopic {
    pub(crate) frames: Vec<String>,
    /// One for each message: its stamp and the number of its frame in `frames`; `None` if it cannot be read.
    pub(crate) scans: Vec<Option<(Stamp, u16)>>,
    pub(crate) points: u64,
}

pub(crate) struct OdometryTopic {
    pub(crate) parent: String,
    pub(crate) child: String,
    pub(crate) track: Track,
}

impl McapIndex {
    /// Reads all parts. Damage is kept, up to 16 times; the first is the error if there is nothing else.
    pub(crate) fn read(parts: &McapParts, options: &RecordOptions) -> Result<Self, ReadError> {
        let mut index = Self { submaps_topic: options.submaps_topic.clone(), ..Self::default() };
        let mut reader = PartsReader::new(parts.clone(), options.chunk_bytes_max);
        let mut unopened = 0;
        loop {
            let damage = match reader.next_message() {
                None => break,
                Some(Ok(message)) => match index.take(&message) {
                    Ok(()) => continue,
                    Err(fault) => fault.in_file(reader.path()),
                },
                Some(Err(damage)) => {
                    unopened += usize::from(!reader.is_open());
                    damage
                }
            };
            let is_limit = matches!(damage.problem, Problem::TooLarge { .. }) && damage.place == Place::Whole;
            if is_limit || unopened == parts.files.len() {
                return Err(index.damages.into_iter().next().filter(|_| !is_limit).unwrap_or(damage));
            }
            if index.damages.len() < DAMAGES_MAX {
                index.damages.push(damage);
            }
        }
        index.odometries.values_mut().for_each(|odometry| odometry.track.sort());
        index.transforms.sort();
        Ok(index)
    }

    fn take(&mut self, message: &Message<'_>) -> Result<(), Fault> {
        let channel = &*message.channel;
        let number = self.channels.entry(channel.clone()).or_default();
        *number += 1;
        let number = *number;
        if channel.encoding != "cdr" {
            return Ok(());
        }
        let in_message = |fault: Fault| fault.in_message(&channel.topic, number);
        match channel.schema.as_str() {
            ros::POINT_CLOUD => {
                let topic = self.clouds.entry(channel.topic.clone()).or_default();
                check_room("the number of scans", topic.scans.len(), ENTRIES_MAX)?;
                let scan = topic.take(message.data);
                topic.scans.push(scan.as_ref().ok().copied());
                self.last_scan = scan.as_ref().ok().map_or(self.last_scan, |(stamp, _)| Some(*stamp));
                scan.map(drop).map_err(in_message)?;
            }
            ros::ODOMETRY => {
                check_room("the number of poses", self.held(), ENTRIES_MAX)?;
                let odometry = ros::decode_odometry(message.data).map_err(in_message)?;
                self.poses += 1;
                let topic = self.odometries.entry(channel.topic.clone()).or_insert_with(|| OdometryTopic {
                    parent: odometry.parent,
                    child: odometry.child,
                    track: Track::default(),
                });
                topic.track.collect(odometry.stamp, odometry.pose);
            }
            ros::TRANSFORMS => {
                check_room("the number of poses", self.held(), ENTRIES_MAX)?;
                let fixed = channel.topic.ends_with("tf_static");
                for t in ros::decode_transforms(message.data).map_err(in_message)? {
                    let namespace = ros::namespace(&channel.topic);
                    if fixed {
                        self.transforms.push_fixed(namespace, t.parent, t.child, t.pose);
                    } else {
                        self.transforms.collect(namespace, t.parent, t.child, (t.stamp, t.pose));
                    }
                }
            }
            ros::POSES if self.submaps_topic.as_ref() == Some(&channel.topic) => {
                let (stamp, poses) = ros::decode_submaps(message.data).map_err(in_message)?;
                let beside = self.poses + self.transforms.collected();
                self.submaps.take(self.stamp_of_submaps(stamp), &poses, [beside, ENTRIES_MAX])?;
            }
            _ => {}
        }
        Ok(())
    }

    /// Poses that are held.
    fn held(&self) -> usize {
        self.poses + self.transforms.collected() + self.submaps.len()
    }

    /// From when on poses of submaps count. Without a stamp of their own: behind the scan before them in the file.
    fn stamp_of_submaps(&self, stamp: Stamp) -> Stamp {
        let is_unstamped = stamp == Stamp(0);
        self.last_scan.filter(|_| is_unstamped).map_or(stamp, |scan| scan.plus_micros(1))
    }

    /// The topics of the file as text, for messages.
    pub(crate) fn topics(&self) -> String {
        let topics = self.channels.keys().take(20);
        let topics = topics.map(|c| format!("{} ({}, encoding {})", c.topic, c.schema, c.encoding));
        listed(topics.collect(), "no message")
    }

    /// The topics with poses of submaps, or with others of the type, as text, for messages.
    pub(crate) fn pose_topics(&self) -> String {
        let topics = self.channels.keys().filter(|c| c.schema == ros::POSES && c.encoding == "cdr").take(20);
        listed(topics.map(|c| c.topic.clone()).collect(), "no topic of that type")
    }

    /// What leads from frame to frame as text, for messages.
    pub(crate) fn links(&self) -> String {
        let odometries = self.odometries.iter();
        let odometries = odometries.map(|(topic, o)| format!("{} → {} ({topic})", o.parent, o.child));
        let tf = self.transforms.links().into_iter().take(16).map(|link| format!("{link} (tf)"));
        listed(odometries.chain(tf).collect(), "no odometry and no tf")
    }
}

impl CloudTopic {
    /// Stamp and number of the frame of one message.
    fn take(&mut self, message: &[u8]) -> Result<(Stamp, u16), Fault> {
        let (header, points) = ros::decode_cloud_header(message)?;
        self.points = self.points.saturating_add(points);
        let frame = self.frames.iter().position(|f| *f == header.frame_id).unwrap_or(self.frames.len());
        if frame >= CLOUD_FRAMES_MAX {
            let expected = format!("scans in at most {CLOUD_FRAMES_MAX} frames");
            return Err(Fault::damaged(Place::Whole, expected, "one more"));
        }
        if frame == self.frames.len() {
            self.frames.push(header.frame_id);
        }
        Ok((header.stamp.into(), frame as u16))
    }
}

/// Texts for a message, or that there is none.
fn listed(texts: Vec<String>, none: &str) -> String {
    if texts.is_empty() { none.to_owned() } else { texts.join(", ") }
}
