//! A copy of what a robot has of a stream, as few bytes for whoever comes late or holds a part of it.

mod common;

use common::swarm::{Random, config, scan};
use flockmap::codec::Encoder;
use flockmap::{Event, Package, Pose, Robot, Stamp, Stream};
use flockmap_store::{Coded, StreamCopy};

/// A robot that flew alone over the same few metres again and again, and all its packages.
fn flown(seed: u64) -> (Robot, Vec<Package>) {
    let mut robot = Robot::new(config(1), Stamp(0)).unwrap();
    let mut random = Random(seed);
    let mut packages = Vec::new();
    for at in 1..600i64 {
        let now = Stamp(at * 250_000);
        let pose = Pose::new([(at % 20) as f64 / 4.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]).unwrap();
        robot.insert_scan(now, &scan(&mut random, now), &pose).unwrap();
        robot.handle_timeout(now);
        while robot.poll_transmit(now).is_some() {}
        while let Some(event) = robot.poll_event() {
            if let Event::BatchClosed { packages: made, .. } = event {
                packages.extend(made);
            }
        }
    }
    (robot, packages)
}

/// A robot that has got these packages.
fn holder(packages: &[Package]) -> Robot {
    let mut robot = Robot::new(config(2), Stamp(0)).unwrap();
    give(&mut robot, packages.to_vec());
    robot
}

fn give(robot: &mut Robot, packages: Vec<Package>) {
    let now = Stamp(200_000_000);
    for package in packages {
        robot.receive_package(now, package).unwrap();
        while robot.session().has_events() {
            robot.handle_timeout(now);
        }
    }
}

fn give_coded(robot: &mut Robot, coded: Coded) {
    give(robot, coded.packages);
    if let Some(contents) = coded.contents {
        let now = Stamp(200_000_000);
        robot.restore_contents(now, contents.stream, contents.snapshot_id, &contents.intervals);
    }
}

fn digest(robot: &Robot, stream: Stream) -> Option<u64> {
    robot.fusion().layer(stream).map(|layer| layer.digest())
}

fn bytes_of(packages: &[Package]) -> usize {
    packages.iter().map(|package| package.bytes().len()).sum()
}

#[test]
fn who_comes_late_gets_the_map_and_not_its_history() {
    for seed in [1, 2] {
        let (robot, packages) = flown(seed);
        let stream = robot.own_stream();
        let coded = StreamCopy::of(&robot, stream, 0).unwrap().code(&mut Encoder::new()).unwrap();
        assert_eq!(coded.contents, None);
        let (bytes, all) = (bytes_of(&coded.packages), bytes_of(&packages));
        assert!(10 * bytes < 9 * all, "seed {seed}: {bytes} B, all packages were {all}");
        let mut late = holder(&[]);
        give_coded(&mut late, coded);
        assert_eq!(digest(&late, stream), digest(&robot, stream), "seed {seed}");
        assert_eq!(late.session().received(stream).unwrap().prefix(), packages.len() as u32);
    }
}

#[test]
fn who_holds_the_beginning_gets_what_came_after_it() {
    for seed in [1, 2, 3] {
        let (robot, packages) = flown(seed);
        let (stream, all) = (robot.own_stream(), packages.len());
        for held in [all / 3, all * 9 / 10] {
            let mut other = holder(&packages[..held]);
            let since = other.session().received(stream).unwrap().prefix();
            assert_eq!(since as usize, held);
            let code =
                |since| StreamCopy::of(&robot, stream, since).unwrap().code(&mut Encoder::new()).unwrap();
            let (rest, whole) = (code(since), code(0));
            assert!(bytes_of(&rest.packages) <= bytes_of(&whole.packages), "seed {seed}, {held} held");
            give_coded(&mut other, rest);
            assert_eq!(digest(&other, stream), digest(&robot, stream), "seed {seed}, {held} held");
            assert_eq!(other.session().received(stream).unwrap().prefix() as usize, all);
        }
    }
}

#[test]
fn a_history_with_gaps_says_what_it_contains() {
    let (robot, packages) = flown(4);
    let stream = robot.own_stream();
    // Nobody has the one in the middle: what does not build on it is held all the same.
    let gap = packages.len() / 2;
    let without: Vec<Package> = packages
        .iter()
        .enumerate()
        .filter(|(at, _)| *at != gap)
        .map(|(_, package)| package.clone())
        .collect();
    let some = holder(&without);
    let held = some.session().received(stream).unwrap();
    assert!(!held.contains(gap as u32 + 1));
    let coded = StreamCopy::of(&some, stream, 0).unwrap().code(&mut Encoder::new()).unwrap();
    assert_eq!(coded.contents.is_some(), held.prefix() < held.last().unwrap());
    let mut late = holder(&[]);
    give_coded(&mut late, coded);
    assert_eq!(late.session().received(stream), Some(held));
    assert_eq!(digest(&late, stream), digest(&some, stream));
}

#[test]
fn of_a_stream_that_is_not_there_there_is_no_copy() {
    let (robot, _) = flown(5);
    let other = Stream { epoch: 77, ..robot.own_stream() };
    assert!(StreamCopy::of(&robot, other, 0).is_none());
}
