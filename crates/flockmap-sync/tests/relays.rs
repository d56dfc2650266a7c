//! Who answers for the packages of a robot that is not heard any more.

mod swarm;

use flockmap_grid::RobotId;
use flockmap_sync::wire::{Echo, Received, Request, TransferProgress};
use flockmap_sync::{Cast, IntervalSet, SessionConfig};
use swarm::{MS, Radio, SECOND, Swarm};

/// How many packages of a former run of robot 9 robot 1 sends within 20 s. Robot 2 has received none of them,
/// and says that robot 7 sends it a snapshot of two chunks, of what comes after the second package; it has
/// the first `chunks` of them.
fn sent_beside(chunks: u32) -> usize {
    let config = SessionConfig { cast: Cast::Broadcast, ..SessionConfig::default() };
    let mut swarm = Swarm::new(80, Radio::PERFECT);
    swarm.start(1, 1, config.clone());
    let former = swarm.start(9, 1, config);
    swarm.run(SECOND);
    for _ in 0..3 {
        swarm.publish(9, 300);
        swarm.run(SECOND);
    }
    swarm.stop(9);
    swarm.run(20 * SECOND);
    assert!(swarm.robots[&1].session.received(former).unwrap().contains_range(1, 3));
    swarm.take_sent();
    let list = |intervals| IntervalSet::from_intervals(64, intervals);
    let request = Request {
        // Robot 9 flies in a later run, and comes before robot 1 in the line of those who answer.
        echoes: vec![Echo { robot: RobotId(9), epoch_low: 2, stamp_low: 0, age_micros: 0 }],
        received: vec![Received {
            in_part: None,
            stream: former,
            is_oldest_wanted: false,
            from: 1,
            received: list(Vec::new()),
        }],
        transfers: vec![TransferProgress {
            source: RobotId(7),
            stream: former,
            since: 2,
            upto: 3,
            snapshot_id: 5,
            chunks: 2,
            from: 1,
            accepted: list(vec![(1, chunks)]),
        }],
        ..Request::default()
    };
    for _ in 0..80 {
        swarm.hear_request(1, 2, request.clone());
        swarm.run(250 * MS);
    }
    swarm.take_sent_packages().len()
}

#[test]
fn a_relay_leaves_a_peer_to_the_robot_that_sends_it_a_snapshot() {
    assert_eq!(sent_beside(1), 0);
}

/// Once it left the peer to that robot, which had nothing more to send, until the peer forgot the snapshot
/// after five minutes.
#[test]
fn a_snapshot_that_is_complete_and_waits_for_packages_before_it_keeps_no_relay_from_sending_them() {
    assert!(sent_beside(2) >= 3);
}

/// The last package of a robot that is gone reached only the last one in the line of relays. Once that one waited a relay
/// delay for each before it, none of which had the package.
#[test]
fn who_alone_holds_a_package_does_not_wait_for_those_before_it_in_the_line() {
    let mut swarm = Swarm::new(81, Radio::PERFECT);
    for id in 1..=4 {
        swarm.start(id, 1, SessionConfig::default());
    }
    let former = swarm.start(9, 1, SessionConfig::default());
    swarm.run(SECOND);
    let mut last = swarm.publish(9, 300);
    swarm.run(SECOND);
    for id in 1..=3 {
        swarm.cut(id, 9);
        swarm.cut(id, 4);
    }
    last += swarm.publish(9, 300);
    swarm.run(100 * MS);
    swarm.stop(9);
    swarm.run(12 * SECOND);
    let lacks = |swarm: &Swarm, id: u16| {
        let received = swarm.robots[&id].session.received(former);
        received.is_none_or(|received| !received.contains_range(last as u32, last as u32))
    };
    assert!((1..=3).all(|id| lacks(&swarm, id)) && !lacks(&swarm, 4));
    (1..=3).for_each(|id| swarm.join(id, 4));
    swarm.run(5 * SECOND);
    let later: Vec<u16> = (1..=3).filter(|id| lacks(&swarm, *id)).collect();
    assert!(later.is_empty(), "robots {later:?} have not got it yet");
}
