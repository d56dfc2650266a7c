//! Puts the packages of many robots on Zenoh, for measurements of archives: each flies the same way round again and again,
//! and a part of what it sees has changed each time.
//!
//! usage: many ENDPOINT ROBOTS PACKAGES    (PACKAGES of each robot; swarm 7)

use std::time::Instant;

use anyhow::{Context, Result, anyhow};
use flockmap::codec::FORMAT_VERSION;
use flockmap::{Event, Resolution, Robot, RobotConfig, RobotId, Stamp, State, States, StatesUpdate, Voxel, VoxelBox};
use zenoh::Wait;
use zenoh::qos::CongestionControl;

/// Places on the way round.
const WAY: i64 = 400;
const SIDES: [u32; 3] = [24, 24, 8];

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [endpoint, robots, packages] = &arguments[..] else { anyhow::bail!("usage: many ENDPOINT ROBOTS PACKAGES") };
    let (robots, packages): (u16, u32) = (robots.parse()?, packages.parse()?);
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"client\"".into()),
        ("connect/endpoints", format!("[\"{endpoint}\"]")),
        ("scouting/multicast/enabled", "false".into()),
    ] {
        config.insert_json5(key, &value).map_err(|error| anyhow!("{error}"))?;
    }
    let session = zenoh::open(config).wait().map_err(|error| anyhow!("{error}"))?;
    let resolution = Resolution::from_metres(0.1).context("a resolution")?;
    let mut random = 1u64;
    let mut next = move || {
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        random
    };
    let (began, mut put, mut bytes) = (Instant::now(), 0u64, 0u64);
    for id in 1..=robots {
        let mut config = RobotConfig::new(RobotId(id), resolution, 7.0);
        config.session.store_bytes_max = 100_000;
        let mut robot = Robot::new(config, Stamp(0))?;
        let stream = robot.own_stream();
        let (mut made, mut step) = (0, 0i64);
        while made < packages {
            step += 1;
            let now = Stamp(step * 500_000);
            let angle = (step % WAY) as f64 / WAY as f64 * std::f64::consts::TAU;
            let corner = Voxel::new((angle.cos() * 400.0) as i32, (angle.sin() * 400.0) as i32, 0);
            let region = VoxelBox::new(corner, SIDES).context("a box")?;
            // A floor with things on it, of which some have moved.
            let plane = (SIDES[0] * SIDES[1]) as usize;
            let states: Vec<State> = (0..plane * SIDES[2] as usize)
                .map(|at| match (at / plane, next() % 12) {
                    (0, _) | (1..6, 0..4) => State::Occupied,
                    _ => State::Free,
                })
                .collect();
            let states = States::Box { region, states: &states, clear_unknown: false };
            robot.insert_states(now, &StatesUpdate { stamp: now, resolution, sensor: None, states })?;
            robot.handle_timeout(now.plus_micros(499_000));
            while robot.poll_transmit(now.plus_micros(499_000)).is_some() {}
            while let Some(event) = robot.poll_event() {
                let Event::BatchClosed { packages: closed, .. } = event else { continue };
                for package in closed {
                    let key = format!(
                        "flockmap/7/{FORMAT_VERSION}/{}-{}/{}",
                        stream.origin.0,
                        stream.epoch,
                        package.header().index
                    );
                    bytes += package.bytes().len() as u64;
                    let value = package.bytes().to_vec();
                    let put = session.put(key, value).congestion_control(CongestionControl::Block);
                    put.wait().map_err(|error| anyhow!("{error}"))?;
                    made += 1;
                }
            }
        }
        put += u64::from(made);
    }
    println!("{put} packages, {bytes} B, in {:.1} s", began.elapsed().as_secs_f64());
    session.close().wait().map_err(|error| anyhow!("{error}"))
}
