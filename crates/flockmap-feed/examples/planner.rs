//! A planner in a process of its own: follows the map of a running node and keeps a distance field about its robot up
//! to date.
//!
//! `cargo run --release -p flockmap-feed --example planner -- unix:map.sock`, while a node runs with
//! `[map_output] listen_unix = "map.sock"`. Ctrl-C ends it.

use std::time::{Duration, Instant};

use flockmap_feed::{Client, Mirror, MirrorOptions};
use flockmap_grid::{MapView, VoxelBox};
use flockmap_plan::{DistanceField, FieldConfig, box_between};

/// How far the planner looks ahead, in metres along x, y and z.
const AHEAD_M: [f64; 3] = [5.0, 5.0, 2.0];

/// The box goes along when the robot is so far from its middle, in metres.
const STEP_M: f64 = 1.0;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let address = std::env::args().nth(1).ok_or("say where the map is: unix:PATH or HOST:PORT")?;
    let mut client = Client::new(address.parse()?, Mirror::new(MirrorOptions::default()));
    let mut field: Option<([f64; 3], DistanceField)> = None;
    let mut said = Instant::now();
    loop {
        match client.next(Duration::from_millis(200)) {
            Ok(Some(_)) if !client.mirror().is_complete() => continue,
            Ok(_) => {}
            // The mirror stays as it is, and the next call connects again.
            Err(error) => eprintln!("{address}: {error}"),
        }
        let mirror = client.mirror();
        let own =
            mirror.node().and_then(|node| mirror.robots().iter().find(|r| r.stream.origin == node.robot));
        let (Some(map), Some(robot)) = (mirror.map(), own) else { continue };
        let at = robot.position;
        let (_, field) = match &mut field {
            Some((middle, field)) => {
                if (0..3).any(|axis| (at[axis] - middle[axis]).abs() > STEP_M) {
                    field.move_to(map, around(map, at)?)?;
                    *middle = at;
                } else {
                    // What has changed since the last time; nothing if nothing has.
                    field.update(map);
                }
                (middle, field)
            }
            none => {
                let made = DistanceField::new(map, around(map, at)?, &FieldConfig::default())?;
                let (middle, field) = none.insert((at, made));
                (middle, field)
            }
        };
        if said.elapsed() > Duration::from_secs(1) {
            said = Instant::now();
            let near = field.at(at).ok_or("the robot is in the box")?;
            println!(
                "{:?} at {at:.1?}: {:.2} m to the nearest obstacle, away from it is {:.1?}; {} blocks behind, {:.1} s since it was seen there",
                robot.stream.origin,
                near.distance_m,
                near.gradient,
                mirror.behind(),
                robot.age.as_secs_f64(),
            );
        }
    }
}

fn around(map: &MapView, at: [f64; 3]) -> Result<VoxelBox, &'static str> {
    let [low, high] = [-1.0, 1.0].map(|side| core::array::from_fn(|axis| at[axis] + side * AHEAD_M[axis]));
    box_between(map.resolution(), low, high).ok_or("the robot is at the end of the grid")
}
