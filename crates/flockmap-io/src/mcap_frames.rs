//! The scans of an MCAP record, read as they are asked for and put in the order of their stamps.

use std::collections::BTreeMap;

use flockmap_grid::{Pose, Scan, Stamp};

use crate::error::ReadError;
use crate::mcap_index::DAMAGES_MAX;
use crate::mcap_parts::{McapParts, PartsReader};
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
#[derive(Default)]
pub(crate) struct McapFrames {
    parts: McapParts,
    options: RecordOptions,
    topic: String,
    no_returns: Option<String>,
    /// The rays without a return read last: they come before their scan.
    rays: Option<(Stamp, Vec<[f32; 3]>)>,
    reader: Option<PartsReader>,
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
            // Scans are missing if the file changed in between; what is left still comes in order.
            while let Some(next) =
                self.waiting.first_entry().filter(|e| self.ended || *e.key() == self.next_rank)
            {
                self.next_rank = next.key() + 1;
                if let Some(frame) = next.remove() {
                    return Some(Ok(frame));
                }
            }
            if self.ended {
                return (!self.damages.is_empty()).then(|| Err(self.damages.remove(0)));
            }
            self.read_one();
        }
    }
}

impl McapFrames {
    /// The frames that `entries` list, one for each message of `topic`; `damages` were found by the first pass.
    pub(crate) fn new(
        parts: McapParts,
        options: RecordOptions,
        topic: String,
        no_returns: Option<String>,
        entries: Vec<Option<Entry>>,
        damages: Vec<ReadError>,
    ) -> Self {
        Self { parts, options, topic, no_returns, entries, damages, ..Self::default() }
    }

    fn read_one(&mut self) {
        let chunk_bytes_max = self.options.chunk_bytes_max;
        let reader = self.reader.get_or_insert_with(|| PartsReader::new(self.parts.clone(), chunk_bytes_max));
        let Some(message) = reader.next_message() else {
            self.ended = true;
            return;
        };
        // Damage was reported by the first pass.
        let Ok(message) = message else { return };
        if message.channel.encoding != "cdr" || message.channel.schema != ros::POINT_CLOUD {
            return;
        }
        let points_max = self.options.scan_points_max;
        if self.no_returns.as_ref() == Some(&message.channel.topic) {
            let header = ros::decode_cloud_header(message.data);
            let rays = ros::decode_points(message.data, points_max, None);
            self.rays =
                header.ok().zip(rays.ok()).map(|((header, _), rays)| (header.stamp.into(), rays.points));
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
                    let fault = fault.in_message(&self.topic, self.number as u64);
                    self.damages.push(fault.in_file(reader.path()));
                }
                None
            }
        };
        self.waiting.insert(entry.rank, frame);
    }
}
