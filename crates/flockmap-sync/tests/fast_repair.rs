//! Fast repair of obstacles where losses are high.

mod swarm;

use flockmap_sync::{Cast, Counters, SessionConfig};
use swarm::{MS, Radio, SECOND, Swarm};

/// Robot 1 publishes ten times a second for a minute. After how many milliseconds each package was held by robot 2, sorted;
/// and what robot 1 counted.
fn fly(robots: u16, seed: u64, loss: f64, config: &SessionConfig) -> (Vec<i64>, Counters) {
    let radio = Radio { loss, duplicate: 0.0, delay: 20 * MS, jitter: 0 };
    let mut swarm = Swarm::of(robots, seed, radio, config);
    let own = swarm.stream(1);
    // They meet, and learn what gets lost.
    for _ in 0..100 {
        swarm.publish(1, 8);
        swarm.run(100 * MS);
    }
    let mut published = Vec::new();
    let mut ages = Vec::new();
    for ms in 0..60_000 {
        if ms % 100 == 0 {
            swarm.publish(1, 8);
            published.push((ms, swarm.robots[&1].session.store().newest_known(own)));
        }
        swarm.run(MS);
        let Some(received) = swarm.robots[&2].session.received(own).cloned() else { continue };
        published.retain(|&(at, index)| {
            let is_held = received.contains(index);
            ages.extend(is_held.then_some(ms + 1 - at));
            !is_held
        });
    }
    swarm.run(100 * SECOND);
    swarm.assert_in_sync(&[own]);
    ages.sort_unstable();
    (ages, *swarm.robots[&1].session.counters())
}

fn of_a_hundred(ages: &[i64], percent: usize) -> i64 {
    ages[ages.len() * percent / 100]
}

#[test]
fn one_obstacle_in_fifty_is_late_by_round_trips_and_not_by_periods() {
    for cast in [Cast::Unicast, Cast::Broadcast] {
        let fast = SessionConfig { cast, ..SessionConfig::default() };
        let plain = SessionConfig { fast_repair: false, ..fast.clone() };
        let (mut with, mut without) = (Vec::new(), Vec::new());
        for seed in 300..305 {
            let (ages, counters) = fly(2, seed, 0.2, &fast);
            with.extend(ages);
            assert!(counters.probes > 50, "{counters:?}");
            let (ages, counters) = fly(2, seed, 0.2, &plain);
            without.extend(ages);
            assert_eq!((counters.probes, counters.repeated), (0, 0));
        }
        with.sort_unstable();
        without.sort_unstable();
        let [with, without] = [with, without].map(|ages| of_a_hundred(&ages, 98));
        println!("{cast:?}: 98 % within {with} ms, {without} ms without");
        assert!(with <= 240 && 10 * with < 8 * without, "{cast:?}: {with} ms, {without} ms without");
    }
}

#[test]
fn where_every_second_datagram_is_lost_obstacles_are_sent_twice() {
    let fast = SessionConfig::default();
    let plain = SessionConfig { fast_repair: false, ..SessionConfig::default() };
    let (ages, counters) = fly(3, 310, 0.5, &fast);
    assert!(counters.repeated > 100, "{counters:?}");
    let (others, _) = fly(3, 310, 0.5, &plain);
    let [with, without] = [ages, others].map(|ages| of_a_hundred(&ages, 95));
    assert!(with <= 600 && 2 * with < without, "95 % within {with} ms, {without} ms without");
}

#[test]
fn repair_is_not_fast_where_nothing_is_lost_or_the_radio_is_thin_or_the_swarm_large() {
    let thin = SessionConfig { radio_bytes_per_s: Some(12_000), ..SessionConfig::default() };
    let broadcast = SessionConfig { cast: Cast::Broadcast, ..SessionConfig::default() };
    for (robots, loss, config) in
        [(2, 0.0, &SessionConfig::default()), (2, 0.3, &thin), (10, 0.3, &broadcast)]
    {
        let (_, counters) = fly(robots, 320, loss, config);
        assert_eq!((counters.probes, counters.repeated), (0, 0), "{robots} robots, {loss}");
    }
}
