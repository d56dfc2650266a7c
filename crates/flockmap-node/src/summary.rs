//! The summary of a node at its end, as JSON.

use std::collections::BTreeMap;

use flockmap::Robot;
use serde::Serialize;

use crate::{GivenUp, Histogram, NodeStatus};

/// A node at its end.
#[derive(Clone, PartialEq, Debug, Serialize)]
pub struct Summary {
    /// Id of the robot.
    pub id: u16,
    /// Its name.
    pub name: String,
    /// Its run.
    pub epoch: u64,
    /// How long it ran.
    pub uptime_s: f64,
    /// Free voxels of the fused map.
    pub map_free: usize,
    /// Occupied voxels of the fused map.
    pub map_occupied: usize,
    /// Every stream known, by origin and epoch.
    pub streams: Vec<StreamSummary>,
    /// What was dropped for want of room.
    pub given_up: GivenUp,
    /// Counters of the node, the robot, the session and the store, by name.
    pub counters: BTreeMap<&'static str, BTreeMap<String, u64>>,
    /// How long things took.
    pub timings: BTreeMap<&'static str, TimingSummary>,
}

/// What a node has of one stream at its end.
#[derive(Clone, PartialEq, Eq, Debug, Serialize)]
pub struct StreamSummary {
    /// The robot.
    pub origin: u16,
    /// Its run.
    pub epoch: u64,
    /// Indices received, as closed intervals.
    pub received: Vec<(u32, u32)>,
    /// Packages that are known to exist and not received.
    pub missing: u64,
    /// Voxels of its layer.
    pub voxels: usize,
    /// Digest of its layer, in hex: equal layers on all robots have equal digests.
    pub digest: String,
}

/// How long something took.
#[derive(Clone, Copy, PartialEq, Debug, Serialize)]
pub struct TimingSummary {
    /// How often.
    pub count: u64,
    /// Milliseconds.
    pub mean_ms: f64,
    /// Median in milliseconds.
    pub p50_ms: f64,
    /// 99 % took no longer. Milliseconds.
    pub p99_ms: f64,
    /// The longest, in milliseconds.
    pub max_ms: f64,
}

impl From<&Histogram> for TimingSummary {
    fn from(histogram: &Histogram) -> Self {
        let ms = |micros: u64| micros as f64 / 1e3;
        Self {
            count: histogram.len(),
            mean_ms: histogram.mean() / 1e3,
            p50_ms: ms(histogram.value_at_quantile(0.5)),
            p99_ms: ms(histogram.value_at_quantile(0.99)),
            max_ms: ms(histogram.max()),
        }
    }
}

impl Summary {
    /// The summary of a node. O(voxels), for the digests.
    pub(crate) fn new(robot: &Robot, status: &NodeStatus) -> Self {
        let session = robot.session();
        let streams = status.streams.iter().map(|s| {
            let digest = robot.fusion().layer(s.stream).map_or(0, flockmap::grid::Layer::digest);
            StreamSummary {
                origin: s.stream.origin.0,
                epoch: s.stream.epoch,
                received: session.received(s.stream).map_or_else(Vec::new, |r| r.intervals().to_vec()),
                missing: s.missing,
                voxels: s.voxels,
                digest: format!("{digest:016x}"),
            }
        });
        Self {
            id: status.own.origin.0,
            name: status.name.clone(),
            epoch: status.own.epoch,
            uptime_s: status.uptime.as_secs_f64(),
            map_free: status.map_voxels.0,
            map_occupied: status.map_voxels.1,
            streams: streams.collect(),
            given_up: status.given_up(),
            counters: status.counters().into(),
            timings: status.timings.all().into_iter().map(|(name, h)| (name, h.into())).collect(),
        }
    }
}
