//! What a broadcast radio that all share is spared: what went out serves all who heard it, and one datagram mends
//! different losses.

mod swarm;

use flockmap_sync::{Cast, SessionConfig};
use swarm::{MS, Radio, SECOND, Swarm};

fn broadcast() -> SessionConfig {
    SessionConfig { cast: Cast::Broadcast, ..SessionConfig::default() }
}

#[test]
fn who_is_met_after_something_went_out_is_not_sent_it_again() {
    for robots in [3, 10, 20] {
        let mut swarm = Swarm::of(robots, 90, Radio::PERFECT, &broadcast());
        // As soon as the first ones have met.
        swarm.run(30 * MS);
        let published: usize = (1..=robots).map(|id| swarm.publish(id, 60)).sum();
        swarm.run(20 * SECOND);
        swarm.assert_in_sync(&(1..=robots).map(|id| swarm.stream(id)).collect::<Vec<_>>());
        assert_eq!(swarm.take_sent_packages().len(), published, "{robots} robots");
    }
}

#[test]
fn repair_symbols_mend_what_each_robot_lost_and_nothing_is_wrong() {
    for seed in 91..95 {
        let mut swarm = Swarm::of(12, seed, Radio::lossy(0.2), &broadcast());
        swarm.run(2 * SECOND);
        for _ in 0..40 {
            swarm.publish(1, 200);
            swarm.run(20 * MS);
        }
        swarm.run(30 * SECOND);
        swarm.assert_in_sync(&[swarm.stream(1)]);
        let counters = swarm.robots.values().map(|robot| *robot.session.counters());
        let (sent, mended, failed) = counters.fold((0, 0, 0), |(sent, mended, failed), counters| {
            (sent + counters.coded_sent, mended + counters.mended, failed + counters.mending_failed)
        });
        println!("seed {seed}: {sent} datagrams mended {mended} packages");
        assert!(mended > 2 * sent && sent > 2, "seed {seed}: {sent} datagrams mended {mended} packages");
        assert_eq!(failed, 0, "seed {seed}");
    }
}

/// Requests of 25 robots that hear each other would else be as long as all they hear and hold.
#[test]
fn requests_of_a_crowd_are_short() {
    let mut swarm = Swarm::of(25, 96, Radio::lossy(0.1), &broadcast());
    swarm.run(SECOND);
    for _ in 0..10 {
        for id in 1..=25 {
            swarm.publish(id, 60);
        }
        swarm.run(SECOND / 2);
    }
    swarm.run(10 * SECOND);
    swarm.assert_in_sync(&(1..=25).map(|id| swarm.stream(id)).collect::<Vec<_>>());
    let counters = swarm.robots.values().map(|robot| robot.session.counters().requests_out);
    let (datagrams, bytes) = counters.fold((0, 0), |(datagrams, bytes), requests| {
        (datagrams + requests.datagrams, bytes + requests.bytes)
    });
    let each = bytes / datagrams;
    println!("{datagrams} requests of {each} bytes");
    assert!(each < 450, "{each} bytes each");
}

/// Whatever the robots of a crowd say before anybody can have answered only makes the queue longer.
#[test]
fn a_robot_of_a_crowd_that_nobody_hears_yet_says_little() {
    let slow = Radio { delay: 5 * SECOND, ..Radio::PERFECT };
    let mut swarm = Swarm::of(25, 97, slow, &broadcast());
    swarm.run(10 * SECOND - MS);
    let requests = |swarm: &Swarm| {
        swarm.robots.values().map(|robot| robot.session.counters().requests_out.datagrams).max().unwrap()
    };
    assert!(requests(&swarm) <= 5, "{} requests, at 0 s and every 3 s", requests(&swarm));
    swarm.run(SECOND);
    assert!(requests(&swarm) > 5, "whoever is heard says whom it hears");
}

#[test]
fn what_queues_on_the_radio_of_a_crowd_does_not_count_as_lost() {
    let slow = Radio { delay: 2 * SECOND, ..Radio::PERFECT };
    let mut swarm = Swarm::of(25, 98, slow, &broadcast());
    // Nobody knows yet how long a datagram takes.
    swarm.run(1_500 * MS);
    let published: usize = (1..=25).map(|id| swarm.publish(id, 60)).sum();
    swarm.run(60 * SECOND);
    swarm.assert_in_sync(&(1..=25).map(|id| swarm.stream(id)).collect::<Vec<_>>());
    let lost: u64 = swarm.robots.values().map(|robot| robot.session.counters().lost).sum();
    assert_eq!((lost, swarm.take_sent_packages().len()), (0, published));
}
