//! Whole robots over a bad radio, in virtual time: in the end everyone knows what anyone has seen.

mod common;

use common::{PERFECT, Radio, Random, Swarm, config, scan};
use flockmap::{Codec, Event, Pose, Robot, RobotConfig, RobotId, Stamp, State, Voxel};

const BAD: Radio = Radio { loss: 0.3, duplication: 0.1, damage: 0.05, delay_ms: (5.0, 60.0) };

fn fly(swarm: &mut Swarm, seconds: i64, seed: u64) {
    let mut random = Random(seed ^ 0xf117);
    for tick in 0..seconds * 10 {
        for robot in 0..swarm.robots.len() {
            let at = [tick as f64 * 0.1, robot as f64 * 2.0, 0.0];
            let scan = scan(&mut random, swarm.now);
            swarm.scan(robot, &scan, &Pose::from_yaw(at, random.unit()));
        }
        swarm.run(100);
    }
}

#[test]
fn maps_agree_over_a_radio_that_loses_repeats_reorders_and_damages() {
    for seed in 1..=10 {
        let codec = Codec::ALL[seed as usize % Codec::ALL.len()];
        let configs = (1..=3).map(|id| RobotConfig { codec, ..config(id) }).collect();
        let mut swarm = Swarm::new(configs, BAD, seed);
        fly(&mut swarm, 3, seed);
        swarm.settle(60_000);
        assert!(swarm.agrees(), "seed {seed}: not equal after a minute");
        swarm.assert_layers_equal_own_maps(seed);
        let damaged: u64 = swarm.robots.iter().map(|robot| robot.session().counters().damaged).sum();
        assert!(damaged > 0, "seed {seed}: the damage was noticed");
    }
}

#[test]
fn the_middle_robot_of_three_in_a_line_forwards() {
    let mut swarm = Swarm::new((1..=3).map(config).collect(), PERFECT, 7);
    swarm.cut = vec![(0, 2)];
    fly(&mut swarm, 3, 7);
    swarm.settle(20_000);
    assert!(swarm.agrees());
    assert!(swarm.robots[1].session().counters().relayed > 0);
}

#[test]
fn a_late_joiner_gets_the_state_and_not_the_history() {
    let mut configs: Vec<RobotConfig> = (1..=2).map(config).collect();
    configs[0].session.snapshot_bytes_min = Some(10_000);
    configs[0].codec = Codec::Raw;
    let mut swarm = Swarm::new(configs, PERFECT, 3);
    swarm.cut = vec![(0, 1)];
    let mut random = Random(3);
    for _ in 0..100 {
        // In one place, the same voxels flip again and again: much history, little map.
        let scan = scan(&mut random, swarm.now);
        swarm.scan(0, &scan, &Pose::IDENTITY);
        swarm.run(100);
    }
    let history = swarm.robots[0].counters().package_bytes;
    let before = swarm.bytes;
    swarm.cut.clear();
    swarm.settle(20_000);
    assert!(swarm.agrees());
    assert!(swarm.events[1].iter().any(|e| matches!(e, Event::CaughtUp { .. })));
    assert!(swarm.bytes - before < history, "{} bytes for {history} of history", swarm.bytes - before);
}

#[test]
fn a_robot_that_starts_again_gets_its_former_run_back() {
    let mut swarm = Swarm::new((1..=2).map(config).collect(), PERFECT, 5);
    fly(&mut swarm, 2, 5);
    swarm.settle(10_000);
    let former = swarm.robots[0].own_stream();
    let digest = swarm.robots[0].fusion().layer(former).unwrap().digest();
    swarm.robots[0] = Robot::new(RobotConfig { epoch: 2, ..config(1) }, swarm.now).unwrap();
    fly(&mut swarm, 2, 6);
    swarm.settle(20_000);
    assert!(swarm.agrees());
    assert_eq!(swarm.robots[0].fusion().layer(former).unwrap().digest(), digest);
    assert_eq!(swarm.robots[1].fusion().layers().count(), 3);
}

#[test]
fn obstacles_arrive_before_free_space() {
    let mut configs: Vec<RobotConfig> = (1..=2).map(config).collect();
    configs[0].batch.publish_period_ms = 2_000;
    configs[0].batch.obstacle_period_ms = Some(100);
    let mut swarm = Swarm::new(configs, PERFECT, 9);
    // They get to know each other first.
    swarm.run(1_500);
    let scan = flockmap::Scan { stamp: swarm.now, points: vec![[3.0, 0.1, 0.1]], no_returns: Vec::new() };
    swarm.scan(0, &scan, &Pose::IDENTITY);
    swarm.run(150);
    assert_eq!(swarm.robots[1].map().state(Voxel::new(15, 0, 0)), State::Occupied);
    assert_eq!(swarm.robots[1].map().state(Voxel::new(5, 0, 0)), State::Unknown);
    swarm.run(2_000);
    assert_eq!(swarm.robots[1].map().state(Voxel::new(5, 0, 0)), State::Free);
}

#[test]
fn a_team_mates_frame_may_change_later_without_a_resend() {
    let mut swarm = Swarm::new((1..=2).map(config).collect(), PERFECT, 11);
    let scan = flockmap::Scan { stamp: swarm.now, points: vec![[3.0, 0.1, 0.1]], no_returns: Vec::new() };
    swarm.scan(0, &scan, &Pose::IDENTITY);
    swarm.settle(10_000);
    let (bytes, now) = (swarm.bytes, swarm.now);
    let bob = &mut swarm.robots[1];
    assert_eq!(bob.map().state_at([3.1, 0.1, 0.1]), State::Occupied);
    let turned = Pose::from_yaw([0.0, 10.0, 0.0], core::f64::consts::FRAC_PI_2);
    bob.set_alignment(RobotId(1), &turned).unwrap();
    // It comes into force by calls that are due; until then the map stands.
    assert_eq!(bob.map().state_at([3.1, 0.1, 0.1]), State::Occupied);
    let mut calls = 0;
    while bob.is_rebuilding() {
        assert!(bob.poll_timeout().unwrap() <= now);
        bob.handle_timeout(now);
        calls += 1;
    }
    assert!((1..10).contains(&calls), "{calls}");
    assert_eq!(bob.map().state_at([3.1, 0.1, 0.1]), State::Unknown);
    assert_eq!(bob.map().state_at(turned.transform([3.1, 0.1, 0.1])), State::Occupied);
    assert_eq!(swarm.bytes, bytes);
}

#[test]
fn a_team_mate_in_sight_is_not_mapped() {
    let mut robot = Robot::new(config(1), Stamp(0)).unwrap();
    robot.set_teammate(RobotId(2), [3.0, 0.0, 0.0], Stamp(0)).unwrap();
    let scan = |stamp| flockmap::Scan { stamp, points: vec![[2.9, 0.1, 0.1]], no_returns: Vec::new() };
    robot.insert_scan(Stamp(100_000), &scan(Stamp(100_000)), &Pose::IDENTITY).unwrap();
    assert_eq!(robot.map().state_at([2.9, 0.1, 0.1]), State::Unknown);
    assert_eq!(robot.counters().points_masked, 1);
    // Two seconds later nobody knows where the team-mate is: what is seen is an obstacle.
    robot.insert_scan(Stamp(2_100_000), &scan(Stamp(2_100_000)), &Pose::IDENTITY).unwrap();
    assert_eq!(robot.map().state_at([2.9, 0.1, 0.1]), State::Occupied);
}

#[test]
fn another_resolution_is_refused_and_said() {
    let mut configs: Vec<RobotConfig> = (1..=2).map(config).collect();
    configs[0].mapper.resolution = flockmap::Resolution::from_metres(0.1).unwrap();
    let mut swarm = Swarm::new(configs, PERFECT, 13);
    fly(&mut swarm, 1, 13);
    swarm.run(3_000);
    assert!(swarm.robots[1].counters().foreign_resolution > 0);
    assert!(swarm.robots[1].fusion().layer(swarm.robots[0].own_stream()).is_none());
    let said = swarm.events[1].iter().any(|e| {
        matches!(e, Event::Refused { reason, .. }
        if reason.to_string().contains("give all robots the same resolution"))
    });
    assert!(said);
}

#[test]
fn random_datagrams_change_nothing() {
    let mut swarm = Swarm::new((1..=2).map(config).collect(), PERFECT, 17);
    fly(&mut swarm, 1, 17);
    swarm.settle(10_000);
    let digest = |swarm: &Swarm| -> Vec<u64> {
        swarm.robots[1].fusion().layers().map(|(_, layer)| layer.digest()).collect()
    };
    let before = digest(&swarm);
    let mut random = Random(17);
    for length in 0..600usize {
        let bytes: Vec<u8> = (0..length * 2).map(|_| random.next() as u8).collect();
        assert!(swarm.robots[1].handle_datagram(swarm.now, &bytes).is_err());
    }
    assert_eq!(digest(&swarm), before);
}
