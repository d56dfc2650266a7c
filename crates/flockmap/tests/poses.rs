//! Where the robots are, as each of them knows.

#[allow(dead_code, reason = "only the configuration is used here")]
mod common;

use common::{config, resolution};
use flockmap::{Pose, Robot, RobotId, Scan, Stamp};

/// A wall two metres ahead.
fn scan(stamp: Stamp) -> Scan {
    let points = (-10..10).flat_map(|y| (0..5).map(move |z| [2.0, y as f32 * 0.1, z as f32 * 0.2]));
    Scan { stamp, points: points.collect(), no_returns: Vec::new() }
}

#[test]
fn a_robot_knows_where_it_is_and_where_others_were_in_its_own_frame() {
    let (mut alice, mut bob) =
        (Robot::new(config(1), Stamp(0)).unwrap(), Robot::new(config(2), Stamp(0)).unwrap());
    assert_eq!(bob.poses(), []);
    let here = Pose::from_yaw([1.0, 2.0, 0.5], 0.3);
    let now = Stamp(1_000_000);
    alice.insert_scan(now, &scan(now), &here).unwrap();
    let [own] = alice.poses()[..] else { panic!("one robot") };
    assert_eq!((own.stream, own.position, own.seen), (alice.own_stream(), [1.0, 2.0, 0.5], now));
    assert_eq!(own.orientation, Some(here.quaternion_xyzw()));

    // What she publishes says where she was, and his alignment of her frame applies.
    alice.flush(now);
    let aligned = Pose::from_yaw([10.0, 0.0, 0.0], std::f64::consts::FRAC_PI_2);
    bob.set_alignment(RobotId(1), &aligned).unwrap();
    let mut later = now;
    for _ in 0..30 {
        later = later.plus_micros(100_000);
        alice.handle_timeout(later);
        bob.handle_timeout(later);
        while let Some(transmit) = bob.poll_transmit(later) {
            alice.handle_datagram(later, &transmit.bytes).unwrap();
        }
        while let Some(transmit) = alice.poll_transmit(later) {
            bob.handle_datagram(later, &transmit.bytes).unwrap();
        }
    }
    let [seen] = bob.poses()[..] else { panic!("{:?}", bob.poses()) };
    assert_eq!((seen.stream, seen.orientation), (alice.own_stream(), None));
    let expected = aligned.transform([1.0, 2.0, 0.5]);
    let off = (0..3).map(|axis| (seen.position[axis] - expected[axis]).abs()).fold(0.0, f64::max);
    // A package says in which voxel.
    assert!(off <= resolution().metres() * 0.5001, "{:?}, expected {expected:?}", seen.position);
    assert!(seen.seen <= later && seen.seen >= now, "{:?}", seen.seen);
}
