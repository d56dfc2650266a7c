//! Swarms in virtual time, as every flight has to go.

use flockmap::Cast;
use flockmap_netsim::swarm::{RadioPreset, SwarmOptions, fly};

/// Seeds flown here; many more are flown by `flockmap sim swarm --seeds`.
const SEEDS: u64 = 150;

#[test]
fn the_first_seeds_hold_all_that_is_promised() {
    for seed in 1..=SEEDS {
        let report = fly(&SwarmOptions::new(seed));
        assert!(report.is_good(), "{}\n{}", report.command, report.failure.unwrap());
    }
}

#[test]
fn the_same_seed_is_the_same_flight() {
    for seed in [1, 2, 3] {
        let [a, b] = [(); 2].map(|()| fly(&SwarmOptions::new(seed)));
        assert_eq!(format!("{a:?}"), format!("{b:?}"));
    }
    let bytes = |seed| fly(&SwarmOptions::new(seed)).robots.iter().map(|robot| robot.bytes).sum::<u64>();
    assert_ne!(bytes(1), bytes(2));
}

#[test]
fn every_radio_brings_a_calm_swarm_to_agreement() {
    for radio in RadioPreset::ALL {
        for cast in [Cast::Unicast, Cast::Broadcast] {
            let options = SwarmOptions {
                robots: Some(4),
                radio: Some(radio),
                seconds: Some(3.0),
                cast: Some(cast),
                is_calm: true,
                ..SwarmOptions::new(5)
            };
            let report = fly(&options);
            assert!(report.is_good(), "{}\n{}", report.command, report.failure.unwrap());
            assert!(report.robots.iter().all(|robot| robot.merged > 0), "{}", report.command);
        }
    }
}
