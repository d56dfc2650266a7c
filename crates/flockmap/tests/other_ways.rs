//! Packages that come by another way than the radio: over a network of its own, from an archive.

mod common;

use common::{PERFECT, Random, Swarm, config, resolution, scan};
use flockmap::codec::Header;
use flockmap::{Cast, Event, Package, Pose, Resolution, Robot, RobotConfig, RobotId, Stamp};

/// A robot that flew alone, and all its packages.
fn flown(id: u16, seed: u64) -> (Robot, Vec<Package>) {
    let mut robot = Robot::new(config(id), Stamp(0)).unwrap();
    let mut random = Random(seed);
    let mut packages = Vec::new();
    for at in 1..60i64 {
        let now = Stamp(at * 250_000);
        let pose = Pose::new([at as f64 / 4.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]).unwrap();
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

fn shuffle<T>(random: &mut Random, things: &mut [T]) {
    for at in (1..things.len()).rev() {
        things.swap(at, (random.next() % (at as u64 + 1)) as usize);
    }
}

/// Lets a robot do what it has put off.
fn merge(robot: &mut Robot, now: Stamp) {
    for step in 0..10_000 {
        if !robot.session().has_events() {
            return;
        }
        robot.handle_timeout(now.plus_micros(step));
    }
    panic!("it never ends");
}

#[test]
fn in_any_order_and_more_than_once_they_make_the_layer_that_they_were_made_of() {
    for seed in [1, 2, 3] {
        let (robot, packages) = flown(1, seed);
        assert!(packages.len() > 20, "seed {seed}");
        let mut random = Random(seed);
        let mut given = packages.clone();
        given
            .extend(packages.iter().filter(|_| random.next().is_multiple_of(3)).cloned().collect::<Vec<_>>());
        shuffle(&mut random, &mut given);
        let mut other = Robot::new(config(2), Stamp(0)).unwrap();
        let now = Stamp(20_000_000);
        for package in given {
            other.receive_package(now, package).unwrap();
        }
        merge(&mut other, now);
        let stream = robot.own_stream();
        let digests = [&robot, &other].map(|of| of.fusion().layer(stream).unwrap().digest());
        assert_eq!(digests[0], digests[1], "seed {seed}");
        assert_eq!(other.session().received(stream).unwrap().count(), packages.len() as u64, "seed {seed}");
        // To the robot itself they are no news.
        let mut robot = robot;
        let before = robot.fusion().map().count();
        for package in packages {
            robot.receive_package(now, package).unwrap();
        }
        assert_eq!((robot.own_stream(), robot.fusion().map().count()), (stream, before), "seed {seed}");
    }
}

/// The package with another resolution in its header, and the check that it had.
fn with_resolution(package: &Package, metres: f64) -> Package {
    let header = Header { resolution: Resolution::from_metres(metres).unwrap(), ..*package.header() };
    let payload_at = Package::from_parts(package.header(), &[], 0).bytes().len();
    let (checked, payload) = package.bytes().split_at(payload_at);
    let check = u32::from_le_bytes(*checked.last_chunk().unwrap());
    Package::from_parts(&header, payload, check)
}

#[test]
fn a_package_with_a_damaged_resolution_is_not_held_and_comes_again() {
    let (robot, packages) = flown(1, 11);
    let stream = robot.own_stream();
    let mut other = Robot::new(config(2), Stamp(0)).unwrap();
    let mut now = Stamp(20_000_000);
    assert_eq!(with_resolution(&packages[0], 0.2), packages[0]);
    assert!(packages.iter().any(|package| !package.header().is_independent));
    for package in &packages {
        let index = package.header().index;
        other.receive_package(now, with_resolution(package, 0.3)).unwrap();
        merge(&mut other, now);
        let received = other.session().received(stream);
        assert!(received.is_none_or(|received| !received.contains(index)), "{index}");
        // It is asked for again after 10 s.
        now = now.plus_micros(11_000_000);
        other.handle_timeout(now);
        other.receive_package(now, package.clone()).unwrap();
        merge(&mut other, now);
        assert!(other.session().received(stream).unwrap().contains(index), "{index}");
    }
    assert_eq!(other.counters().damaged, packages.len() as u64);
    assert_eq!(other.counters().foreign_resolution, 0);
    let digests = [&robot, &other].map(|of| of.fusion().layer(stream).unwrap().digest());
    assert_eq!(digests[0], digests[1]);
}

#[test]
fn packages_of_a_run_with_another_resolution_are_held_and_not_merged() {
    let (robot, packages) = flown(1, 11);
    let mut options = config(2);
    options.mapper.resolution = Resolution::from_metres(0.3).unwrap();
    let mut other = Robot::new(options, Stamp(0)).unwrap();
    let now = Stamp(20_000_000);
    let count = packages.len() as u64;
    for package in packages {
        other.receive_package(now, package).unwrap();
    }
    merge(&mut other, now);
    assert_eq!(other.session().received(robot.own_stream()).unwrap().count(), count);
    assert_eq!((other.counters().foreign_resolution, other.counters().damaged), (count, 0));
    assert!(other.fusion().layer(robot.own_stream()).is_none());
}

#[test]
fn what_is_lacking_is_waited_for_and_no_voxel_is_wrong_meanwhile() {
    let (robot, packages) = flown(1, 7);
    let stream = robot.own_stream();
    let mut other = Robot::new(config(2), Stamp(0)).unwrap();
    let now = Stamp(20_000_000);
    let late = packages.len() / 3;
    for (at, package) in packages.iter().enumerate() {
        if at != late {
            other.receive_package(now, package.clone()).unwrap();
        }
    }
    merge(&mut other, now);
    assert!(!other.session().received(stream).unwrap().contains(late as u32 + 1));
    other.receive_package(now, packages[late].clone()).unwrap();
    merge(&mut other, now);
    let digests = [&robot, &other].map(|of| of.fusion().layer(stream).unwrap().digest());
    assert_eq!(digests[0], digests[1]);
}

#[test]
fn they_are_sent_on_over_the_radio_where_all_hear_each_other() {
    let (flyer, packages) = flown(9, 5);
    for cast in [Cast::Unicast, Cast::Broadcast] {
        let mut configs: Vec<RobotConfig> = (1..=3).map(config).collect();
        configs.iter_mut().for_each(|config| config.session.cast = cast);
        let mut swarm = Swarm::new(configs, PERFECT, 5);
        // They have heard each other for long when it comes, and one of them maps.
        let mut random = Random(6);
        for _ in 0..8 {
            let scan = scan(&mut random, swarm.now);
            swarm.scan(1, &scan, &Pose::IDENTITY);
            swarm.run(1_000);
        }
        for package in &packages {
            let now = swarm.now;
            swarm.robots[0].receive_package(now, package.clone()).unwrap();
        }
        swarm.settle(20_000);
        let stream = flyer.own_stream();
        for robot in &swarm.robots {
            let layer = robot.fusion().layer(stream).expect("the layer of a robot that nobody hears");
            assert_eq!(
                Some(layer.digest()),
                flyer.fusion().layer(stream).map(|layer| layer.digest()),
                "{cast:?}"
            );
        }
        assert!(swarm.agrees(), "{cast:?}");
        swarm.assert_layers_equal_own_maps(5);
    }
}

#[test]
fn where_there_is_no_room_it_says_so() {
    let mut few = RobotConfig::new(RobotId(2), resolution(), 6.0);
    few.session.streams_max = 2;
    let mut other = Robot::new(few, Stamp(0)).unwrap();
    let mut refused = 0;
    for id in 3..9 {
        let (_, packages) = flown(id, u64::from(id));
        refused += u32::from(other.receive_package(Stamp(20_000_000), packages[0].clone()).is_err());
    }
    assert_eq!(refused, 4);
}
