//! A robot that moves among random points, and a method that listens to it.

mod behaviours;
mod damage;

use std::collections::BTreeMap;

use flockmap::codec::Batch;
use flockmap::grid::{
    Changes, Layer, Mapper, MapperConfig, Pose, Preset, Resolution, RobotId, Scan, Sphere, Stamp, State,
    Stream, Voxel, Which, voxel_bit,
};

use crate::baselines::{Messages, Method, Observation, Receiver, Sender};

pub fn config() -> MapperConfig {
    MapperConfig::preset(Preset::RogMap, Resolution::from_metres(0.1).unwrap(), 1.5)
}

/// Numbers from a seed, the same everywhere.
pub struct Random(u64);

impl Random {
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    pub fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    /// From 0 to 1.
    pub fn share(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// A scan of points all around, some beyond the range, some on a team-mate.
pub fn scan(random: &mut Random, number: i64) -> (Scan, Pose, Vec<Sphere>) {
    let mut point = |range: f64| core::array::from_fn(|_| ((random.share() - 0.5) * 2.0 * range) as f32);
    let mut points: Vec<[f32; 3]> = (0..80).map(|_| point(1.2)).collect();
    points.extend((0..20).map(|_| point(3.0)));
    let no_returns = (0..20).map(|_| point(4.0).map(|v| v + 2.0)).collect();
    let at = number as f64 * 0.05;
    let pose = Pose::new([at, 1.0 - at, 0.3], [0.1, -0.2, 0.3 + at, 0.8]).unwrap();
    let mask = Sphere { centre: [at + 0.4, 1.0 - at, 0.3], radius: 0.5 };
    (Scan { stamp: Stamp(number * 100_000), points, no_returns }, pose, vec![mask])
}

pub struct Run {
    pub truth: Layer,
    pub receiver: Box<dyn Receiver>,
    pub messages: Messages,
}

impl Run {
    /// A flight of so many scans; a batch closes every third scan, and once for obstacles only in between.
    pub fn new(method: Method, seed: u64, scans: i64) -> Self {
        let config = config();
        let mut mapper = Mapper::new(config.clone()).unwrap();
        let mut sender = method.sender(&config);
        let mut run = Self {
            truth: Layer::default(),
            receiver: method.receiver(&config).unwrap(),
            messages: Vec::new(),
        };
        let mut random = Random::new(seed);
        for number in 1..=scans {
            let (scan, pose, masks) = scan(&mut random, number);
            mapper.insert(&scan, &pose, &masks);
            let seen = Observation { scan: &scan, pose: &pose, masks: &masks };
            let mut out = Vec::new();
            sender.scan(&seen, &mut out).unwrap();
            let which = match number % 3 {
                0 => Some(Which::All),
                1 => Some(Which::Occupied),
                _ => None,
            };
            if let Some(which) = which {
                let changes = mapper.take_changes(which);
                run.batch(&mut *sender, scan.stamp, &changes, &mut out);
            }
            run.deliver(out);
        }
        let mut out = Vec::new();
        let now = Stamp((scans + 1) * 100_000);
        let changes = mapper.take_changes(Which::All);
        run.batch(&mut *sender, now, &changes, &mut out);
        run.deliver(out);
        run
    }

    fn batch(&mut self, sender: &mut dyn Sender, now: Stamp, changes: &Changes, out: &mut Messages) {
        if changes.is_empty() {
            return;
        }
        self.truth.apply(changes, now);
        sender.batch(now, &batch(now), changes, out).unwrap();
    }

    fn deliver(&mut self, messages: Messages) {
        for message in messages {
            self.receiver.receive(&message).unwrap();
            self.messages.push(message);
        }
    }

    pub fn received(&self) -> BTreeMap<Voxel, State> {
        Changes::from_blocks(self.receiver.states().collect()).voxels().collect()
    }

    /// What the receiver says of a voxel.
    pub fn state(&self, voxel: Voxel) -> State {
        state(&*self.receiver, voxel)
    }

    pub fn truth(&self) -> BTreeMap<Voxel, State> {
        self.truth.voxels().collect()
    }
}

pub fn batch(end: Stamp) -> Batch {
    let stream = Stream { origin: RobotId(1), epoch: 1 };
    Batch { stream, start: Stamp(0), end, resolution: config().resolution, sensor: [0; 3] }
}

/// What a receiver says of a voxel.
pub fn state(receiver: &dyn Receiver, voxel: Voxel) -> State {
    let block = receiver.states().find(|(index, _)| *index == voxel.block());
    block.map_or(State::Unknown, |(_, block)| block.get(voxel_bit(voxel)))
}
