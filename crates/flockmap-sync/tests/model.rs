//! Random runs of a whole swarm against what must always hold: nothing is delivered twice as new (checked by the
//! harness at every delivery), and when the radio heals, all that was published is held by all.

mod swarm;

use flockmap_grid::Stream;
use flockmap_sync::{Cast, InFlight, Order, Relay, SessionConfig};
use proptest::prelude::*;
use swarm::{MS, Radio, SECOND, Swarm};

#[derive(Clone, Debug)]
enum Step {
    Publish { id: u16, voxels: usize },
    Run { ms: i64 },
    Cut { a: u16, b: u16 },
    Join { a: u16, b: u16 },
    Reboot { id: u16 },
}

fn step() -> impl Strategy<Value = Step> {
    let id = || 1..=4u16;
    prop_oneof![
        6 => (id(), 1..1_500usize).prop_map(|(id, voxels)| Step::Publish { id, voxels }),
        6 => (1..2_000i64).prop_map(|ms| Step::Run { ms }),
        1 => (id(), id()).prop_map(|(a, b)| Step::Cut { a, b }),
        2 => (id(), id()).prop_map(|(a, b)| Step::Join { a, b }),
        1 => id().prop_map(|id| Step::Reboot { id }),
    ]
}

fn config() -> impl Strategy<Value = SessionConfig> {
    let cast = prop_oneof![Just(Cast::Unicast), Just(Cast::Broadcast)];
    let order = prop_oneof![Just(Order::NewestFirst), Just(Order::OldestFirst)];
    let relay = prop_oneof![4 => Just(Relay::Ranked), 1 => Just(Relay::Always)];
    let in_flight = prop_oneof![4 => Just(InFlight::RoundTrip), 1 => Just(InFlight::PreviousRequest)];
    let snapshot = prop_oneof![Just(None), Just(Some(3_000)), Just(Some(65_536))];
    let store = prop_oneof![1 => Just(20_000usize), 4 => Just(64 << 20)];
    (cast, order, relay, in_flight, snapshot, store, any::<bool>(), any::<bool>()).prop_map(
        |(cast, order, relay, in_flight, snapshot_bytes_min, store_bytes_max, push, gap_requests)| {
            SessionConfig {
                cast,
                order,
                relay,
                in_flight,
                snapshot_bytes_min,
                store_bytes_max,
                push,
                gap_requests,
                epochs_max: 64,
                ..SessionConfig::default()
            }
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]

    #[test]
    fn whatever_happens_all_is_held_in_the_end(
        seed: u64, loss in 0.0..0.5f64, jitter in 0..80i64, config in config(),
        steps in prop::collection::vec(step(), 1..40),
    ) {
        let radio = Radio { loss, duplicate: 0.05, delay: 5 * MS, jitter: jitter * MS };
        let mut swarm = Swarm::of(4, seed, radio, &config);
        let mut epochs = [0, 1, 1, 1, 1];
        for step in steps {
            match step {
                Step::Publish { id, voxels } => { swarm.publish(id, voxels); }
                Step::Run { ms } => swarm.run(ms * MS),
                Step::Cut { a, b } => swarm.cut(a, b),
                Step::Join { a, b } => swarm.join(a, b),
                Step::Reboot { id } => {
                    // What only the rebooted robot held is gone for ever; let it be known first.
                    swarm.cut.clear();
                    swarm.radio.loss = loss.min(0.2);
                    swarm.run(60 * SECOND);
                    swarm.radio.loss = loss;
                    epochs[usize::from(id)] += 1;
                    swarm.start(id, epochs[usize::from(id)], config.clone());
                }
            }
        }
        swarm.cut.clear();
        swarm.radio.loss = loss.min(0.2);
        swarm.run(90 * SECOND);
        let mut streams: Vec<Stream> = swarm.robots.values().flat_map(|robot| robot.session.streams()).collect();
        streams.sort_unstable();
        streams.dedup();
        streams.retain(|&stream| swarm.robots.values().any(|robot| robot.session.store().newest_known(stream) > 0));
        swarm.assert_in_sync(&streams);
        for robot in swarm.robots.values() {
            let counters = robot.session.counters();
            prop_assert_eq!(counters.received, counters.accepted + counters.chunks_accepted, "{:#?}", counters);
        }
    }
}
