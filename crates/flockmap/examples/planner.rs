//! A planner's loop: a robot flies to its goal through what it, or a team-mate, has seen: `cargo run -p flockmap
//! --example planner`.
//!
//! Three rules make it safe: plan on one view, Unknown is not Free, and ask for how long team-mates were silent.

use std::error::Error;

use flockmap::{MapView, Pose, RayEnd, Resolution, Robot, RobotConfig, RobotId, Scan, Stamp};

/// Metres: half the width of the robot and some air, and how far ahead the way is checked.
const RADIUS: f64 = 0.6;
const AHEAD: f64 = 3.0;

/// Lanes to choose from, as y in metres, the best first.
const LANES: [f64; 3] = [0.0, 2.0, -2.0];

/// A column half a metre thick stands in the way, at x and y. Sensors see so far.
const COLUMN: [f64; 2] = [12.0, 0.0];
const RANGE: f64 = 5.0;

/// Where a team-mate has been silent for longer, what it saw may have changed.
const STALE_SECONDS: f64 = 5.0;

fn main() -> Result<(), Box<dyn Error>> {
    let resolution = Resolution::from_metres(0.2).ok_or("no side of a voxel")?;
    let robot = |id| Robot::new(RobotConfig::new(RobotId(id), resolution, RANGE), Stamp(0));
    let (mut own, mut mate) = (robot(1)?, robot(2)?);
    // The team-mate waits behind the column.
    let (mut at, mate_at) = ([0.0, 0.0, 1.0], [15.0, 0.0, 1.0]);
    let mut lane = LANES[0];

    for now in (0..60_000_000).step_by(100_000).map(Stamp) {
        sense(&mut own, now, at)?;
        sense(&mut mate, now, mate_at)?;
        talk(now, &mut own, &mut mate)?;

        // The map goes on while the planner thinks; a view stays as it is. It costs nothing to take one.
        let view = own.view();
        let ahead = |y: f64| [at[0] + AHEAD, y, at[2]];
        let is_open = |y: &f64| !matches!(look(&view, at, ahead(*y)), RayEnd::Occupied { .. });
        let Some(best) = LANES.into_iter().find(is_open) else {
            return Err("every lane is blocked: hover, and look for another way".into());
        };
        if best != lane {
            println!(
                "{now:?}, x = {:.1} m: the lane at y = {lane} m is blocked, takes that at {best} m",
                at[0]
            );
            lane = best;
        }
        let speed = match look(&view, at, ahead(lane)) {
            RayEnd::Clear => 2.0,
            // Nobody has looked there yet: only so fast that the robot can stop before it.
            RayEnd::Unknown { distance_m, .. } => distance_m.min(1.0),
            RayEnd::Occupied { .. } => 0.0,
        };
        let is_stale = silence(&own, now).is_none_or(|seconds| seconds > STALE_SECONDS);
        let step = speed * 0.1 * if is_stale { 0.5 } else { 1.0 };
        // Where it flies is what was checked.
        let sideways = lane - at[1];
        at[0] += step * AHEAD / AHEAD.hypot(sideways);
        at[1] += step * sideways / AHEAD.hypot(sideways);
        assert!((at[0] - COLUMN[0]).hypot(at[1] - COLUMN[1]) > 0.5, "hit the column");
        if at[0] > 18.0 {
            println!("{now:?}: at the goal");
            return Ok(());
        }
    }
    Err("the goal was not reached".into())
}

/// What is in the way of a robot that flies straight from one point to another: lines through its middle and
/// its sides, since it is wider than a voxel. An obstacle counts before what is Unknown, and that before
/// nothing.
fn look(view: &MapView, from: [f64; 3], to: [f64; 3]) -> RayEnd {
    let cast = |through_unknown| {
        [0.0, 0.3, -0.3, RADIUS, -RADIUS].map(|side| {
            view.cast_ray([from[0], from[1] + side, from[2]], [to[0], to[1] + side, to[2]], through_unknown)
        })
    };
    let is_in_the_way = |end: &RayEnd| *end != RayEnd::Clear;
    let obstacle = cast(true).into_iter().find(is_in_the_way);
    obstacle.or_else(|| cast(false).into_iter().find(is_in_the_way)).unwrap_or(RayEnd::Clear)
}

/// Seconds since the team-mate that has been silent for longest was heard; `None`: nobody is heard. Who is heard
/// and sends no change sees none. When a voxel was set: `robot.fusion().layer(stream)?.get(voxel)`.
fn silence(robot: &Robot, now: Stamp) -> Option<f64> {
    let silences = robot.session().peers().map(|peer| now.since(peer.last_heard).as_secs_f64());
    silences.max_by(f64::total_cmp)
}

/// A LiDAR with one ring: it sees the column, or nothing.
fn sense(robot: &mut Robot, now: Stamp, at: [f64; 3]) -> Result<(), Box<dyn Error>> {
    let mut scan = Scan { stamp: now, ..Scan::default() };
    for angle in (0..720).map(|half_degrees| f64::from(half_degrees).to_radians() / 2.0) {
        let ray = [angle.cos(), angle.sin()];
        let to = [COLUMN[0] - at[0], COLUMN[1] - at[1]];
        let (along, beside) = (to[0] * ray[0] + to[1] * ray[1], to[0] * ray[1] - to[1] * ray[0]);
        let range = if beside.abs() < 0.25 && (0.0..RANGE).contains(&along) { along - 0.25 } else { RANGE };
        let list = if range < RANGE { &mut scan.points } else { &mut scan.no_returns };
        list.push([(range * ray[0]) as f32, (range * ray[1]) as f32, 0.0]);
    }
    let pose = Pose::new(at, [0.0, 0.0, 0.0, 1.0]).ok_or("no pose")?;
    robot.insert_scan(now, &scan, &pose)?;
    Ok(())
}

/// A radio without loss.
fn talk(now: Stamp, a: &mut Robot, b: &mut Robot) -> Result<(), Box<dyn Error>> {
    a.handle_timeout(now);
    b.handle_timeout(now);
    while let Some(transmit) = a.poll_transmit(now) {
        b.handle_datagram(now, &transmit.bytes)?;
    }
    while let Some(transmit) = b.poll_transmit(now) {
        a.handle_datagram(now, &transmit.bytes)?;
    }
    Ok(())
}

#[test]
fn it_runs() {
    main().unwrap();
}
