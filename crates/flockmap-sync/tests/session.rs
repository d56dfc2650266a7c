//! What a session does for a swarm, in virtual time.

mod swarm;

use flockmap_grid::Stamp;
use flockmap_sync::{Cast, SessionConfig};
use swarm::{MS, Radio, SECOND, Swarm};

/// Two robots publish every half second for a while; then there is time to repair.
fn two_robots(seed: u64, radio: Radio, config: &SessionConfig, batches: usize) -> (Swarm, u64) {
    let mut swarm = Swarm::of(2, seed, radio, config);
    swarm.run(2 * SECOND);
    let mut published = 0;
    for _ in 0..batches {
        for id in [1, 2] {
            published += swarm.publish(id, 600) as u64;
        }
        swarm.run(SECOND / 2);
    }
    swarm.run(8 * SECOND);
    (swarm, published)
}

#[test]
fn without_loss_every_package_is_sent_exactly_once() {
    let (swarm, published) = two_robots(1, Radio::PERFECT, &SessionConfig::default(), 40);
    swarm.assert_in_sync(&[swarm.stream(1), swarm.stream(2)]);
    let sent: u64 = swarm.robots.values().map(|robot| robot.session.counters().sent).sum();
    assert_eq!(sent, published);
    for robot in swarm.robots.values() {
        let counters = robot.session.counters();
        assert_eq!(counters.duplicates + counters.lost + counters.gap_requests, 0, "{counters:#?}");
        assert_eq!(counters.accepted, counters.received);
    }
}

#[test]
fn under_loss_reordering_and_duplication_all_arrives_with_few_bytes() {
    println!("loss  packages sent/needed  limit   bytes/needed");
    for (loss, seed) in [(0.0, 2), (0.1, 3), (0.2, 4), (0.35, 5), (0.5, 6)] {
        let (swarm, published) = two_robots(seed, Radio::lossy(loss), &SessionConfig::default(), 80);
        swarm.assert_in_sync(&[swarm.stream(1), swarm.stream(2)]);
        let sum = |f: fn(&flockmap_sync::Counters) -> u64| -> u64 {
            swarm.robots.values().map(|robot| f(robot.session.counters())).sum()
        };
        let overhead = sum(|c| c.sent) as f64 / published as f64;
        let limit = 1.25 / (1.0 - loss);
        let needed = sum(|c| c.packages_out.bytes) as f64 / overhead;
        println!(
            "{loss:4}  {overhead:20.3}  {limit:5.3}  {:6.3} (requests {:.3})",
            swarm.bytes() as f64 / needed,
            sum(|c| c.requests_out.bytes) as f64 / needed,
        );
        assert!(
            overhead <= limit,
            "at loss {loss} each package was sent {overhead:.3} times, {limit:.3} allowed"
        );
    }
}

#[test]
fn a_torn_backlog_is_repaired_in_a_bounded_number_of_sends() {
    let config = SessionConfig { snapshot_bytes_min: None, ..SessionConfig::default() };
    let mut swarm = Swarm::of(2, 29, Radio::lossy(0.5), &config);
    swarm.run(5 * SECOND);
    let mut published = 0;
    for _ in 0..800 {
        published += swarm.publish(1, 5_000) as u64;
    }
    assert!(published > 1_500, "{published}");
    swarm.run(60 * SECOND);
    swarm.assert_in_sync(&[swarm.stream(1)]);
    let sent = swarm.robots[&1].session.counters().sent;
    assert!(sent < published * 3, "{sent} sent for {published}");
}

#[test]
fn a_clock_that_was_set_back_mutes_a_robot_only_for_seconds() {
    let (mut swarm, _) = two_robots(30, Radio::PERFECT, &SessionConfig::default(), 4);
    let bytes = {
        let robot = swarm.robots.get_mut(&2).unwrap();
        let ahead = Stamp(swarm.now + robot.clock + 1_000 * SECOND);
        // What robot 2 would send if its clock were ahead; the session itself stays as it is.
        let header = flockmap_sync::wire::DatagramHeader {
            kind: flockmap_sync::wire::Kind::Request,
            swarm: 0,
            sender: robot.session.own(),
            stamp: ahead,
        };
        flockmap_sync::wire::Request::default().emit(header, 1_200)
    };
    let robot = swarm.robots.get_mut(&1).unwrap();
    robot.session.handle_datagram(Stamp(swarm.now + robot.clock), &bytes).unwrap();
    swarm.publish(1, 100);
    swarm.publish(2, 100);
    swarm.run(10 * SECOND);
    swarm.assert_in_sync(&[swarm.stream(1), swarm.stream(2)]);
}

#[test]
fn the_middle_robot_of_a_line_forwards_at_once() {
    let mut swarm = Swarm::new(7, Radio::PERFECT);
    swarm.cut(1, 3);
    for id in [1, 2, 3] {
        swarm.start(id, 1, SessionConfig::default());
    }
    swarm.run(2 * SECOND);
    for id in [1, 2, 3] {
        swarm.publish(id, 300);
    }
    swarm.run(40 * MS);
    swarm.assert_in_sync(&[swarm.stream(1), swarm.stream(2), swarm.stream(3)]);
    for _ in 0..20 {
        for id in [1, 2, 3] {
            swarm.publish(id, 300);
        }
        swarm.run(SECOND / 2);
    }
    swarm.assert_in_sync(&[swarm.stream(1), swarm.stream(2), swarm.stream(3)]);
    let duplicates: u64 = swarm.robots.values().map(|robot| robot.session.counters().duplicates).sum();
    assert_eq!(duplicates, 0);
    // The clock of the far end is known through the middle: 1000 s a robot apart.
    let offset = swarm.robots[&1].session.clock_offset_micros(swarm.stream(3)).unwrap();
    assert!((offset - 2_000 * SECOND).abs() < 5 * MS, "{offset}");
}

#[test]
fn a_line_with_loss_is_repaired_hop_by_hop() {
    let mut swarm = Swarm::of(4, 8, Radio::lossy(0.3), &SessionConfig::default());
    for (a, b) in [(1, 3), (1, 4), (2, 4)] {
        swarm.cut(a, b);
    }
    for _ in 0..30 {
        for id in 1..=4 {
            swarm.publish(id, 300);
        }
        swarm.run(SECOND / 2);
    }
    swarm.run(20 * SECOND);
    swarm.assert_in_sync(&[1, 2, 3, 4].map(|id| swarm.stream(id)));
}

#[test]
fn in_a_full_mesh_only_origins_answer() {
    let mut swarm = Swarm::of(4, 9, Radio::PERFECT, &SessionConfig::default());
    swarm.run(2 * SECOND);
    for _ in 0..20 {
        for id in 1..=4 {
            swarm.publish(id, 300);
        }
        swarm.run(SECOND / 2);
    }
    swarm.assert_in_sync(&[1, 2, 3, 4].map(|id| swarm.stream(id)));
    let relayed: u64 = swarm.robots.values().map(|robot| robot.session.counters().relayed).sum();
    assert_eq!(relayed, 0);
}

#[test]
fn on_a_shared_radio_one_datagram_serves_all() {
    let config = SessionConfig { cast: Cast::Broadcast, ..SessionConfig::default() };
    let mut swarm = Swarm::of(5, 10, Radio::PERFECT, &config);
    swarm.run(2 * SECOND);
    let mut published = 0;
    for _ in 0..20 {
        for id in 1..=5 {
            published += swarm.publish(id, 300) as u64;
        }
        swarm.run(SECOND / 2);
    }
    swarm.assert_in_sync(&[1, 2, 3, 4, 5].map(|id| swarm.stream(id)));
    let sent: u64 = swarm.robots.values().map(|robot| robot.session.counters().sent).sum();
    assert_eq!(sent, published);
}

#[test]
fn broadcast_under_loss_repairs_everyone() {
    let config = SessionConfig { cast: Cast::Broadcast, ..SessionConfig::default() };
    let mut swarm = Swarm::of(4, 11, Radio::lossy(0.3), &config);
    swarm.cut(1, 4);
    let mut published = 0;
    for _ in 0..40 {
        for id in 1..=4 {
            published += swarm.publish(id, 300) as u64;
        }
        swarm.run(SECOND / 2);
    }
    swarm.run(20 * SECOND);
    swarm.assert_in_sync(&[1, 2, 3, 4].map(|id| swarm.stream(id)));
    let suppressed: u64 = swarm.robots.values().map(|robot| robot.session.counters().suppressed).sum();
    assert!(suppressed > 0);
    let sent: u64 = swarm.robots.values().map(|robot| robot.session.counters().sent).sum();
    println!("broadcast, 4 robots, 30 % loss: each package sent {:.2} times", sent as f64 / published as f64);
    assert!(sent < published * 4, "{sent} sent for {published} published");
}

#[test]
fn a_late_joiner_gets_the_snapshot() {
    let config = SessionConfig { snapshot_bytes_min: Some(20_000), ..SessionConfig::default() };
    let mut swarm = Swarm::of(2, 12, Radio::lossy(0.2), &config);
    let mut history = 0;
    for _ in 0..200 {
        history += swarm.publish(1, 900);
        swarm.run(20 * MS);
    }
    swarm.run(3 * SECOND);
    swarm.start(3, 1, config);
    swarm.run(20 * SECOND);
    swarm.assert_in_sync(&[swarm.stream(1)]);
    let joiner = swarm.robots[&3].session.counters();
    assert_eq!(joiner.caught_up, 1, "{joiner:#?}");
    assert!(
        joiner.chunks_accepted < history as u64 / 4,
        "{} chunks for {history} packages",
        joiner.chunks_accepted
    );
    assert!(joiner.accepted < history as u64 / 4, "{joiner:#?}");
    // What was caught up as a state is held by the joiner, so that later packages go on from there.
    for _ in 0..4 {
        swarm.publish(1, 100);
        swarm.run(SECOND / 2);
    }
    swarm.run(5 * SECOND);
    swarm.assert_in_sync(&[swarm.stream(1)]);
}

#[test]
fn a_late_joiner_of_a_long_flight_gets_every_package_once() {
    let seed = 24;
    let config = SessionConfig { snapshot_bytes_min: None, ..SessionConfig::default() };
    let mut swarm = Swarm::of(2, seed, Radio::lossy(0.1), &config);
    for _ in 0..1_200 {
        swarm.publish(1, 300);
        swarm.run(SECOND / 50);
    }
    swarm.run(10 * SECOND);
    swarm.start(3, 1, config);
    swarm.robots.get_mut(&3).unwrap().ahead_max = Some(1_024);
    let sent_before = swarm.robots[&1].session.counters().sent;
    swarm.run(60 * SECOND);
    swarm.assert_in_sync(&[swarm.stream(1)]);
    let joiner = swarm.robots[&3].session.counters();
    let packages = u64::from(swarm.robots[&1].session.store().newest_known(swarm.stream(1)));
    let sent = swarm.robots[&1].session.counters().sent - sent_before;
    assert!(packages > 2_000, "{packages}");
    assert_eq!(joiner.accepted, packages, "{joiner:#?}");
    assert!(joiner.rejected <= packages / 50, "{} refused for want of room", joiner.rejected);
    assert!(sent as f64 <= packages as f64 * 1.2, "{sent} sent of {packages}");
}

#[test]
fn a_window_that_is_full_waits_a_round_trip_and_not_for_the_next_periodic_request() {
    let config = SessionConfig { in_flight_max: 4, ..SessionConfig::default() };
    let mut swarm = Swarm::of(2, 25, Radio::PERFECT, &config);
    swarm.run(2 * SECOND);
    for _ in 0..100 {
        swarm.publish(1, 100);
    }
    let packages = swarm.robots[&1].session.store().newest_known(swarm.stream(1));
    assert!(packages >= 100);
    // At four for each periodic request it would take 25 s.
    swarm.run(4 * SECOND);
    swarm.assert_in_sync(&[swarm.stream(1)]);
}

#[test]
fn packages_dropped_from_the_store_come_back_as_snapshot() {
    let small =
        SessionConfig { store_bytes_max: 30_000, snapshot_bytes_min: None, ..SessionConfig::default() };
    let mut swarm = Swarm::of(1, 13, Radio::lossy(0.1), &small);
    for _ in 0..100 {
        swarm.publish(1, 500);
        swarm.run(20 * MS);
    }
    assert!(swarm.robots[&1].session.store().bytes() <= 30_000);
    assert!(swarm.robots[&1].session.store().dropped() > 0);
    swarm.start(2, 1, small);
    swarm.run(20 * SECOND);
    swarm.assert_in_sync(&[swarm.stream(1)]);
}

#[test]
fn a_driver_without_snapshots_still_syncs_by_packages() {
    let config = SessionConfig { snapshot_bytes_min: Some(2_000), ..SessionConfig::default() };
    let mut swarm = Swarm::of(1, 14, Radio::PERFECT, &config);
    swarm.robots.get_mut(&1).unwrap().no_snapshot = true;
    for _ in 0..50 {
        swarm.publish(1, 500);
    }
    swarm.start(2, 1, config);
    swarm.run(20 * SECOND);
    swarm.assert_in_sync(&[swarm.stream(1)]);
}

#[test]
fn a_rebooted_robot_is_a_new_stream_and_takes_back_its_old_ones() {
    let config = SessionConfig::default();
    let mut swarm = Swarm::of(3, 15, Radio::lossy(0.2), &config);
    swarm.run(2 * SECOND);
    for _ in 0..10 {
        swarm.publish(1, 300);
        swarm.publish(2, 300);
        swarm.run(SECOND / 2);
    }
    swarm.run(10 * SECOND);
    let old = swarm.stream(1);
    let digest = swarm.robots[&1].layer(old);
    swarm.stop(1);
    swarm.run(SECOND);
    let new = swarm.start(1, 2, config);
    for _ in 0..10 {
        swarm.publish(1, 300);
        swarm.run(SECOND / 2);
    }
    swarm.run(20 * SECOND);
    swarm.assert_in_sync(&[old, new, swarm.stream(2)]);
    assert_eq!(swarm.robots[&1].layer(old), digest);
}

#[test]
fn of_many_runs_the_oldest_are_forgotten_and_not_sent_for_ever() {
    let config = SessionConfig { epochs_max: 2, ..SessionConfig::default() };
    let mut swarm = Swarm::of(2, 16, Radio::PERFECT, &config);
    // Robot 3 keeps more runs than the others.
    swarm.start(3, 1, SessionConfig::default());
    for epoch in 2..6 {
        swarm.run(2 * SECOND);
        swarm.publish(1, 200);
        swarm.run(2 * SECOND);
        swarm.start(1, epoch, config.clone());
    }
    swarm.publish(1, 200);
    swarm.run(30 * SECOND);
    assert!(swarm.robots[&2].session.streams().filter(|s| s.origin.0 == 1).count() <= 2);
    let before = swarm.robots[&3].session.counters().sent;
    swarm.run(60 * SECOND);
    assert_eq!(
        swarm.robots[&3].session.counters().sent,
        before,
        "robot 3 keeps sending runs that nobody wants"
    );
    swarm.assert_in_sync(&[swarm.stream(1)]);
}

#[test]
fn when_nothing_is_missing_there_are_only_requests_and_few() {
    let config = SessionConfig::default();
    let (mut swarm, _) = two_robots(19, Radio::lossy(0.2), &config, 10);
    swarm.run(20 * SECOND);
    let packages: u64 = swarm.robots.values().map(|r| r.session.counters().packages_out.datagrams).sum();
    let from = swarm.now;
    swarm.run(60 * SECOND);
    let after: u64 = swarm.robots.values().map(|r| r.session.counters().packages_out.datagrams).sum();
    assert_eq!(after, packages);
    for robot in swarm.robots.values() {
        let sent = robot.sent.iter().filter(|s| s.0 > from).count();
        assert!((18..=23).contains(&sent), "{sent} requests in a minute, one in 3 s expected");
        assert!(robot.bytes_between(from, i64::MAX) < 23 * 110);
    }
}

#[test]
fn the_papers_own_behaviour_is_a_setting() {
    let config = SessionConfig::paper();
    let mut swarm = Swarm::of(3, 20, Radio::PERFECT, &config);
    swarm.run(2 * SECOND);
    let stream = swarm.stream(1);
    let before = swarm.robots[&1].session.counters().packages_out;
    swarm.publish(1, 300);
    // Nothing goes out until somebody asks.
    assert_eq!(swarm.robots[&1].session.counters().packages_out, before);
    swarm.run(2 * SECOND);
    swarm.assert_in_sync(&[stream]);

    // All holders answer, so a robot that was away gets copies.
    swarm.cut(1, 3);
    swarm.cut(2, 3);
    swarm.run(SECOND);
    for _ in 0..5 {
        swarm.publish(1, 300);
        swarm.run(SECOND);
    }
    swarm.join(1, 3);
    swarm.join(2, 3);
    swarm.run(3 * SECOND);
    swarm.assert_in_sync(&[stream]);
    assert!(swarm.robots[&3].session.counters().duplicates > 0);

    // A range of missing indices over the threshold brings the map as it is.
    let mut late = Swarm::of(2, 21, Radio::lossy(0.2), &config);
    for _ in 0..150 {
        late.publish(1, 100);
    }
    late.run(20 * SECOND);
    late.start(3, 1, config);
    late.run(30 * SECOND);
    late.assert_in_sync(&[late.stream(1)]);
    assert!(late.robots[&3].session.counters().caught_up > 0);
}

#[test]
fn by_the_papers_comparison_a_package_is_sent_again_only_after_two_requests_without_it() {
    let config = SessionConfig {
        request_period_active_ms: 100,
        request_period_idle_ms: 100,
        ..SessionConfig::paper()
    };
    // The round trip takes one and a half periods: every answer is still in flight at the next request.
    let radio = Radio { loss: 0.0, duplicate: 0.0, delay: 75 * MS, jitter: 0 };
    let mut swarm = Swarm::of(2, 22, radio, &config);
    swarm.run(SECOND);
    for _ in 0..20 {
        swarm.publish(1, 200);
        swarm.run(SECOND / 4);
    }
    swarm.run(3 * SECOND);
    swarm.assert_in_sync(&[swarm.stream(1)]);
    assert_eq!(swarm.robots[&2].session.counters().duplicates, 0);
}

#[test]
fn a_reorder_patience_of_seconds_only_makes_repair_slower() {
    let config = SessionConfig { reorder_patience_ms: 2_000, ..SessionConfig::default() };
    let (mut swarm, _) = two_robots(28, Radio::lossy(0.2), &config, 20);
    swarm.run(30 * SECOND);
    swarm.assert_in_sync(&[swarm.stream(1), swarm.stream(2)]);
    assert!(swarm.robots.values().any(|robot| robot.session.counters().lost > 0));
}

#[test]
fn clocks_are_measured_from_the_echoes() {
    let (swarm, _) = two_robots(23, Radio::lossy(0.1), &SessionConfig::default(), 20);
    let robot = &swarm.robots[&1];
    let offset = robot.session.clock_offset_micros(swarm.stream(2)).unwrap();
    assert!((offset - 1_000 * SECOND).abs() < 10 * MS, "off by {} µs", offset - 1_000 * SECOND);
    let peer = robot.session.peers().next().unwrap();
    assert!((20..60).contains(&peer.round_trip.unwrap().as_millis()), "{peer:?}");
    assert!(peer.hears_us);
}

#[test]
fn given_clock_offsets_are_used_in_place_of_measured_ones() {
    let (mut swarm, _) = two_robots(24, Radio::PERFECT, &SessionConfig::default(), 4);
    let stream = swarm.stream(2);
    let session = &mut swarm.robots.get_mut(&1).unwrap().session;
    session.set_clock_offset(stream.origin, Some(42));
    assert_eq!(session.clock_offset_micros(stream), Some(42));
    session.set_clock_offset(stream.origin, None);
    assert!(session.clock_offset_micros(stream).unwrap() > 900 * SECOND);
    // Nobody but itself knows whether its clock went on through a restart.
    let former = flockmap_grid::Stream { epoch: 0, ..swarm.stream(1) };
    let session = &mut swarm.robots.get_mut(&1).unwrap().session;
    assert_eq!(session.clock_offset_micros(former), None);
    session.set_clock_offset(former.origin, Some(0));
    assert_eq!(session.clock_offset_micros(former), Some(0));
}

#[test]
fn a_long_silence_is_reported_and_healed() {
    let config = SessionConfig::default();
    let (mut swarm, _) = two_robots(25, Radio::lossy(0.1), &config, 4);
    swarm.cut(1, 2);
    for _ in 0..60 {
        swarm.publish(1, 300);
        swarm.publish(2, 300);
        swarm.run(SECOND / 2);
    }
    assert!(swarm.robots[&1].events.iter().any(|e| e.contains("PeerLost")));
    assert_eq!(swarm.robots[&1].session.peers().count(), 0);
    swarm.join(1, 2);
    swarm.run(20 * SECOND);
    swarm.assert_in_sync(&[swarm.stream(1), swarm.stream(2)]);
}

#[test]
fn two_robots_with_one_id_are_told() {
    let mut swarm = Swarm::of(2, 26, Radio::PERFECT, &SessionConfig::default());
    swarm.run(2 * SECOND);
    let mut twin = Swarm::new(27, Radio::PERFECT);
    twin.start(1, 9, SessionConfig::default());
    twin.run(SECOND);
    let bytes = {
        let session = &mut twin.robots.get_mut(&1).unwrap().session;
        let now = session.poll_timeout().unwrap();
        session.poll_transmit(now).unwrap().bytes
    };
    let robot = swarm.robots.get_mut(&1).unwrap();
    let now = Stamp(swarm.now + robot.clock);
    assert!(robot.session.handle_datagram(now, &bytes).is_err());
    swarm.drive(1);
    assert!(swarm.robots[&1].events.iter().any(|e| e == "SameIdentity"));
}

#[test]
fn a_robot_that_starts_again_with_an_old_epoch_and_no_store_is_told() {
    let config = SessionConfig::default();
    let (mut swarm, _) = two_robots(32, Radio::PERFECT, &config, 4);
    swarm.stop(1);
    swarm.run(SECOND);
    swarm.start(1, 1, config);
    swarm.run(5 * SECOND);
    let sent = swarm.robots[&1].events.iter().filter(|event| *event == "SameIdentity").count();
    assert_eq!(sent, 1);
    assert!(swarm.robots[&1].session.counters().same_identity > 1);
}

#[test]
fn a_store_from_disk_is_put_back() {
    let config = SessionConfig::default();
    let (mut swarm, _) = two_robots(28, Radio::PERFECT, &config, 10);
    let (one, two) = (swarm.stream(1), swarm.stream(2));
    let old = swarm.robots.remove(&1).unwrap();
    swarm.run(SECOND);
    let own = swarm.start(1, 2, config);
    let robot = swarm.robots.get_mut(&1).unwrap();
    let now = Stamp(swarm.now + robot.clock);
    for stream in [one, two] {
        for (_, stored) in old.session.store().range(stream, 1, u32::MAX) {
            assert!(robot.session.deliver_package(now, stored.package.clone()));
        }
    }
    swarm.drive(1);
    let restored = swarm.robots[&1].session.counters().received;
    assert!(restored > 0);
    swarm.run(3 * SECOND);
    let counters = swarm.robots[&1].session.counters();
    assert_eq!((counters.received, counters.sent), (restored, 0), "everything was there already");
    swarm.publish(1, 200);
    swarm.run(3 * SECOND);
    swarm.assert_in_sync(&[one, two, own]);
}
