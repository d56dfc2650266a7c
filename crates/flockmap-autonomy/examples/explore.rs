//! Explores a world and reports how it goes: `explore forest|indoor|FILE [robots] [seed] [threads]
//! [resolution range] [loss] [0: without no-returns] [seconds at most]`.

use flockmap::Robot;
use flockmap_autonomy::{ExploreOptions, Explorer};
use flockmap_grid::Resolution;
use flockmap_worlds::World;
use std::sync::Arc;
use std::time::Instant;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |at: usize, default: f64| -> Result<f64, std::num::ParseFloatError> {
        arguments.get(at).map_or(Ok(default), |text| text.parse())
    };
    let seed = number(2, 1.0)? as u64;
    let world = match arguments.first().map(String::as_str) {
        None | Some("forest") => World::forest(seed),
        Some("indoor") => World::indoor(seed),
        Some(file) => World::open(file, None)?,
    };
    let mut options = ExploreOptions {
        robots: number(1, 2.0)? as usize,
        seed,
        threads: number(3, 2.0)? as usize,
        resolution: Resolution::from_metres(number(4, 0.1)?).ok_or("resolution: 0.001 to 100 m")?,
        range_m: number(5, 7.0)?,
        ..ExploreOptions::default()
    };
    options.radio.link.loss = number(6, 0.0)?;
    options.scan.no_returns = number(7, 1.0)? > 0.0;
    options.seconds_max = number(8, 600.0)?;
    let started = Instant::now();
    let mut explorer = Explorer::new(Arc::new(world), options)?;
    println!("{:.1} s to begin", started.elapsed().as_secs_f64());
    let mut steps = 0u64;
    while explorer.step().is_some() {
        steps += 1;
        if steps.is_multiple_of(100) {
            let progress = explorer.progress();
            print!("{:5.1} s  {:5.1} % ", progress.seconds, progress.seen_share * 100.0);
            for robot in &progress.robots {
                let [x, y, z] = robot.position;
                print!(
                    " | {x:6.1} {y:6.1} {z:4.1}  {:5.1} m {:2} regions {:3} frontiers{}",
                    robot.path_m,
                    robot.regions,
                    robot.frontiers,
                    if robot.is_idle { " idle" } else { "" }
                );
            }
            println!("  ({:.1} s)", started.elapsed().as_secs_f64());
        }
    }
    println!("{:?}", explorer.outcome());
    let sent = |robot: &Robot| explorer.radio().traffic(robot.own_stream().origin).sent_bytes;
    let bytes: u64 = explorer.robots().map(sent).sum();
    println!("{:.2} MB sent, {:.1} s", bytes as f64 / 1e6, started.elapsed().as_secs_f64());
    Ok(())
}
