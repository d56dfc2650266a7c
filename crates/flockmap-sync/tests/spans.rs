//! Snapshots of a part of the history: what somebody misses and nobody has stored any more.

mod swarm;

use flockmap_codec::{Codec, Encoder, PACKAGE_BYTES_MAX, Span};
use flockmap_grid::{Resolution, Stamp};
use flockmap_sync::{Cast, SessionConfig};
use swarm::{MS, Radio, SECOND, Swarm};

/// A store that keeps some 60 packages.
fn small() -> SessionConfig {
    SessionConfig {
        store_bytes_max: 80_000,
        snapshot_bytes_min: None,
        congestion_control: false,
        ..SessionConfig::default()
    }
}

fn fly(swarm: &mut Swarm, batches: usize) {
    for _ in 0..batches {
        swarm.publish(1, 900);
        swarm.run(50 * MS);
    }
}

/// Robots 1 and 2 map.
fn fly_both(swarm: &mut Swarm, batches: usize) {
    for _ in 0..batches {
        swarm.publish(1, 900);
        swarm.publish(2, 900);
        swarm.run(50 * MS);
    }
}

/// Bytes of the state of robot 1's layer since a package, coded once.
fn coded_once(swarm: &Swarm, since: u32) -> usize {
    let robot = &swarm.robots[&1];
    let stream = robot.session.own();
    let upto = robot.session.received(stream).unwrap().prefix();
    let next = robot.session.store().stamp_not_after(stream, since + 1).unwrap();
    let newer_than = (since > 0).then(|| next.plus_micros(-1));
    let state = robot.layers[&stream].snapshot_voxels(newer_than).unwrap();
    let resolution = Resolution::from_metres(0.1).unwrap();
    let span = Span::new(stream, since, upto);
    let chunks = Encoder::new().encode_span(Codec::Paper, span, resolution, &state, PACKAGE_BYTES_MAX);
    chunks.unwrap().iter().map(|chunk| chunk.bytes().len()).sum()
}

fn wanted(swarm: &Swarm, id: u16) -> Vec<&String> {
    swarm.robots[&id].events.iter().filter(|event| event.starts_with("wanted")).collect()
}

#[test]
fn what_the_store_dropped_is_repaired_by_a_span_of_it_and_not_by_the_whole_map() {
    let mut swarm = Swarm::of(2, 31, Radio::PERFECT, &small());
    swarm.run(SECOND);
    fly(&mut swarm, 150);
    swarm.run(2 * SECOND);
    let own = swarm.stream(1);
    let prefix = swarm.robots[&2].session.received(own).unwrap().prefix();
    assert_eq!(prefix, swarm.robots[&1].session.store().newest_known(own));
    swarm.cut(1, 2);
    fly(&mut swarm, 50);
    assert!(swarm.robots[&1].session.store().get(own, prefix + 1).is_none(), "still stored");
    let (span, whole) = (coded_once(&swarm, prefix), coded_once(&swarm, 0));
    assert!(2 * span < whole, "{span} of {whole}");
    let before = swarm.robots[&1].session.counters().packages_out.bytes as usize;
    swarm.join(1, 2);
    swarm.run(20 * SECOND);
    swarm.assert_in_sync(&[own]);
    let spent = swarm.robots[&1].session.counters().packages_out.bytes as usize - before;
    println!("span {span} bytes, whole {whole}, on the wire {spent}");
    assert!(5 * spent <= 6 * span, "{spent} bytes for a span of {span}");
    assert_eq!(swarm.robots[&2].session.counters().caught_up, 1);
    // Later packages go on from there.
    fly(&mut swarm, 3);
    swarm.run(3 * SECOND);
    swarm.assert_in_sync(&[own]);
}

#[test]
fn peers_that_miss_different_parts_get_each_its_own_by_every_cast_and_loss() {
    for (seed, cast, loss) in [
        (40, Cast::Unicast, 0.0),
        (41, Cast::Unicast, 0.3),
        (42, Cast::Broadcast, 0.0),
        (43, Cast::Broadcast, 0.3),
    ] {
        let config = SessionConfig { cast, ..small() };
        let mut swarm = Swarm::of(3, seed, Radio::lossy(loss), &config);
        swarm.run(SECOND);
        fly(&mut swarm, 40);
        swarm.run(4 * SECOND);
        for other in [1, 3] {
            swarm.cut(2, other);
        }
        fly(&mut swarm, 40);
        swarm.run(4 * SECOND);
        swarm.cut(1, 3);
        fly(&mut swarm, 60);
        swarm.run(SECOND);
        for (a, b) in [(1, 2), (1, 3), (2, 3)] {
            swarm.join(a, b);
        }
        swarm.run(60 * SECOND);
        swarm.assert_in_sync(&[swarm.stream(1)]);
        assert!(swarm.robots[&2].session.counters().caught_up > 0, "seed {seed}");
        assert!(swarm.robots[&3].session.counters().caught_up > 0, "seed {seed}");
        assert!(wanted(&swarm, 1).iter().all(|event| !event.contains("since 0")), "{:?}", wanted(&swarm, 1));
    }
}

#[test]
fn a_package_given_up_is_healed_by_a_span_from_there_on() {
    let mut swarm = Swarm::of(2, 51, Radio::lossy(0.1), &SessionConfig::default());
    swarm.run(SECOND);
    let own = swarm.stream(1);
    fly(&mut swarm, 20);
    let next = swarm.robots[&1].session.store().newest_known(own) + 1;
    swarm.robots.get_mut(&2).unwrap().gives_up = vec![(own.origin, next), (own.origin, next + 2)];
    fly(&mut swarm, 5);
    swarm.run(20 * SECOND);
    swarm.assert_in_sync(&[own]);
    assert!(swarm.robots[&2].session.counters().undecodable >= 1);
    let since = format!("since {} ", next - 1);
    assert!(wanted(&swarm, 1).iter().any(|event| event.contains(&since)), "{:?}", wanted(&swarm, 1));
}

#[test]
fn who_joins_with_nothing_gets_the_whole_state_though_the_store_has_dropped_its_packages() {
    let mut swarm = Swarm::of(1, 52, Radio::lossy(0.2), &small());
    fly(&mut swarm, 150);
    swarm.start(2, 1, small());
    swarm.run(20 * SECOND);
    swarm.assert_in_sync(&[swarm.stream(1)]);
    assert_eq!(swarm.robots[&2].session.counters().caught_up, 1);
}

#[test]
fn a_rebooted_robot_gets_its_former_run_back_from_those_who_hold_it_and_do_not_store_it() {
    let mut swarm = Swarm::of(3, 53, Radio::lossy(0.2), &small());
    swarm.run(2 * SECOND);
    fly(&mut swarm, 120);
    swarm.run(10 * SECOND);
    let old = swarm.stream(1);
    let digest = swarm.robots[&1].layer(old);
    swarm.stop(1);
    swarm.run(SECOND);
    let new = swarm.start(1, 2, small());
    fly(&mut swarm, 20);
    swarm.run(60 * SECOND);
    swarm.assert_in_sync(&[old, new]);
    assert_eq!(swarm.robots[&1].layer(old), digest);
}

/// A disk may keep sets of chunks whose packages before them it has lost.
#[test]
fn sets_that_nothing_more_comes_of_take_no_place_from_one_that_goes_on() {
    let mut swarm = Swarm::of(2, 61, Radio::PERFECT, &small());
    swarm.run(SECOND);
    fly(&mut swarm, 150);
    let own = swarm.stream(1);
    let chunks_of = |swarm: &Swarm, since: u32| {
        let robot = &swarm.robots[&1];
        let upto = robot.session.received(own).unwrap().prefix();
        let newer_than = robot.session.store().stamp_not_after(own, since + 1).unwrap().plus_micros(-1);
        let state = robot.layers[&own].snapshot_voxels(Some(newer_than)).unwrap();
        let resolution = Resolution::from_metres(0.1).unwrap();
        let span = Span::new(own, since, upto);
        Encoder::new().encode_span(Codec::Raw, span, resolution, &state, PACKAGE_BYTES_MAX).unwrap()
    };
    let upto = swarm.robots[&1].session.received(own).unwrap().prefix();
    let sets = [chunks_of(&swarm, upto - 2), chunks_of(&swarm, upto - 4)];
    swarm.stop(2);
    let config = SessionConfig { transfers_max: 2, ..small() };
    swarm.start(2, 2, config);
    let robot = swarm.robots.get_mut(&2).unwrap();
    let now = Stamp(swarm.now + robot.clock);
    for chunk in sets.iter().flatten() {
        assert!(robot.session.deliver_package(now, chunk.clone()));
    }
    swarm.drive(2);
    assert_eq!(swarm.robots[&2].session.load().transfers, 2, "both wait for what is before them");
    // Nothing of the first packages is stored any more: a state has to come.
    swarm.run(20 * SECOND);
    swarm.assert_in_sync(&[own]);
    assert!(swarm.robots[&2].session.counters().transfers_dropped > 0);
}

/// By broadcast each hears the chunks of both. What is sent to one is not to push out again and again what is
/// sent to the other.
#[test]
fn sets_for_different_robots_do_not_take_each_others_place_for_ever() {
    let config = SessionConfig {
        cast: Cast::Broadcast,
        radio_bytes_per_s: Some(3_000),
        transfers_max: 1,
        store_bytes_max: 8_000,
        ..small()
    };
    let mut swarm = Swarm::of(2, 67, Radio::PERFECT, &config);
    swarm.run(SECOND);
    fly(&mut swarm, 20);
    swarm.run(60 * SECOND);
    let own = swarm.stream(1);
    swarm.assert_in_sync(&[own]);
    swarm.cut(1, 2);
    fly(&mut swarm, 20);
    swarm.join(1, 2);
    swarm.run(SECOND);
    swarm.start(3, 1, config);
    swarm.run(60 * SECOND);
    swarm.assert_in_sync(&[own]);
}

/// Of two sets only one fits in at a time.
#[test]
fn sets_that_are_sent_do_not_push_each_other_out_at_their_sender() {
    let config = SessionConfig {
        radio_bytes_per_s: Some(1_500),
        in_flight_max: 2,
        store_bytes_max: 8_000,
        snapshot_bytes_max: 9_000,
        ..small()
    };
    let mut swarm = Swarm::of(2, 71, Radio::PERFECT, &config);
    swarm.run(SECOND);
    fly_both(&mut swarm, 20);
    swarm.run(60 * SECOND);
    let streams = [swarm.stream(1), swarm.stream(2)];
    swarm.assert_in_sync(&streams);
    // Who joins gets both from the one robot that it hears.
    let asked = wanted(&swarm, 1).len();
    swarm.cut(2, 3);
    swarm.start(3, 1, config);
    swarm.run(90 * SECOND);
    // Once for each, and once more for the one that had to wait for the other.
    let asked = wanted(&swarm, 1).len() - asked;
    assert!(asked <= 3, "asked {asked} times for two states");
    swarm.assert_in_sync(&streams);
}

#[test]
fn who_has_no_place_for_a_set_is_not_sent_it_over_and_over() {
    let config = SessionConfig { store_bytes_max: 30_000, transfers_max: 1, ..small() };
    let thin = SessionConfig { radio_bytes_per_s: Some(500), ..config.clone() };
    let mut swarm = Swarm::new(73, Radio::PERFECT);
    swarm.start(1, 1, thin);
    swarm.start(2, 1, config.clone());
    swarm.run(SECOND);
    fly_both(&mut swarm, 80);
    swarm.run(400 * SECOND);
    let streams = [swarm.stream(1), swarm.stream(2)];
    swarm.assert_in_sync(&streams);
    // Who joins is sent the one slowly; the other has no place so long.
    swarm.cut(2, 3);
    swarm.start(3, 1, config);
    swarm.run(5 * SECOND);
    let sent = swarm.robots[&2].session.counters().chunks_sent;
    swarm.join(2, 3);
    swarm.run(20 * SECOND);
    let sent = swarm.robots[&2].session.counters().chunks_sent - sent;
    assert!(sent < 60, "{sent} chunks in vain");
    swarm.run(200 * SECOND);
    swarm.assert_in_sync(&streams);
}

/// Once a snapshot of a run that its sender had forgotten stayed the first to be offered, and nothing else
/// was ever offered again.
#[test]
fn a_snapshot_that_is_not_kept_any_more_keeps_no_other_from_being_offered() {
    let config = SessionConfig { store_bytes_max: 12_000, streams_max: 3, ..small() };
    let mut swarm = Swarm::new(75, Radio::PERFECT);
    swarm.start(1, 1, config.clone());
    let map = |swarm: &mut Swarm, epoch: u64| {
        let run = swarm.start(3, epoch, config.clone());
        for _ in 0..40 {
            swarm.publish(3, 900);
            swarm.run(50 * MS);
        }
        swarm.run(10 * SECOND);
        swarm.stop(3);
        run
    };
    let [first, second] = [1, 2].map(|epoch| map(&mut swarm, epoch));
    // Robot 2 is heard by robot 1 and does not hear it: all that it is sent gets lost, time and again.
    swarm.cut(1, 3);
    swarm.cut.insert((1, 2));
    swarm.start(2, 1, config.clone());
    swarm.run(60 * SECOND);
    // Newer runs that robot 2 names take the place of the oldest.
    let mut epochs = 3..9;
    while swarm.robots[&1].session.received(first).is_some() {
        map(&mut swarm, epochs.next().expect("the first run is forgotten"));
    }
    swarm.join(1, 2);
    swarm.run(120 * SECOND);
    let [one, two] = [1, 2].map(|id| swarm.robots[&id].layer(second));
    assert!(one != 0 && one == two, "{second:?}");
}
