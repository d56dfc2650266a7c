//! Who answers for the packages of a robot that is not heard any more.

mod swarm;

use flockmap_grid::{RobotId, Stamp, Stream};
use flockmap_sync::wire::{
    Covered, Datagram, DatagramHeader, Echo, Held, Kind, Request, TransferProgress, parse_packages,
};
use flockmap_sync::{Cast, IntervalSet, SessionConfig};
use swarm::{MS, Radio, SECOND, Swarm};

/// Packages of a former run of robot 9 that robot 1 sends within 20 s to robot 2, which holds none of them and is sent a present state of what
/// comes after the second by robot 7: one of two tiles, of which robot 2 has so many.
fn sent_beside(tiles: u32) -> usize {
    let config = SessionConfig { cast: Cast::Broadcast, ..SessionConfig::default() };
    let mut swarm = Swarm::new(80, Radio::PERFECT);
    let own = swarm.start(1, 1, config.clone());
    let former = swarm.start(9, 1, config);
    swarm.run(SECOND);
    for _ in 0..3 {
        swarm.publish(9, 300);
        swarm.run(SECOND);
    }
    swarm.stop(9);
    swarm.run(20 * SECOND);
    let robot = swarm.robots.get_mut(&1).unwrap();
    assert!(robot.session.held(former).unwrap().contains_range(1, 3));
    swarm.take_sent();
    let mut packages = 0;
    for _ in 0..80 {
        let robot = swarm.robots.get_mut(&1).unwrap();
        let now = Stamp(swarm.now + robot.clock);
        let echo = |robot, epoch_low| Echo {
            robot: RobotId(robot),
            epoch_low,
            stamp_low: (now.0 - 20 * MS) as u32,
            age_micros: 0,
        };
        let list = |intervals| IntervalSet::from_intervals(64, intervals);
        let request = Request {
            covered: Some(Covered::all_from(RobotId(0))),
            all_echoes: true,
            // Robot 9 flies in another run, and is before robot 1 in the line.
            echoes: vec![echo(own.origin.0, 1), echo(9, 2)],
            held: vec![Held { stream: former, is_oldest_wanted: false, from: 1, held: list(Vec::new()) }],
            transfers: vec![TransferProgress {
                source: RobotId(7),
                stream: former,
                since: 2,
                upto: 3,
                set: 5,
                tiles: 2,
                from: 1,
                accepted: list(vec![(1, tiles)]),
            }],
            ..Request::default()
        };
        let sender = Stream { origin: RobotId(2), epoch: 1 };
        let header = DatagramHeader { kind: Kind::Request, swarm: 0, sender, stamp: Stamp(now.0 - 10 * MS) };
        robot.session.handle_datagram(now, &request.emit(header, 1_200)).unwrap();
        swarm.run(250 * MS);
        for (_, bytes) in swarm.take_sent() {
            let datagram = Datagram::new_checked(&bytes).unwrap();
            if datagram.header().kind == Kind::Packages {
                packages += parse_packages(&datagram).unwrap().len();
            }
        }
    }
    packages
}

#[test]
fn a_relay_leaves_a_peer_to_the_robot_that_sends_it_a_present_state() {
    assert_eq!(sent_beside(1), 0);
}

/// Once it left the peer to that robot, which had nothing more to send, until the peer forgot the present state after five minutes.
#[test]
fn a_present_state_that_is_complete_and_waits_for_packages_before_it_keeps_no_relay_from_sending_them() {
    assert!(sent_beside(2) >= 3);
}
