//! What a robot missed and nobody has stored any more comes as the part of the map that it lacks.

mod common;

use common::{PERFECT, Radio, Random, Swarm, config, scan};
use flockmap::{Event, Pose, RobotConfig};

/// One robot flies for so many scans, a metre each second.
fn fly(swarm: &mut Swarm, random: &mut Random, scans: core::ops::Range<i64>) {
    for at in scans {
        let scan = scan(random, swarm.now);
        let pose = Pose::new([at as f64 / 4.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]).unwrap();
        swarm.scan(0, &scan, &pose);
        swarm.run(250);
    }
}

/// Robot 1 flies with robot 2 in reach, then out of reach until its store has dropped what robot 2 misses,
/// then in reach again.
fn out_of_reach(radio: Radio, seed: u64) -> (Swarm, u64) {
    let mut configs: Vec<RobotConfig> = (1..=2).map(config).collect();
    configs[0].session.store_bytes_max = 12_000;
    let mut swarm = Swarm::new(configs, radio, seed);
    let mut random = Random(seed);
    swarm.run(1_000);
    fly(&mut swarm, &mut random, 0..80);
    swarm.settle(10_000);
    let own = swarm.robots[0].own_stream();
    let received = swarm.robots[1].session().received(own).unwrap().prefix();
    assert!(received > 10, "seed {seed}");
    swarm.cut = vec![(0, 1)];
    fly(&mut swarm, &mut random, 80..120);
    assert!(swarm.robots[0].session().store().get(own, received + 1).is_none(), "seed {seed}: still stored");
    let before = swarm.robots[0].session().counters().packages_out.bytes;
    swarm.cut.clear();
    swarm.settle(30_000);
    let spent = swarm.robots[0].session().counters().packages_out.bytes - before;
    // What comes next builds on it.
    fly(&mut swarm, &mut random, 120..130);
    swarm.settle(20_000);
    (swarm, spent)
}

#[test]
fn a_span_brings_what_was_missed_and_later_packages_build_on_it() {
    for seed in [1, 2] {
        let (swarm, spent) = out_of_reach(PERFECT, seed);
        assert!(swarm.agrees(), "seed {seed}");
        swarm.assert_layers_equal_own_maps(seed);
        assert!(swarm.events[1].iter().any(|event| matches!(event, Event::CaughtUp { .. })), "seed {seed}");
        let whole = swarm.robots[0].counters().package_bytes;
        assert!(2 * spent < whole, "seed {seed}: {spent} bytes, all packages were {whole}");
        let counters = swarm.robots[1].counters();
        assert_eq!((counters.damaged, counters.no_room), (0, 0), "seed {seed}");
    }
}

#[test]
fn so_it_is_over_a_radio_that_loses_and_damages() {
    let radio = Radio { loss: 0.2, duplication: 0.05, damage: 0.02, delay_ms: (5.0, 60.0) };
    for seed in 10..13 {
        let (swarm, _) = out_of_reach(radio, seed);
        assert!(swarm.agrees(), "seed {seed}");
        swarm.assert_layers_equal_own_maps(seed);
    }
}
