//! What a session sends under a byte budget, in virtual time.

mod swarm;

use flockmap_grid::Stamp;
use flockmap_sync::{Cast, Pace, SessionConfig};
use swarm::{Radio, SECOND, Swarm};

#[test]
fn the_byte_budget_holds_in_every_second() {
    for (cast, budget) in [(Cast::Unicast, 12_000), (Cast::Broadcast, 6_000)] {
        let config = SessionConfig {
            cast,
            radio_bytes_per_s: Some(budget),
            snapshot_bytes_min: None,
            ..SessionConfig::default()
        };
        let mut swarm = Swarm::of(3, 17, Radio::lossy(0.1), &config);
        swarm.run(2 * SECOND);
        for _ in 0..20 {
            swarm.publish(1, 2_000);
            swarm.publish(2, 1_000);
            swarm.run(SECOND / 4);
        }
        swarm.run(60 * SECOND);
        for (id, robot) in &swarm.robots {
            for (i, &(at, ..)) in robot.sent.iter().enumerate() {
                let second: usize =
                    robot.sent[i..].iter().take_while(|s| s.0 < at + SECOND).map(|s| s.1 * s.2).sum();
                assert!(
                    second <= budget as usize,
                    "robot {id} sent {second} B in the second from {at}, {budget} allowed"
                );
            }
            // Counted as it was, but for the first requests, when nobody knew how many there are.
            let (real, counted) =
                (robot.bytes_between(0, i64::MAX) as u64, robot.session.counters().out().bytes);
            assert!(real.abs_diff(counted) < 500, "{real} bytes sent, {counted} counted");
        }
        // The budget is used while there is something to send.
        let busy = swarm.robots[&1].bytes_between(3 * SECOND, 7 * SECOND);
        assert!(busy > budget as usize * 4 * 8 / 10, "{busy} B of {} used in 4 s", budget * 4);
        assert!(swarm.robots[&1].session.counters().delayed_by_budget > 0);
        swarm.assert_in_sync(&[swarm.stream(1), swarm.stream(2)]);
    }
}

#[test]
fn the_pace_says_whether_what_is_published_waits_and_what_the_budget_leaves_for_each() {
    let config = SessionConfig { radio_bytes_per_s: Some(8_000), ..SessionConfig::default() };
    let mut swarm = Swarm::of(3, 5, Radio::lossy(0.0), &config);
    let pace = |swarm: &Swarm| swarm.robots[&1].session.pace(Stamp(swarm.now + swarm.robots[&1].clock));
    assert_eq!(pace(&swarm), Pace::Free, "nobody listens yet");
    swarm.run(2 * SECOND);
    // Two copies of all that is sent.
    assert_eq!(pace(&swarm), Pace::AllSent { bytes_per_s: 4_000 });
    swarm.publish(1, 40_000);
    assert_eq!(pace(&swarm), Pace::Waiting { bytes_per_s: 4_000 });
    swarm.run(20 * SECOND);
    assert_eq!(pace(&swarm), Pace::AllSent { bytes_per_s: 4_000 });
    // Who is out of reach is not waited for; nor who catches up, if another keeps up.
    swarm.cut(1, 3);
    for _ in 0..60 {
        swarm.publish(1, 100);
        swarm.run(SECOND);
    }
    assert_eq!(pace(&swarm), Pace::AllSent { bytes_per_s: 8_000 });
    swarm.join(1, 3);
    swarm.run(SECOND / 2);
    assert!(!matches!(pace(&swarm), Pace::Waiting { .. }), "{:?}", pace(&swarm));
}

/// Fails if a robot sent more than a budget below 2,000 bytes a second allows in any span of time after the first
/// six seconds: before, it does not know how many robots get a copy of its requests.
fn assert_thin_budget_holds(robot: &swarm::Robot, budget: usize, of: &str) {
    let sent: Vec<_> = robot.sent.iter().filter(|sent| sent.0 >= 6 * SECOND).collect();
    for (i, &&(at, ..)) in sent.iter().enumerate() {
        let mut sum = 0;
        for &&(then, bytes, copies) in &sent[i..] {
            sum += bytes * copies;
            let allowed = 1_300 + budget * (then - at) as usize / SECOND as usize;
            assert!(sum <= allowed, "{of}: {sum} B in {} µs from {at}, {allowed} allowed", then - at);
        }
    }
}

#[test]
fn a_budget_of_one_kilobyte_a_second_makes_progress_newest_first() {
    println!("robots   B/s  cast       requests/all  newest batch held after");
    for (budget, cast, robots) in [
        (1_024, Cast::Unicast, 2),
        (1_024, Cast::Broadcast, 3),
        (1_024, Cast::Unicast, 5),
        (500, Cast::Unicast, 2),
    ] {
        let config = SessionConfig { cast, radio_bytes_per_s: Some(budget), ..SessionConfig::default() };
        let mut swarm = Swarm::of(robots, 33, Radio::lossy(0.2), &config);
        swarm.run(3 * SECOND);
        let mut waits = Vec::new();
        // Far more than the budget: some 1,800 B a robot every half second, for each of its peers.
        for _ in 0..60 {
            for id in 1..=robots {
                swarm.publish(id, 600);
            }
            let newest = swarm.robots[&1].session.store().newest_known(swarm.stream(1));
            let waiting = waits.iter().filter(|wait: &&(i64, u32, Option<i64>)| wait.2.is_none()).count();
            if waiting < 40 {
                waits.push((swarm.now, newest, None));
            }
            swarm.run(SECOND / 2);
            let received =
                swarm.robots[&2].session.received(swarm.stream(1)).and_then(flockmap_sync::IntervalSet::last);
            for wait in waits.iter_mut().filter(|wait| received >= Some(wait.1)) {
                wait.2.get_or_insert(swarm.now - wait.0);
            }
        }
        let longest = waits.iter().map(|wait| wait.2.unwrap_or(swarm.now - wait.0)).max().unwrap();
        let counters = *swarm.robots[&1].session.counters();
        let share = counters.requests_out.bytes as f64 / counters.out().bytes as f64;
        println!("{robots:6}  {budget:4}  {cast:9?}  {share:12.3}  {:.1} s", longest as f64 / 1e6);
        assert!(share < 0.3, "requests took {share:.2} of the budget: {counters:#?}");
        let fair = i64::from(robots) * 4 * SECOND * 1_024 / i64::from(budget);
        assert!(longest < fair, "the newest batch was held only after {longest} µs, {fair} allowed");
        for (id, robot) in &swarm.robots {
            let lost = robot.events.iter().filter(|event| event.contains("PeerLost")).count();
            assert_eq!(lost, 0, "robot {id} lost sight of a peer that is there");
            assert_thin_budget_holds(robot, budget as usize, &format!("robot {id}"));
        }
        // It fills up when the robots stop, with a snapshot where that is cheaper.
        swarm.run(600 * SECOND);
        swarm.assert_in_sync(&(1..=robots).map(|id| swarm.stream(id)).collect::<Vec<_>>());
    }
}

#[test]
fn the_budget_of_a_link_counts_requests_too() {
    for budget in [600, 3_000] {
        let config = SessionConfig { link_bytes_per_s: Some(budget), ..SessionConfig::default() };
        let mut swarm = Swarm::of(2, 34, Radio::lossy(0.1), &config);
        swarm.run(3 * SECOND);
        for _ in 0..20 {
            swarm.publish(1, 900);
            swarm.run(SECOND / 2);
        }
        for robot in swarm.robots.values() {
            if budget < 2_000 {
                assert_thin_budget_holds(robot, budget as usize, "link");
                continue;
            }
            for &(at, ..) in &robot.sent {
                let second = robot.bytes_between(at, at + SECOND);
                assert!(second <= budget as usize, "{second} B in a second, {budget} allowed");
            }
        }
    }
}

#[test]
fn behind_a_thin_link_the_newest_batch_comes_first() {
    let config = SessionConfig { link_bytes_per_s: Some(5_000), ..SessionConfig::default() };
    let mut swarm = Swarm::of(2, 18, Radio::PERFECT, &config);
    swarm.run(2 * SECOND);
    for _ in 0..20 {
        swarm.publish(1, 2_000);
        swarm.run(SECOND / 10);
    }
    let last = swarm.publish(1, 100) as u32;
    swarm.run(SECOND);
    let stream = swarm.stream(1);
    let newest = swarm.robots[&1].session.store().newest_known(stream);
    let received = swarm.robots[&2].session.received(stream).unwrap();
    assert!(received.contains_range(newest + 1 - last, newest), "{received:?} of {newest}");
    assert!(received.count() < u64::from(newest) / 2, "{received:?} of {newest}");
}

#[test]
fn requests_leave_room_for_packages_however_soon_peers_forget_each_other() {
    // A peer has to be heard every third of a second: that alone takes three quarters of the budget.
    let config = SessionConfig {
        radio_bytes_per_s: Some(2_300),
        request_period_active_ms: 200,
        request_period_idle_ms: 270,
        peer_timeout_ms: 1_100,
        ..SessionConfig::default()
    };
    let mut swarm = Swarm::of(6, 83, Radio::PERFECT, &config);
    swarm.run(2 * SECOND);
    for id in 1..=6 {
        swarm.publish(id, 1_500);
    }
    swarm.run(120 * SECOND);
    let streams: Vec<_> = (1..=6).map(|id| swarm.stream(id)).collect();
    swarm.assert_in_sync(&streams);
}
