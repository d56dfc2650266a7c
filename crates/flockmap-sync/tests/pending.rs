//! Packages that the driver keeps pending, or replaces by a snapshot.

mod swarm;

use flockmap_grid::{RobotId, Stamp};
use flockmap_sync::{SessionConfig, Verdict};
use swarm::{MS, Radio, SECOND, Swarm};

const ONE: RobotId = RobotId(1);

/// Robots that know each other, of which the last keeps or gives up the third package of the first.
fn swarm(count: u16, radio: Radio, prepare: impl Fn(&mut swarm::Robot)) -> Swarm {
    let config = SessionConfig { relay_delay_ms: 500, ..SessionConfig::default() };
    let mut swarm = Swarm::of(count, 31, radio, &config);
    swarm.run(2 * SECOND);
    prepare(swarm.robots.get_mut(&count).unwrap());
    swarm
}

fn publish(swarm: &mut Swarm, batches: usize) {
    for _ in 0..batches {
        swarm.publish(1, 100);
        swarm.run(100 * MS);
    }
}

#[test]
fn what_is_kept_undecided_is_neither_asked_for_nor_sent_again_nor_passed_on() {
    let mut swarm = swarm(2, Radio::PERFECT, |robot| robot.keeps = vec![(ONE, 3)]);
    publish(&mut swarm, 6);
    swarm.run(20 * SECOND);
    let stream = swarm.stream(1);
    let robot = &swarm.robots[&2];
    assert_eq!(robot.pending.len(), 1);
    assert_eq!(robot.session.received(stream).unwrap().missing(1, 6).collect::<Vec<_>>(), [(3, 3)]);
    assert!(robot.session.store().get(stream, 3).is_none());
    assert_eq!((robot.session.counters().duplicates, robot.session.counters().gap_requests), (0, 0));
    assert_eq!(swarm.robots[&1].session.counters().lost, 0);
    // The sender sees nothing missing.
    let (peer, _, prefix) = swarm.robots[&1].session.own_received_by_peers().next().unwrap();
    let newest = swarm.robots[&1].session.store().newest_known(stream);
    assert_eq!((peer, prefix), (swarm.stream(2), newest));

    // One that only the second robot hears gets it from nobody until it is decided.
    let robot = swarm.robots.get_mut(&2).unwrap();
    let (now, package) = (Stamp(swarm.now + robot.clock), robot.pending.remove(0));
    robot.session.verdict(now, &package, Verdict::Merged);
    assert!(robot.session.received(stream).unwrap().contains_range(1, 6));
    assert!(robot.session.store().get(stream, 3).is_some());
}

#[test]
fn a_duplicate_from_another_robot_is_not_delivered_while_the_first_is_undecided() {
    let mut swarm = swarm(3, Radio::lossy(0.3), |robot| robot.keeps = vec![(ONE, 3)]);
    publish(&mut swarm, 6);
    swarm.run(20 * SECOND);
    assert_eq!(swarm.robots[&3].pending.len(), 1);
}

#[test]
fn what_is_given_up_comes_back_as_a_snapshot_from_the_origin() {
    let mut swarm = swarm(2, Radio::PERFECT, |robot| robot.gives_up = vec![(ONE, 3), (ONE, 5)]);
    publish(&mut swarm, 6);
    swarm.run(3 * SECOND);
    let stream = swarm.stream(1);
    swarm.assert_in_sync(&[stream]);
    let counters = *swarm.robots[&2].session.counters();
    assert_eq!(counters.undecodable, 2);
    assert!((1..=2).contains(&counters.caught_up));
    // Then there is peace.
    let wanted = swarm.robots[&1].session.counters().snapshots_wanted;
    swarm.run(10 * SECOND);
    assert_eq!(swarm.robots[&1].session.counters().snapshots_wanted, wanted);
    publish(&mut swarm, 2);
    swarm.run(SECOND);
    swarm.assert_in_sync(&[stream]);
}

#[test]
fn where_the_origin_is_gone_another_robot_gives_the_snapshot() {
    for radio in [Radio::PERFECT, Radio::lossy(0.3)] {
        let mut swarm = swarm(4, radio, |robot| robot.gives_up = vec![(ONE, 3)]);
        let stream = swarm.stream(1);
        publish(&mut swarm, 6);
        swarm.cut(1, 4);
        swarm.run(2 * SECOND);
        swarm.stop(1);
        swarm.run(30 * SECOND);
        swarm.assert_in_sync(&[stream]);
        assert!(swarm.robots[&4].session.counters().caught_up > 0);
    }
}

#[test]
fn what_waits_below_a_snapshot_needs_no_verdict_any_more() {
    let mut swarm = swarm(2, Radio::PERFECT, |robot| {
        (robot.keeps, robot.gives_up) = (vec![(ONE, 2), (ONE, 4)], vec![(ONE, 3)]);
    });
    publish(&mut swarm, 6);
    swarm.run(3 * SECOND);
    let stream = swarm.stream(1);
    swarm.assert_in_sync(&[stream]);
    let robot = swarm.robots.get_mut(&2).unwrap();
    let (now, packages) = (Stamp(swarm.now + robot.clock), std::mem::take(&mut robot.pending));
    assert_eq!(packages.len(), 2);
    let before = *robot.session.counters();
    for package in &packages {
        robot.session.verdict(now, package, Verdict::Undecodable);
        robot.session.verdict(now, package, Verdict::Damaged);
        robot.session.verdict(now, package, Verdict::Merged);
    }
    assert_eq!(*robot.session.counters(), before);
}

#[test]
fn a_package_given_up_is_not_delivered_again() {
    let mut swarm =
        swarm(3, Radio::lossy(0.3), |robot| robot.gives_up = (1..=200).map(|n| (ONE, n)).collect());
    publish(&mut swarm, 40);
    swarm.run(40 * SECOND);
    let stream = swarm.stream(1);
    swarm.assert_in_sync(&[stream]);
    let counters = swarm.robots[&3].session.counters();
    assert_eq!(counters.accepted, 0);
    let newest = swarm.robots[&1].session.store().newest_known(stream);
    assert!(counters.undecodable <= u64::from(newest) && counters.caught_up > 0, "{counters:?}");
}
