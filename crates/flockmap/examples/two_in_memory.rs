//! Two robots in one program, and a radio that loses every fifth datagram: `cargo run -p flockmap --example
//! two_in_memory`.
//!
//! Time is a number that the caller hands in, so three seconds of flight take a moment, and the same every time.

use std::error::Error;

use flockmap::{Pose, Resolution, Robot, RobotConfig, RobotId, Scan, Stamp};

fn main() -> Result<(), Box<dyn Error>> {
    let resolution = Resolution::from_metres(0.2).ok_or("no side of a voxel")?;
    // A real robot sets `epoch` as well: another one for every run.
    let robot = |id| Robot::new(RobotConfig::new(RobotId(id), resolution, 20.0), Stamp(0));
    // They fly along a wall, one on each side.
    let mut robots = [robot(1)?, robot(2)?];
    let mut sent = 0_u32;

    // Microseconds. A scan every tenth of a second, for three seconds; then the radio repairs what it lost.
    for now in (0..10_000_000).step_by(10_000).map(Stamp) {
        for (number, robot) in robots.iter_mut().enumerate() {
            if now < Stamp(3_000_000) && now.0 % 100_000 == 0 {
                let y = if number == 0 { -4.0 } else { 4.0 };
                let pose = Pose::new([now.seconds(), y, 1.0], [0.0, 0.0, 0.0, 1.0]).ok_or("no pose")?;
                robot.insert_scan(now, &wall(now, -y as f32), &pose)?;
            }
            // It may be called more often than `poll_timeout` asks for.
            robot.handle_timeout(now);
        }
        for (from, to) in [(0, 1), (1, 0)] {
            while let Some(transmit) = robots[from].poll_transmit(now) {
                sent += 1;
                if !sent.is_multiple_of(5) {
                    robots[to].handle_datagram(now, &transmit.bytes)?;
                }
            }
        }
    }

    for (number, robot) in robots.iter().enumerate() {
        let (free, occupied) = robot.map().count();
        println!("robot {} knows {free} free and {occupied} occupied voxels", number + 1);
    }
    // What a robot published, its layer, is the same on all who hold it: voxel by voxel, with its time.
    for of in &robots {
        let stream = of.own_stream();
        let [here, there] = [0, 1].map(|k| robots[k].fusion().layer(stream).map(|layer| layer.digest()));
        assert!(here.is_some() && here == there, "{stream:?}");
    }
    println!("{sent} datagrams, every fifth lost: both robots hold the same layers");
    Ok(())
}

/// What a sensor sees of a wall at this distance to its left, in the frame of the sensor.
fn wall(stamp: Stamp, left: f32) -> Scan {
    let points = (-40..=40).flat_map(|x| (-5..=5).map(move |z| [x as f32 * 0.2, left, z as f32 * 0.2]));
    Scan { stamp, points: points.collect(), no_returns: Vec::new() }
}

#[test]
fn it_runs() {
    main().unwrap();
}
