//! The scans of an MCAP record, read as they are asked for and put in the order of their stamps.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use flockmap_grid::{Pose, Scan, Stamp};

use crate::error::ReadError;
use crate::mcap_file::McapReader;
use crate::mcap_index::DAMAGES_MAX;
use crate::record::{Frame, RecordOptions};
use crate::ros;

/// A scan that has a pose.
#[derive(Clone, Copy)]
pub(crate) struct Entry {
    pub(crate) stamp: Stamp,
    /// Place in the order of stamps.
    pub(crate) rank: u32,
    pub(crate) pose: Pose,
    /// Whether its points are in the map and have to be taken back to the sensor.
    pub(crate) registered: bool,
}

/// The second pass: the scans, put in order.
pub(crate) struct McapFrames {
    path: PathBuf,
    options: RecordOptions,
    topic: String,
    no_returns: Option<String>,
    /// The rays without a return read last: they come before their scan.
    rays: Option<(Stamp, Vec<[f32; 3]>)>,
    reader: Option<McapReader>,
    /// One for each message of the topic; `None` where it gives no frame.
    entries: Vec<Option<Entry>>,
    /// Messages of the topic seen.
    number: usize,
    /// Scans that wait for an earlier one; `None` if the scan could not be read.
    waiting: BTreeMap<u32, Option<Frame>>,
    next_rank: u32,
    damages: Vec<ReadError>,
    ended: bool,
}

impl Iterator for McapFrames {
    type Item = Result<Frame, ReadError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            while let Some(frame) = self.waiting.remove(&self.next_rank) {
                self.next_rank += 1;
                if let Some(frame) = frame {
                    return Some(Ok(frame));
                }
            }
            if self.ended {
                // Scans are missing if the file changed in between; what is left still comes in order.
                while let Some((_, frame)) = self.waiting.pop_first() {
                    if let Some(frame) = frame {
                        return Some(Ok(frame));
                    }
                }
                return (!self.damages.is_empty()).then(|| Err(self.damages.remove(0)));
            }
            self.read_one();
        }
    }
}

impl McapFrames {
    /// The frames that `entries` list, one for each message of `topic`; `damages` were found by the first pass.
    pub(crate) fn new(
        path: &Path,
        options: &RecordOptions,
        topic: &str,
        no_returns: Option<String>,
        entries: Vec<Option<Entry>>,
        damages: Vec<ReadError>,
    ) -> Self {
        Self {
            path: path.to_owned(),
            options: options.clone(),
            topic: topic.to_owned(),
            no_returns,
            rays: None,
            reader: None,
            entries,
            number: 0,
            waiting: BTreeMap::new(),
            next_rank: 0,
            damages,
            ended: false,
        }
    }

    fn read_one(&mut self) {
        if self.reader.is_none() {
            match McapReader::open(&self.path, self.options.chunk_bytes_max) {
                Ok(reader) => self.reader = Some(reader),
                Err(fault) => self.damages.push(fault.in_file(&self.path)),
            }
        }
        let message = match self.reader.as_mut().and_then(McapReader::next_message) {
            Some(Ok(message)) => message,
            // Reported by the first pass.
            Some(Err(_)) => return,
            None => {
                self.ended = true;
                return;
            }
        };
        if message.channel.encoding != "cdr" || message.channel.schema != ros::POINT_CLOUD {
            return;
        }
        let points_max = self.options.scan_points_max;
        if self.no_returns.as_ref() == Some(&message.channel.topic) {
            let stamp = ros::CloudHeader::decode(message.data).map(|cloud| cloud.header.stamp);
            let rays = ros::decode_points(message.data, points_max, None);
            self.rays = stamp.ok().zip(rays.ok().map(|cloud| cloud.points));
            return;
        }
        if message.channel.topic != self.topic {
            return;
        }
        let entry = self.entries.get(self.number).copied().flatten();
        self.number += 1;
        let Some(entry) = entry else { return };
        let back = entry.registered.then(|| entry.pose.inverse());
        let frame = match ros::decode_points(message.data, points_max, back.as_ref()) {
            Ok(cloud) => {
                let rays = self.rays.take().filter(|(stamp, _)| *stamp == entry.stamp);
                let no_returns = rays.map(|(_, rays)| rays).unwrap_or_default();
                Some(Frame {
                    scan: Scan { stamp: entry.stamp, points: cloud.points, no_returns },
                    t_map_sensor: entry.pose,
                    points_dropped: cloud.dropped,
                })
            }
            Err(fault) => {
                if self.damages.len() < 2 * DAMAGES_MAX {
                    self.damages.push(fault.in_message(&self.topic, self.number as u64).in_file(&self.path));
                }
                None
            }
        };
        self.waiting.insert(entry.rank, frame);
    }
}
