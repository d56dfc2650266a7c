//! The record of a flight as a recording: what a node's readers were told, to be played.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, bail, ensure};
use flockmap::RobotId;
use flockmap::grid::{BLOCK_SIDE, BlockIndex, Plane, set_bits};
use flockmap_feed::{Block, Mirror};
use flockmap_io::{FeedFrame, FlightFrames, ReadError, open_flight};
use flockmap_view::{Recording, Series, Step};

use super::recorder::changed_since;
use crate::measure::IP_UDP_BYTES;
use crate::stop;

/// Moments of the recording are so far from each other, in microseconds.
const STEP_MICROS: i64 = 250_000;

/// Frames that may come before the robot says who it is.
const FRAMES_BEFORE_HELLO_MAX: usize = 1_000;

/// A flight whose robot is known, and whose rest is to be read.
pub struct Flight {
    frames: FlightFrames,
    topic: Arc<str>,
    mirror: Mirror,
    recording: Arc<Recording>,
    series: Arc<Series>,
    /// What the recording has of the mirror's map.
    version: u64,
    due: i64,
    damaged: u64,
}

impl Flight {
    /// Opens a file; `None` if it is no record of a flight, or one of which no feed is there. Of several robots the
    /// first one counts.
    pub fn open(path: &Path) -> anyhow::Result<Option<Self>> {
        let mut frames = open_flight(path)?;
        let (mut mirror, mut damaged) = (Mirror::default(), 0);
        for _ in 0..FRAMES_BEFORE_HELLO_MAX {
            match frames.next() {
                None => return Ok(None),
                Some(Err(error)) => note_damage(&mut damaged, &error),
                Some(Ok(frame)) => {
                    push(&mut mirror, &frame)?;
                    let Some(node) = mirror.node() else { continue };
                    let series = Arc::new(Series::new(vec!["sent".into(), "received".into()]));
                    let recording = Recording::new(node.robot, &node.name, node.resolution, &node.frame)?;
                    let recording = Arc::new(recording.with_series(Arc::clone(&series)));
                    let (topic, version, due) = (frame.topic, 0, i64::MIN);
                    return Ok(Some(Self {
                        frames,
                        topic,
                        mirror,
                        recording,
                        series,
                        version,
                        due,
                        damaged,
                    }));
                }
            }
        }
        bail!("{}: it has a feed that does not say whose it is", path.display())
    }

    /// What is played.
    pub fn recording(&self) -> Arc<Recording> {
        Arc::clone(&self.recording)
    }

    /// Reads all, until the end or Ctrl-C.
    pub fn read(mut self) -> anyhow::Result<()> {
        let mut last = None;
        while !stop::requested() {
            match self.frames.next() {
                None => break,
                Some(Err(error)) => note_damage(&mut self.damaged, &error),
                Some(Ok(frame)) if frame.topic != self.topic => {}
                Some(Ok(frame)) => {
                    push(&mut self.mirror, &frame)?;
                    last = Some(frame.stamp);
                    self.note_traffic(frame.stamp);
                    if frame.stamp.0 >= self.due {
                        self.due = frame.stamp.0.saturating_add(STEP_MICROS);
                        self.take(frame.stamp);
                    }
                }
            }
        }
        if let Some(last) = last {
            self.take(last);
        }
        self.recording.finish();
        ensure!(self.recording.moments() > 0, "the record ends before its map begins");
        Ok(())
    }

    fn note_traffic(&self, now: flockmap::Stamp) {
        let counters = &self.mirror.counts().counters;
        let value =
            |wanted: &str| counters.iter().find(|(name, _)| name == wanted).map_or(0, |(_, value)| *value);
        let wire = |way: &str| {
            value(&format!("node_bytes_{way}")) + IP_UDP_BYTES * value(&format!("node_datagrams_{way}"))
        };
        if !counters.is_empty() {
            self.series.push(now, &[wire("out"), wire("in")]);
        }
    }

    fn take(&mut self, now: flockmap::Stamp) {
        let Some(map) = self.mirror.map() else { return };
        let changed = changed_since(map, self.version, &self.recording);
        self.version = map.version();
        let block = |index: BlockIndex| {
            let states = map.block(index).unwrap_or_default();
            Block { index, states, origins: origins_of(&self.mirror, index, &states.known()) }
        };
        self.recording.push(Step {
            stamp: now,
            blocks: changed.into_iter().map(block).collect(),
            poses: self.mirror.robots().to_vec(),
            links: self.mirror.links().to_vec(),
            submaps: self.mirror.submaps().to_vec(),
            counters: self.mirror.counts().counters.clone(),
        });
    }
}

/// A further hello begins a connection of its own.
fn push(mirror: &mut Mirror, frame: &FeedFrame) -> anyhow::Result<()> {
    const HELLO: u8 = 1;
    if frame.bytes.get(4) == Some(&HELLO) {
        mirror.connect();
    }
    let mut bytes = &frame.bytes[..];
    while mirror.push(&mut bytes).with_context(|| frame.topic.to_string())?.is_some() {}
    Ok(())
}

fn note_damage(damaged: &mut u64, error: &ReadError) {
    *damaged += 1;
    if *damaged <= 3 {
        eprintln!("warning: a part of the flight is left out: {error}");
    }
}

/// Who saw which voxels of a block; nobody where the record does not say.
fn origins_of(mirror: &Mirror, index: BlockIndex, known: &Plane) -> Vec<(RobotId, Plane)> {
    let mut origins: Vec<(RobotId, Plane)> = Vec::new();
    for bit in set_bits(known) {
        let Some(robot) = mirror.origin(index.voxel(bit)) else { return Vec::new() };
        let place = origins.iter().position(|(other, _)| *other == robot).unwrap_or_else(|| {
            origins.push((robot, [0; BLOCK_SIDE as usize]));
            origins.len() - 1
        });
        origins[place].1[bit / 64] |= 1 << (bit % 64);
    }
    origins
}
