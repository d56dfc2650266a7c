//! Puts the packages of many robots on Zenoh, for measurements of archives: each flies round in an area of its own that
//! overlaps with those of its neighbours at the rims, again and again, and some of what it sees has moved each time.
//! The same arguments make the same packages.
//!
//! usage: many ENDPOINT ROBOTS PACKAGES [SEED]    (PACKAGES of each robot; swarm 7; ENDPOINT `-`: only counts them)

use std::f64::consts::TAU;
use std::time::Instant;

use anyhow::{Context, Result, anyhow};
use flockmap::codec::FORMAT_VERSION;
use flockmap::{
    Event, Package, Resolution, Robot, RobotConfig, RobotId, Stamp, State, States, StatesUpdate, Voxel,
    VoxelBox,
};
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait};

/// Steps on the way round, and its radius in voxels.
const STEPS: i64 = 400;
const RADIUS: f64 = 400.0;
/// What a robot sees at once, in voxels.
const SIDES: [u32; 3] = [24, 24, 8];
/// From the middle of an area to that of the next one. A robot sees 824 voxels from rim to rim: 24 of them its
/// neighbour sees too.
const SPACING: i32 = 800;
/// Between two steps.
const STEP_MICROS: i64 = 500_000;

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let (endpoint, robots, packages, seed) = match &arguments[..] {
        [endpoint, robots, packages] => (endpoint, robots, packages, "1"),
        [endpoint, robots, packages, seed] => (endpoint, robots, packages, seed.as_str()),
        _ => anyhow::bail!("usage: many ENDPOINT ROBOTS PACKAGES [SEED]"),
    };
    let (robots, packages, seed): (u16, u32, u64) = (robots.parse()?, packages.parse()?, seed.parse()?);
    let session = (endpoint != "-").then(|| open(endpoint)).transpose()?;
    let (began, mut made, mut bytes) = (Instant::now(), 0u64, 0u64);
    for id in 1..=robots {
        let mut flight = Flight::start(id, robots, seed)?;
        let mut left = packages;
        while left > 0 {
            for package in flight.step()? {
                bytes += package.bytes().len() as u64;
                made += 1;
                left = left.saturating_sub(1);
                if let Some(session) = &session {
                    put(session, &package)?;
                }
            }
        }
    }
    println!("{made} packages, {bytes} B, in {:.1} s", began.elapsed().as_secs_f64());
    session.map_or(Ok(()), |session| session.close().wait().map_err(|error| anyhow!("{error}")))
}

fn open(endpoint: &str) -> Result<Session> {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"client\"".into()),
        ("connect/endpoints", format!("[\"{endpoint}\"]")),
        ("scouting/multicast/enabled", "false".into()),
    ] {
        config.insert_json5(key, &value).map_err(|error| anyhow!("{error}"))?;
    }
    zenoh::open(config).wait().map_err(|error| anyhow!("{error}"))
}

fn put(session: &Session, package: &Package) -> Result<()> {
    let header = package.header();
    let (origin, epoch, index) = (header.stream.origin.0, header.stream.epoch, header.index);
    let key = format!("flockmap/7/{FORMAT_VERSION}/{origin}-{epoch}/{index}");
    let put = session.put(key, package.bytes().to_vec()).congestion_control(CongestionControl::Block);
    put.wait().map_err(|error| anyhow!("{error}"))
}

/// One robot on its way round.
struct Flight {
    robot: Robot,
    resolution: Resolution,
    /// The middle of its area.
    middle: (i32, i32),
    random: Random,
    steps: i64,
}

impl Flight {
    /// The areas of all robots lie in a square.
    fn start(id: u16, robots: u16, seed: u64) -> Result<Self> {
        let resolution = Resolution::from_metres(0.1).context("a resolution")?;
        let mut config = RobotConfig::new(RobotId(id), resolution, 7.0);
        config.session.store_bytes_max = 100_000;
        let columns = i32::from(robots).isqrt().max(1);
        let place = i32::from(id - 1);
        let middle = [place % columns, place / columns].map(|at| SPACING * (at - columns / 2));
        Ok(Self {
            robot: Robot::new(config, Stamp(0))?,
            resolution,
            middle: middle.into(),
            random: Random::new(seed, id),
            steps: 0,
        })
    }

    /// The packages of the next step.
    fn step(&mut self) -> Result<Vec<Package>> {
        self.steps += 1;
        let now = Stamp(self.steps * STEP_MICROS);
        let angle = (self.steps % STEPS) as f64 / STEPS as f64 * TAU;
        let (x, y) = ((angle.cos() * RADIUS) as i32, (angle.sin() * RADIUS) as i32);
        let region =
            VoxelBox::new(Voxel::new(self.middle.0 + x, self.middle.1 + y, 0), SIDES).context("a box")?;
        let states = self.seen();
        let states = States::Box { region, states: &states, clear_unknown: false };
        let update = StatesUpdate { stamp: now, resolution: self.resolution, sensor: None, states };
        self.robot.insert_states(now, &update)?;
        let end = now.plus_micros(STEP_MICROS - 1_000);
        self.robot.handle_timeout(end);
        while self.robot.poll_transmit(end).is_some() {}
        let mut made = Vec::new();
        while let Some(event) = self.robot.poll_event() {
            if let Event::BatchClosed { packages, .. } = event {
                made.extend(packages);
            }
        }
        Ok(made)
    }

    /// A floor with things on it, of which some have moved.
    fn seen(&mut self) -> Vec<State> {
        let [width, depth, height] = SIDES.map(|side| side as usize);
        let plane = width * depth;
        let state = |at| match (at / plane, self.random.next() % 12) {
            (0, _) | (1..6, 0..4) => State::Occupied,
            _ => State::Free,
        };
        (0..plane * height).map(state).collect()
    }
}

/// The same numbers for the same seed and robot.
struct Random(u64);

impl Random {
    fn new(seed: u64, id: u16) -> Self {
        // Any number but 0, and far from that of the next robot.
        let mixed = (seed << 16 | u64::from(id)).wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        Self(mixed | 1)
    }

    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }
}
