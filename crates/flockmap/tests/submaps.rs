//! Submaps of whole robots: what drifted is put right everywhere, by poses alone.

#[allow(dead_code, reason = "scans of another world are made here")]
mod common;

use std::collections::BTreeSet;

use common::{PERFECT, Radio, Swarm, config, resolution};
use flockmap::{Pose, Robot, RobotConfig, RobotId, Scan, Stamp, State, SubmapError, SubmapId, Voxel};

const LOSSY: Radio = Radio { loss: 0.3, duplication: 0.05, damage: 0.01, delay_ms: (1.0, 60.0) };

/// A corridor round a square core: walls at ±14 m and ±9 m, and a floor.
fn is_wall(at: [f64; 3]) -> bool {
    let far = at[0].abs().max(at[1].abs());
    far >= 14.0 || far <= 9.0 || at[2] <= -1.0
}

/// What a sensor at `T_world_sensor` sees, in its own frame.
#[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
fn scan(stamp: Stamp, T_world_sensor: &Pose) -> Scan {
    let (mut points, mut no_returns) = (Vec::new(), Vec::new());
    for ring in -4..=4 {
        for beam in 0..180 {
            let (azimuth, height) = (f64::from(beam).to_radians() * 2.0, f64::from(ring) * 0.12);
            let direction = [azimuth.cos(), azimuth.sin(), height];
            let at = |t: f64| T_world_sensor.transform(direction.map(|d| d * t));
            let hit = (1..140).map(|step| f64::from(step) * 0.05).find(|t| is_wall(at(*t)));
            let end = direction.map(|d| (d * hit.unwrap_or(7.0)) as f32);
            if hit.is_some() { points.push(end) } else { no_returns.push(end) }
        }
    }
    Scan { stamp, points, no_returns }
}

/// Where the robot is after so many metres of way round the core.
fn on_the_way(metres: f64) -> Pose {
    const SIDE: f64 = 23.0;
    let (side, along) = ((metres / SIDE) as i32 % 4, metres % SIDE - SIDE / 2.0);
    let turn = f64::from(side) * core::f64::consts::FRAC_PI_2;
    Pose::from_yaw([0.0; 3], turn).compose(&Pose::from_translation([along, -SIDE / 2.0, 0.0]))
}

/// The drift after so many metres: 1 % of the way and 0.05° a metre.
fn drift(metres: f64) -> Pose {
    Pose::from_yaw([metres * 0.01, metres * 0.004, 0.0], (metres * 0.05).to_radians())
}

fn occupied(map: &flockmap::MapView) -> BTreeSet<Voxel> {
    map.voxels().filter(|(_, state)| *state == State::Occupied).map(|(voxel, _)| voxel).collect()
}

/// Share of voxels that have one of the others within two voxels along each axis.
fn near(voxels: &BTreeSet<Voxel>, others: &BTreeSet<Voxel>) -> f64 {
    let is_near = |v: &&Voxel| {
        (0..125).any(|n| others.contains(&Voxel::new(v.x + n % 5 - 2, v.y + n / 5 % 5 - 2, v.z + n / 25 - 2)))
    };
    voxels.iter().filter(is_near).count() as f64 / voxels.len().max(1) as f64
}

/// Flies so many metres with drift, with a submap each few metres; returns how far each submap had come when it began.
fn fly(swarm: &mut Swarm, metres: i32, submap_m: i32) -> Vec<f64> {
    let mut begun = vec![0.0];
    for step in 1..=metres * 2 {
        let way = f64::from(step) / 2.0;
        if step % (submap_m * 2) == 0 {
            let submap = swarm.robots[0].begin_submap(swarm.now).unwrap();
            assert_eq!(usize::from(submap.number()), begun.len());
            begun.push(way);
        }
        let at = on_the_way(way);
        swarm.scan(0, &scan(swarm.now, &at), &drift(way).compose(&at));
        swarm.run(250);
    }
    begun
}

/// The pose graph is optimised: each submap lies where it was seen from.
fn close_loop(swarm: &mut Swarm, begun: &[f64], length_m: f64) {
    for (number, way) in begun.iter().enumerate() {
        let submap = SubmapId::new(number as u16).unwrap();
        let pose = drift(way + length_m / 2.0).inverse();
        swarm.robots[0].set_submap_pose(swarm.now, submap, &pose).unwrap();
    }
}

fn assert_same_poses(swarm: &Swarm, begun: &[f64]) {
    let stream = swarm.robots[0].own_stream();
    for robot in &swarm.robots {
        assert_eq!(robot.fusion().submaps(stream).count(), begun.len());
        for submap in robot.fusion().submaps(stream) {
            let pose = swarm.robots[0].submap_pose(submap);
            assert_eq!(robot.fusion().submap_pose(stream, submap), pose, "{submap:?}");
        }
        assert_eq!(robot.fusion().unplaced(stream), 0);
    }
}

#[test]
fn a_closed_loop_is_put_right_everywhere_for_the_bytes_of_poses() {
    for radio in [PERFECT, LOSSY] {
        let mut swarm = Swarm::new(vec![config(1), config(2), config(3)], radio, 7);
        let begun = fly(&mut swarm, 92, 6);
        swarm.settle(20_000);
        assert!(swarm.agrees());
        let truth: BTreeSet<Voxel> = {
            let mut swarm = Swarm::new(vec![config(1)], PERFECT, 7);
            for step in 1..=184 {
                let at = on_the_way(f64::from(step) / 2.0);
                swarm.scan(0, &scan(swarm.now, &at), &at);
                swarm.run(250);
            }
            occupied(swarm.robots[0].map())
        };
        let drifted = near(&occupied(swarm.robots[1].map()), &truth);
        let package_bytes = swarm.robots[0].counters().package_bytes;
        close_loop(&mut swarm, &begun, 6.0);
        swarm.settle(20_000);
        swarm.run(2_000);
        assert!(swarm.agrees());
        assert_same_poses(&swarm, &begun);
        let bytes = swarm.robots[0].counters().package_bytes - package_bytes;
        assert!(bytes <= 50 * begun.len() as u64, "{bytes} B for {} poses", begun.len());
        for robot in &swarm.robots {
            assert!(!robot.is_rebuilding());
            let right = near(&occupied(robot.map()), &truth);
            assert!(drifted < 0.9 && right > 0.99, "{drifted} before, {right} after");
        }
        // Where nothing was seen again, others show what the robot itself shows.
        let [own, other] = [0, 1].map(|robot| occupied(swarm.robots[robot].map()));
        assert!(near(&own, &other) > 0.995 && near(&other, &own) > 0.995);
    }
}

#[test]
fn who_joins_late_knows_where_submaps_lie_and_a_new_run_says_it_again() {
    let mut swarm = Swarm::new(vec![config(1), config(2), config(3)], PERFECT, 3);
    swarm.cut = vec![(0, 2), (1, 2)];
    let begun = fly(&mut swarm, 40, 5);
    swarm.settle(5_000);
    close_loop(&mut swarm, &begun, 5.0);
    swarm.run(8_000);
    swarm.cut.clear();
    swarm.settle(30_000);
    assert!(swarm.agrees());
    assert_same_poses(&swarm, &begun);
    let [early, late] = [1, 2].map(|robot| occupied(swarm.robots[robot].map()));
    assert_eq!(early, late);
}

#[test]
fn a_submap_begins_by_the_way_that_the_sensor_has_come() {
    let mut by_length = config(1);
    by_length.submap_length_m = Some(3.0);
    let mut swarm = Swarm::new(vec![by_length, config(2)], PERFECT, 3);
    for step in 0..40 {
        let at = on_the_way(f64::from(step) / 4.0);
        swarm.scan(0, &scan(swarm.now, &at), &at);
        swarm.run(250);
    }
    swarm.settle(5_000);
    let robot = &swarm.robots[0];
    assert_eq!((robot.submap().number(), robot.counters().submaps_begun), (3, 3));
    assert_eq!(swarm.robots[1].fusion().submaps(robot.own_stream()).count(), 4);
}

#[test]
fn a_submap_that_is_moved_all_the_time_is_shown_moved_twice_a_second_and_at_last_where_it_is() {
    let mut robot = Robot::new(config(1), Stamp(0)).unwrap();
    let at = on_the_way(3.0);
    robot.insert_scan(Stamp(1), &scan(Stamp(1), &at), &at).unwrap();
    let (mut shown, mut times) = (occupied(robot.map()), 0);
    let (seen, mut pose) = (shown.clone(), Pose::IDENTITY);
    // A thousand times in two seconds, and half a second of rest.
    for step in 1..=1_250i64 {
        let now = Stamp(step * 2_000);
        if step <= 1_000 {
            pose = Pose::from_translation([f64::from(step as i32) / 100.0, 0.0, 0.0]);
            robot.set_submap_pose(now, SubmapId::FIRST, &pose).unwrap();
        }
        while robot.poll_timeout().is_some_and(|due| due <= now) {
            robot.handle_timeout(now);
            while robot.poll_transmit(now).is_some() {}
        }
        let map = occupied(robot.map());
        times += i32::from(map != shown);
        shown = map;
    }
    assert!((3..=6).contains(&times), "{times} times in 2.5 s");
    let put = |voxel: &Voxel| resolution().voxel_at(pose.transform(resolution().centre(*voxel))).unwrap();
    assert_eq!(shown, seen.iter().map(put).collect());
    assert!(!robot.is_rebuilding());
}

#[test]
fn what_cannot_be_is_refused_and_says_why() {
    let mut swarm = Swarm::new(vec![config(1)], PERFECT, 3);
    let (now, robot) = (swarm.now, &mut swarm.robots[0]);
    let submap = |number| SubmapId::new(number).unwrap();
    let error = robot.set_submap_pose(now, submap(3), &Pose::IDENTITY).unwrap_err();
    assert!(error.to_string().contains("submap 3 has not begun: the newest of this run is 0"), "{error}");
    for bad in [[f64::NAN, 0.0, 0.0], [1e300, 0.0, 0.0], [0.0, 300_000.0, 0.0]] {
        let pose = Pose::from_translation(bad);
        assert!(matches!(robot.set_submap_pose(now, submap(0), &pose), Err(SubmapError::Pose(_))), "{bad:?}");
    }
    assert_eq!(robot.submap_pose(submap(0)), Pose::IDENTITY);
    for _ in 1..SubmapId::COUNT {
        robot.begin_submap(now).unwrap();
    }
    assert_eq!(robot.begin_submap(now), Err(SubmapError::Full));
    assert_eq!(robot.own_stream().origin, RobotId(1));
    assert_eq!(resolution().metres(), 0.2);
}

#[test]
fn a_length_or_a_reach_that_cannot_be_is_named() {
    let error = |change: fn(&mut RobotConfig)| {
        let mut config = config(1);
        change(&mut config);
        Robot::new(config, Stamp(0)).err().map(|error| error.to_string())
    };
    let length = error(|config| config.submap_length_m = Some(0.0));
    assert_eq!(length.unwrap(), "submap_length_m is 0, expected a number above 0, or none");
    let clears = error(|config| config.fusion.submap_clears_voxels = 8);
    assert_eq!(clears.unwrap(), "fusion.submap_clears_voxels is 8, expected 0 to 7");
    assert_eq!(error(|config| config.fusion.submap_clears_voxels = 7), None);
}
