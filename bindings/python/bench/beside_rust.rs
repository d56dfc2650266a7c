//! The Rust side of `beside_rust.py`: does what it is told on stdin, and says how long that took.
//!
//! Given a file of float64 points to ask for (as many as there are, three each) and one of float32 points of a scan.
//! `scan`: inserts the scan into a robot without a map. `ask`: states of all points, at once. `loop`: the same one by one.

use std::hint::black_box;
use std::io::BufRead;
use std::time::Instant;

use flockmap::{Pose, Resolution, Robot, RobotConfig, RobotId, Scan, Stamp, State};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().collect();
    let [_, asked, scan] = &args[..] else {
        return Err("expected two files, of points and of a scan".into());
    };
    let asked: Vec<[f64; 3]> = std::fs::read(asked)?
        .as_chunks::<8>()
        .0
        .iter()
        .map(|b| f64::from_le_bytes(*b))
        .collect::<Vec<_>>()
        .as_chunks()
        .0
        .to_vec();
    let scan: Vec<[f32; 3]> = std::fs::read(scan)?
        .as_chunks::<4>()
        .0
        .iter()
        .map(|b| f32::from_le_bytes(*b))
        .collect::<Vec<_>>()
        .as_chunks()
        .0
        .to_vec();
    let scan = Scan { stamp: Stamp(0), points: scan, no_returns: Vec::new() };
    let robot = || {
        let resolution = Resolution::from_metres(0.1).ok_or("no side of a voxel")?;
        Ok::<_, Box<dyn std::error::Error>>(Robot::new(
            RobotConfig::new(RobotId(1), resolution, 20.0),
            Stamp(0),
        )?)
    };
    let mut mapped = robot()?;
    mapped.insert_scan(Stamp(0), &scan, &Pose::IDENTITY)?;
    let view = mapped.view();
    let mut states = vec![State::Unknown; asked.len()];
    for line in std::io::stdin().lock().lines() {
        let seconds = match line?.as_str() {
            "scan" => {
                let mut fresh = robot()?;
                let begin = Instant::now();
                black_box(fresh.insert_scan(Stamp(0), &scan, &Pose::IDENTITY)?);
                begin.elapsed()
            }
            "ask" => {
                let begin = Instant::now();
                flockmap_plan::states(&view, &asked, &mut states)?;
                begin.elapsed()
            }
            "loop" => {
                let begin = Instant::now();
                for (point, state) in asked.iter().zip(&mut states) {
                    *state = view.state_at(*point);
                }
                begin.elapsed()
            }
            other => return Err(format!("no such command: {other}").into()),
        };
        println!(
            "{} {}",
            seconds.as_secs_f64(),
            states.iter().filter(|state| **state == State::Occupied).count()
        );
    }
    Ok(())
}
