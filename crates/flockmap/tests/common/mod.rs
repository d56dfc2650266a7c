//! A swarm in virtual time over a radio that loses, delays, repeats and damages, all from one seed.
#![expect(unreachable_pub, reason = "a module of tests")]

use std::collections::BTreeMap;

use flockmap::{
    Destination, Event, Pose, Resolution, Robot, RobotConfig, RobotId, Scan, Stamp, State, Stream, Voxel,
};

/// A small seeded generator (SplitMix64).
pub struct Random(pub u64);

impl Random {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// 0 … 1.
    pub fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// What the radio does to each datagram in flight to each receiver.
#[derive(Clone, Copy)]
pub struct Radio {
    pub loss: f64,
    pub duplication: f64,
    pub damage: f64,
    pub delay_ms: (f64, f64),
}

pub const PERFECT: Radio = Radio { loss: 0.0, duplication: 0.0, damage: 0.0, delay_ms: (2.0, 2.0) };

pub struct Swarm {
    pub robots: Vec<Robot>,
    pub now: Stamp,
    pub events: Vec<Vec<Event>>,
    radio: Radio,
    /// Pairs that do not hear each other.
    pub cut: Vec<(usize, usize)>,
    random: Random,
    air: BTreeMap<(Stamp, u64), (usize, Vec<u8>)>,
    sent: u64,
    pub bytes: u64,
}

pub fn resolution() -> Resolution {
    Resolution::from_metres(0.2).unwrap()
}

pub fn config(id: u16) -> RobotConfig {
    let mut config = RobotConfig::new(RobotId(id), resolution(), 6.0);
    config.session.relay_delay_ms = 500;
    config
}

/// A scan of a random room: walls at random distances around the sensor.
pub fn scan(random: &mut Random, stamp: Stamp) -> Scan {
    let walls: Vec<f64> = (0..8).map(|_| 1.5 + random.unit() * 6.0).collect();
    let points = (0..300)
        .map(|_| {
            let azimuth = random.unit() * core::f64::consts::TAU;
            let distance = walls[(azimuth / core::f64::consts::TAU * 8.0) as usize % 8];
            let height = random.unit() * 2.0 - 1.0;
            [(azimuth.cos() * distance) as f32, (azimuth.sin() * distance) as f32, height as f32]
        })
        .collect();
    Scan { stamp, points, no_returns: Vec::new() }
}

impl Swarm {
    pub fn new(configs: Vec<RobotConfig>, radio: Radio, seed: u64) -> Self {
        let now = Stamp(1_000_000);
        Self {
            events: configs.iter().map(|_| Vec::new()).collect(),
            robots: configs.into_iter().map(|config| Robot::new(config, now).unwrap()).collect(),
            now,
            radio,
            cut: Vec::new(),
            random: Random(seed),
            air: BTreeMap::new(),
            sent: 0,
            bytes: 0,
        }
    }

    /// A robot takes in a scan now.
    pub fn scan(&mut self, robot: usize, scan: &Scan, pose: &Pose) {
        self.robots[robot].insert_scan(self.now, scan, pose).unwrap();
        self.drain(robot);
    }

    /// Lets `ms` milliseconds pass.
    pub fn run(&mut self, ms: i64) {
        let end = self.now.plus_micros(ms * 1_000);
        while self.now < end {
            self.now = self.now.plus_micros(1_000);
            while let Some(entry) = self.air.first_entry().filter(|e| e.key().0 <= self.now) {
                let (to, bytes) = entry.remove();
                // Damage is counted by the session.
                let _ = self.robots[to].handle_datagram(self.now, &bytes);
                self.drain(to);
            }
            for robot in 0..self.robots.len() {
                // Work that goes on in slices is due at once, and comes to an end.
                for slice in 0.. {
                    let due = self.robots[robot].poll_timeout();
                    if due.is_none_or(|due| due > self.now) {
                        break;
                    }
                    assert!(slice < 200, "drained at {:?}, due at {due:?}", self.now);
                    self.robots[robot].handle_timeout(self.now);
                    self.drain(robot);
                }
            }
        }
    }

    fn drain(&mut self, from: usize) {
        while let Some(transmit) = self.robots[from].poll_transmit(self.now) {
            for to in (0..self.robots.len()).filter(|to| *to != from) {
                let wanted = match transmit.to {
                    Destination::Everyone => true,
                    Destination::Peer(id) => self.robots[to].own_stream().origin == id,
                };
                if wanted {
                    self.bytes += transmit.bytes.len() as u64 + 28;
                    self.fly(from, to, &transmit.bytes);
                }
            }
        }
        while let Some(event) = self.robots[from].poll_event() {
            assert!(!matches!(event, Event::EncodeFailed(_)), "{event:?}");
            self.events[from].push(event);
        }
    }

    fn fly(&mut self, from: usize, to: usize, bytes: &[u8]) {
        if self.cut.contains(&(from, to)) || self.cut.contains(&(to, from)) {
            return;
        }
        let copies = 1 + usize::from(self.random.unit() < self.radio.duplication);
        for _ in 0..copies {
            if self.random.unit() < self.radio.loss {
                continue;
            }
            let mut bytes = bytes.to_vec();
            if self.random.unit() < self.radio.damage {
                let bit = (self.random.next() % (bytes.len() as u64 * 8)) as usize;
                bytes[bit / 8] ^= 1 << (bit % 8);
            }
            let (low, high) = self.radio.delay_ms;
            let delay = (low + self.random.unit() * (high - low)) * 1_000.0;
            self.sent += 1;
            self.air.insert((self.now.plus_micros(delay as i64), self.sent), (to, bytes));
        }
    }

    /// Every robot closes its batch; then time passes until all hold the same, or `ms` are over.
    pub fn settle(&mut self, ms: i64) {
        for robot in 0..self.robots.len() {
            self.robots[robot].flush(self.now);
            self.drain(robot);
        }
        let end = self.now.plus_micros(ms * 1_000);
        while self.now < end && !self.agrees() {
            self.run(50);
        }
    }

    pub fn agrees(&self) -> bool {
        let digests = |robot: &Robot| -> BTreeMap<Stream, u64> {
            robot.fusion().layers().map(|(stream, layer)| (stream, layer.digest())).collect()
        };
        let first = digests(&self.robots[0]);
        self.robots.iter().all(|robot| digests(robot) == first)
    }

    /// Every voxel of every own map, where it is Free or Occupied, stands the same in every other robot's layer.
    pub fn assert_layers_equal_own_maps(&self, seed: u64) {
        for sender in &self.robots {
            let stream = sender.own_stream();
            for receiver in &self.robots {
                let layer = receiver.fusion().layer(stream);
                for (index, block) in sender.mapper().blocks() {
                    let corner = index.corner();
                    for bit in 0..512 {
                        let [x, y, z] = flockmap::grid::bit_of(bit);
                        let voxel = Voxel::new(corner.x + x, corner.y + y, corner.z + z);
                        let own = block.get(bit);
                        let stated = layer.map_or(State::Unknown, |layer| layer.state(voxel));
                        assert!(
                            own == State::Unknown || own == stated,
                            "seed {seed}: {voxel:?} {own:?} {stated:?}"
                        );
                    }
                }
            }
        }
    }
}
