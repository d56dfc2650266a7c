//! A map that comes from elsewhere: what is published of it, and what a team-mate ends with.

#[allow(dead_code, reason = "no layer is compared with an own map as a whole here")]
mod common;

use std::collections::BTreeMap;

use common::{PERFECT, Random, Swarm, config, resolution, scan};
use flockmap::{Event, Pose, Stamp, State, States, StatesError, StatesUpdate, Voxel, VoxelBox};
use proptest::prelude::*;

#[derive(Clone, Debug)]
enum Step {
    Voxels(Vec<(Voxel, State)>),
    Box { region: VoxelBox, states: Vec<State>, clear_unknown: bool },
    Scan(u64),
    Wait(i64),
}

fn voxel() -> impl Strategy<Value = Voxel> {
    (-30..30i32, -20..20i32, -6..6i32).prop_map(|(x, y, z)| Voxel::new(x, y, z))
}

fn step() -> impl Strategy<Value = Step> {
    let state = || prop::sample::select(vec![State::Unknown, State::Free, State::Occupied]);
    let a_box =
        (voxel(), prop::array::uniform3(1..16u32), any::<bool>()).prop_flat_map(move |(min, size, clear)| {
            let region = VoxelBox::new(min, size).unwrap();
            prop::collection::vec(state(), region.volume() as usize).prop_map(move |states| Step::Box {
                region,
                states,
                clear_unknown: clear,
            })
        });
    prop_oneof![
        3 => prop::collection::vec((voxel(), state()), 0..200).prop_map(Step::Voxels),
        3 => a_box,
        1 => any::<u64>().prop_map(Step::Scan),
        3 => (0..900i64).prop_map(Step::Wait),
    ]
}

fn insert(swarm: &mut Swarm, sensor: Option<[f64; 3]>, states: States<'_>) {
    insert_into(swarm, 0, sensor, states);
}

fn insert_into(swarm: &mut Swarm, robot: usize, sensor: Option<[f64; 3]>, states: States<'_>) {
    let update = StatesUpdate { stamp: swarm.now, resolution: resolution(), sensor, states };
    swarm.robots[robot].insert_states(swarm.now, &update).unwrap();
}

/// All that a robot has published, as its events say.
fn published(swarm: &Swarm) -> BTreeMap<Voxel, State> {
    let closed = swarm.events[0].iter().filter_map(|event| match event {
        Event::BatchClosed { changes, .. } => Some(changes),
        _ => None,
    });
    closed.flat_map(|changes| changes.voxels()).collect()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]

    #[test]
    fn team_mates_end_with_what_was_said(
        steps in prop::collection::vec(step(), 1..12),
        sensor in prop_oneof![1 => Just(None), 1 => prop::array::uniform3(-1.0..1.0).prop_map(Some)],
    ) {
        let mut swarm = Swarm::new(vec![config(1), config(2)], PERFECT, 7);
        let mut model = BTreeMap::<Voxel, State>::new();
        let (mut updates, mut scans) = (0, 0);
        for step in &steps {
            match step {
                Step::Voxels(voxels) => {
                    insert(&mut swarm, sensor, States::Voxels(voxels));
                    model.extend(voxels.iter().copied());
                    updates += 1;
                }
                Step::Box { region, states, clear_unknown } => {
                    let said = States::Box { region: *region, states, clear_unknown: *clear_unknown };
                    insert(&mut swarm, sensor, said);
                    // The order of voxels in a box, once more: z outermost.
                    let (min, [width, depth, _]) = (region.min(), region.size().map(|side| side as i32));
                    for (place, state) in (0..).zip(states) {
                        let (x, y, z) = (place % width, place / width % depth, place / width / depth);
                        if *clear_unknown || *state != State::Unknown {
                            model.insert(Voxel::new(min.x + x, min.y + y, min.z + z), *state);
                        }
                    }
                    updates += 1;
                }
                Step::Scan(seed) => {
                    let scan = scan(&mut Random(*seed), swarm.now);
                    swarm.scan(0, &scan, &Pose::IDENTITY);
                    // What scans make of voxels is tested elsewhere.
                    for (index, block) in swarm.robots[0].mapper().blocks() {
                        model.extend((0..512).map(|bit| (index.voxel(bit), block.get(bit))));
                    }
                    scans += 1;
                }
                Step::Wait(ms) => swarm.run(*ms),
            }
            let mapper = swarm.robots[0].mapper();
            for (voxel, state) in &model {
                prop_assert_eq!((mapper.state(*voxel), swarm.robots[0].map().state(*voxel)), (*state, *state));
            }
        }
        swarm.settle(20_000);
        prop_assert!(swarm.agrees());
        prop_assert_eq!(swarm.robots[0].unpublished(), 0);
        let counters = swarm.robots[0].counters();
        prop_assert_eq!((counters.states, counters.states_ahead, counters.scans), (updates, 0, scans));

        swarm.assert_layers_equal_own_maps(7);
        let published = published(&swarm);
        let listener = &swarm.robots[1];
        for (voxel, state) in &model {
            let there = listener.map().state(*voxel);
            // What was taken back stays as it was published.
            prop_assert!(*state == State::Unknown || there == *state, "{:?}", voxel);
            prop_assert_eq!(there, published.get(voxel).copied().unwrap_or_default(), "{:?}", voxel);
        }
        let (free, occupied) = listener.map().count();
        prop_assert_eq!(free + occupied, published.len(), "and nothing else");

        // All of it again as boxes: nothing is new.
        let batches = counters.batches;
        if let Some(region) = model.keys().filter_map(|v| VoxelBox::spanning(*v, *v)).reduce(|a, b| a.union(&b)) {
            let (min, max) = (region.min(), region.max());
            let rows = (min.z..=max.z).flat_map(|z| (min.y..=max.y).map(move |y| (y, z)));
            let voxels = rows.flat_map(|(y, z)| (min.x..=max.x).map(move |x| Voxel::new(x, y, z)));
            let states: Vec<State> = voxels.map(|voxel| model.get(&voxel).copied().unwrap_or_default()).collect();
            insert(&mut swarm, sensor, States::Box { region, states: &states, clear_unknown: true });
            prop_assert_eq!(swarm.robots[0].unpublished(), 0);
            swarm.settle(1_000);
            prop_assert_eq!(swarm.robots[0].counters().batches, batches);
        }
    }
}

#[test]
fn what_a_robot_takes_back_it_knows_from_its_team_mates() {
    let mut swarm = Swarm::new(vec![config(1), config(2)], PERFECT, 1);
    let voxel = Voxel::new(5, 5, 5);
    for (robot, state) in [(1, State::Free), (0, State::Occupied)] {
        insert_into(&mut swarm, robot, None, States::Voxels(&[(voxel, state)]));
        swarm.settle(5_000);
    }
    assert_eq!(swarm.robots[0].map().state(voxel), State::Occupied);
    insert(&mut swarm, None, States::Voxels(&[(voxel, State::Unknown)]));
    assert_eq!(swarm.robots[0].map().state(voxel), State::Free, "as the other said");
    swarm.settle(5_000);
    let kept = swarm.robots[1].fusion().layer(swarm.robots[0].own_stream()).unwrap();
    assert_eq!(kept.state(voxel), State::Occupied, "nobody hears that it was taken back");
}

#[test]
fn states_from_the_future_are_of_now_and_faults_change_nothing() {
    let mut swarm = Swarm::new(vec![config(1)], PERFECT, 1);
    let (now, robot) = (swarm.now, &mut swarm.robots[0]);
    let said = [(Voxel::new(0, 0, 0), State::Free)];
    let stamp = now.plus_micros(9_000_000);
    let good = StatesUpdate { stamp, resolution: resolution(), sensor: None, states: States::Voxels(&said) };
    let wrong = StatesUpdate { sensor: Some([f64::INFINITY; 3]), ..good };
    // Nor is the clock put forward by what is refused.
    let later = Stamp(i64::MAX);
    assert!(matches!(robot.insert_states(later, &wrong), Err(StatesError::Sensor(_))));
    assert_eq!((robot.counters().states, robot.unpublished()), (0, 0));
    let report = robot.insert_states(now, &good).unwrap();
    assert_eq!(report.stamp, now);
    assert_eq!((robot.counters().states, robot.counters().states_ahead), (1, 1));
    assert_eq!(robot.mapper().last_seen(Voxel::new(0, 0, 0)), Some(now));
}
