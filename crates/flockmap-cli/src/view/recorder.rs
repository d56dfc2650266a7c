//! Records what a robot in virtual time knows, for the view to play.

use std::sync::Arc;

use flockmap::grid::BlockIndex;
use flockmap::{MapView, Resolution, Robot, RobotId, Stamp};
use flockmap_feed::Block;
use flockmap_node::{links_of, poses_of, submaps_of};
use flockmap_view::{Recording, Series, Step};

use crate::measure::IP_UDP_BYTES;
use crate::member::Measures;

/// Moments of the recording are so far from each other, in microseconds.
const STEP_MICROS: i64 = 250_000;
/// Points of the line over time.
const SERIES_MICROS: i64 = 1_000_000;

/// Records one robot.
pub struct Recorder {
    recording: Arc<Recording>,
    series: Arc<Series>,
    /// What the recording has of the robot's map.
    version: u64,
    due: Stamp,
    series_due: Stamp,
    /// Copies of each datagram that the paper's method and RACER's would have to send.
    copies: u64,
}

impl Recorder {
    /// Nothing yet, of a swarm of so many robots that a method without broadcast sends a copy to each.
    pub fn new(robot: RobotId, name: &str, resolution: Resolution, copies: u64) -> std::io::Result<Self> {
        let names = if copies == 0 { &["sent"][..] } else { &["sent", "paper", "racer"] };
        let series = Arc::new(Series::new(names.iter().map(|name| (*name).to_owned()).collect()));
        let recording = Recording::new(robot, name, resolution, "map")?.with_series(Arc::clone(&series));
        let (recording, begin) = (Arc::new(recording), Stamp(i64::MIN));
        Ok(Self { recording, series, version: 0, due: begin, series_due: begin, copies })
    }

    /// What is played.
    pub fn recording(&self) -> Arc<Recording> {
        Arc::clone(&self.recording)
    }

    /// Notes how things are, if it is time.
    pub fn note(&mut self, now: Stamp, robot: &Robot, measures: &Measures) {
        if now >= self.series_due {
            self.series_due = now.plus_micros(SERIES_MICROS);
            let rivals = [&measures.paper, &measures.racer].map(|sent| sent.wire.total() * self.copies);
            let totals: Vec<u64> = std::iter::once(measures.sent.wire.total()).chain(rivals).collect();
            self.series.push(now, &totals[..if self.copies == 0 { 1 } else { 3 }]);
        }
        if now >= self.due {
            self.due = now.plus_micros(STEP_MICROS);
            self.take(now, robot, measures);
        }
    }

    /// Notes how it ended.
    pub fn finish(mut self, now: Stamp, robot: &Robot, measures: &Measures) {
        self.take(now, robot, measures);
        self.recording.finish();
    }

    fn take(&mut self, now: Stamp, robot: &Robot, measures: &Measures) {
        let map = robot.map();
        let changed = changed_since(map, self.version, &self.recording);
        self.version = map.version();
        let block = |index: BlockIndex| Block {
            index,
            states: map.block(index).unwrap_or_default(),
            origins: robot.fusion().origins(robot.mapper(), index),
        };
        let wire = measures.sent.wire.total();
        let payload = wire - measures.sent.datagrams * IP_UDP_BYTES;
        let counters = [
            ("node_bytes_out", payload),
            ("node_datagrams_out", measures.sent.datagrams),
            ("node_bytes_in", measures.received.total()),
        ];
        self.recording.push(Step {
            stamp: now,
            blocks: changed.into_iter().map(block).collect(),
            poses: poses_of(robot, now),
            links: links_of(robot, now),
            submaps: submaps_of(robot),
            counters: counters.map(|(name, value)| (name.to_owned(), value)).into(),
        });
    }
}

/// The blocks of a map that are not as a recording has them at its end, which was made of the map at `version`. Where
/// the map does not know that any more: all of both, since it knows nothing of blocks that it has let go.
pub(super) fn changed_since(map: &MapView, version: u64, recording: &Recording) -> Vec<BlockIndex> {
    map.changed_since(version).unwrap_or_else(|| {
        let last = recording.map_at(recording.moments().saturating_sub(1));
        map.blocks().chain(last.blocks()).map(|(index, _)| index).collect()
    })
}
