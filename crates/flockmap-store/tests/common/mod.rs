//! What the tests of a store share: who drives it, and a naive model of what it must give back.
#![allow(dead_code, unreachable_pub, reason = "each test uses a part of it")]

#[path = "../../../flockmap/tests/common/mod.rs"]
pub mod swarm;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use flockmap::codec::{Content, Decoder};
use flockmap::{Codec, Event, Package, Pose, Robot, RobotConfig, RobotId, Scan, Stamp, State, Stream, Voxel};
use flockmap_store::memory::MemoryDisk;
use flockmap_store::{Compaction, Identity, Notice, Restored, Store, StoreCounters, StoreLog, StoreOptions};
use swarm::{PERFECT, Random, Swarm, config, resolution};

pub const OPTIONS: StoreOptions = StoreOptions { bytes_max: 64 << 20, sync_period: Duration::ZERO };

pub fn identity() -> Identity {
    Identity { swarm: 0, robot: RobotId(1), resolution: resolution() }
}

pub fn open(disk: &MemoryDisk, options: StoreOptions) -> Store {
    Store::open(Arc::new(disk.clone()), identity(), options).unwrap()
}

pub fn start(disk: &MemoryDisk, options: StoreOptions, epoch: u64) -> Writer {
    Writer::new(open(disk, options).start(epoch).unwrap())
}

/// Drives a store as a simulation does: on one thread, with a compaction going on step by step.
pub struct Writer {
    pub log: StoreLog,
    pub compaction: Option<Compaction>,
    pub notices: Vec<Notice>,
    now: Stamp,
}

impl Writer {
    pub fn new(mut log: StoreLog) -> Self {
        let compaction = log.begin_compaction();
        let mut writer = Self { log, compaction, notices: Vec::new(), now: Stamp(0) };
        writer.hear();
        writer
    }

    pub fn note(&mut self, event: &Event) {
        self.now = self.now.plus_micros(1_000);
        self.log.handle_timeout(self.now);
        self.log.note(self.now, event);
        if self.compaction.is_none() {
            self.compaction = self.log.begin_compaction();
        }
        self.hear();
    }

    pub fn step(&mut self, robot: &Robot) {
        let Some(compaction) = &mut self.compaction else { return };
        if !compaction.step(robot) {
            let compacted = self.compaction.take().unwrap().finish();
            self.log.end_compaction(compacted);
            self.compaction = self.log.begin_compaction();
        }
        self.hear();
    }

    /// Lets time pass.
    pub fn pass(&mut self, time: Duration) {
        self.now = self.now.plus(time);
        self.log.handle_timeout(self.now);
        if self.compaction.is_none() {
            self.compaction = self.log.begin_compaction();
        }
        self.hear();
    }

    pub fn finish_compaction(&mut self, robot: &Robot) {
        assert!(self.compaction.is_some(), "{:?}", self.counters());
        while self.compaction.is_some() {
            self.step(robot);
        }
    }

    fn hear(&mut self) {
        self.notices.extend(std::iter::from_fn(|| self.log.poll_notice()));
    }

    pub fn counters(&self) -> StoreCounters {
        self.log.counters()
    }
}

/// Robot 1 in its next run, with what is on the disk.
pub fn restart(disk: &MemoryDisk, base: RobotConfig, epoch: u64) -> (Robot, Restored) {
    let mut robot = Robot::new(RobotConfig { epoch, ..base }, Stamp(500_000_000)).unwrap();
    let restored = open(disk, OPTIONS).restore(&mut robot, Stamp(500_000_000));
    (robot, restored)
}

/// A scan with few points, so that a test of each byte has not too many.
pub fn small_scan(random: &mut Random, stamp: Stamp) -> Scan {
    let mut scan = swarm::scan(random, stamp);
    scan.points.truncate(6);
    scan
}

/// Both robots fly; what the first one publishes goes to its store. Returns the packages in the order of the
/// store.
pub fn fly(
    swarm: &mut Swarm,
    writer: &mut Writer,
    ticks: u32,
    random: &mut Random,
    scan: impl Fn(&mut Random, Stamp) -> Scan,
) -> Vec<Package> {
    let mut stored = Vec::new();
    for tick in 0..ticks {
        for robot in 0..swarm.robots.len() {
            let scan = scan(random, swarm.now);
            let at = [f64::from(tick) * 0.1, 2.0 * robot as f64, 0.0];
            swarm.scan(robot, &scan, &Pose::from_yaw(at, random.unit()));
        }
        swarm.run(100);
        store_events(swarm, writer, &mut stored);
    }
    swarm.settle(20_000);
    store_events(swarm, writer, &mut stored);
    writer.log.sync();
    stored
}

pub fn store_events(swarm: &mut Swarm, writer: &mut Writer, stored: &mut Vec<Package>) {
    for event in std::mem::take(&mut swarm.events[0]) {
        writer.note(&event);
        match event {
            Event::BatchClosed { packages, .. } => stored.extend(packages),
            Event::Merged { package, .. } => stored.push(package),
            _ => {}
        }
    }
    writer.step(&swarm.robots[0]);
}

pub fn two(codec: Codec) -> Vec<RobotConfig> {
    (1..=2).map(|id| RobotConfig { codec, ..config(id) }).collect()
}

/// Layers voxel by voxel: the newest observation of each.
#[derive(Clone, Default, PartialEq, Debug)]
pub struct Model(pub BTreeMap<Stream, BTreeMap<Voxel, (Stamp, bool)>>);

impl Model {
    pub fn add(&mut self, package: &Package, content: &Content) {
        let header = package.header();
        let layer = self.0.entry(header.stream).or_default();
        let Content::Changes(changes) = content else { panic!("{package:?}") };
        for (voxel, state) in changes.voxels() {
            let word = (header.batch_end, state == State::Occupied);
            let known = layer.entry(voxel).or_insert(word);
            *known = word.max(*known);
        }
    }

    pub fn of_robot(robot: &Robot) -> Self {
        let words = |layer: &flockmap::grid::Layer| {
            layer
                .voxels()
                .map(|(voxel, _)| {
                    let (state, stamp) = layer.get(voxel).unwrap();
                    (voxel, (stamp, state == State::Occupied))
                })
                .collect()
        };
        Self(robot.fusion().layers().map(|(stream, layer)| (stream, words(layer))).collect())
    }
}

/// What each package says, decoded one after the other.
pub fn contents(packages: &[Package]) -> Vec<Content> {
    let mut layers = BTreeMap::<Stream, flockmap::grid::Layer>::new();
    let mut decoder = Decoder::new();
    packages
        .iter()
        .map(|package| {
            let header = package.header();
            let layer = layers.entry(header.stream).or_default();
            let content = decoder.decode_against(package, Some(layer)).unwrap();
            if let Content::Changes(changes) = &content {
                layer.apply(changes, header.batch_end);
                if let Some(sensor) = package.sensor() {
                    layer.note_sensor(header.batch_end, sensor);
                }
            }
            content
        })
        .collect()
}

/// A log of a short flight: its only segment, its packages, and the robots.
pub fn small_log(codec: Codec, ticks: u32) -> (String, Vec<u8>, Vec<Package>, Swarm) {
    let disk = MemoryDisk::default();
    let mut swarm = Swarm::new(two(codec), PERFECT, 3);
    let mut writer = start(&disk, OPTIONS, 1);
    let packages = fly(&mut swarm, &mut writer, ticks, &mut Random(3), small_scan);
    drop(writer);
    let mut files = disk.files();
    assert_eq!(files.len(), 1);
    let (name, bytes) = files.pop_first().unwrap();
    (name, bytes, packages, swarm)
}
