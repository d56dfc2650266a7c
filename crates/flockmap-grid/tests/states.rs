//! States from elsewhere in a mapper, against a map of voxels.

use std::collections::{BTreeMap, BTreeSet};

use flockmap_grid::{
    BlockIndex, MAP_BLOCK_BYTES, Mapper, MapperConfig, Pose, Preset, Resolution, Scan, ScanReport, Stamp,
    State, States, StatesError, StatesUpdate, VOXEL_LIMIT, Voxel, VoxelBox, Which, set_bits,
};
use proptest::prelude::*;

fn resolution() -> Resolution {
    Resolution::from_metres(0.1).unwrap()
}

fn mapper(blocks_max: usize) -> Mapper {
    let preset = MapperConfig::preset(Preset::RogMap, resolution(), 3.0);
    Mapper::new(MapperConfig { memory_bytes_max: blocks_max * MAP_BLOCK_BYTES, ..preset }).unwrap()
}

const WHOLE: usize = 100_000;

fn update(stamp: i64, sensor: Option<[f64; 3]>, states: States<'_>) -> StatesUpdate<'_> {
    StatesUpdate { stamp: Stamp(stamp), resolution: resolution(), sensor, states }
}

#[derive(Clone, Debug)]
enum Step {
    Voxels(Vec<(Voxel, State)>),
    Box { region: VoxelBox, states: Vec<State>, clear_unknown: bool },
    Scan(Vec<[f32; 3]>),
    Take(Which),
}

fn voxel() -> impl Strategy<Value = Voxel> {
    (-20..20i32, -12..12i32, -9..9i32).prop_map(|(x, y, z)| Voxel::new(x, y, z))
}

fn state() -> impl Strategy<Value = State> {
    prop::sample::select(vec![State::Unknown, State::Free, State::Occupied])
}

fn step() -> impl Strategy<Value = Step> {
    let a_box =
        (voxel(), prop::array::uniform3(1..12u32), any::<bool>()).prop_flat_map(|(min, size, clear)| {
            let region = VoxelBox::new(min, size).unwrap();
            prop::collection::vec(state(), region.volume() as usize).prop_map(move |states| Step::Box {
                region,
                states,
                clear_unknown: clear,
            })
        });
    let point = [-2.0f32..2.0, -1.2f32..1.2, -0.9f32..0.9];
    prop_oneof![
        4 => prop::collection::vec((voxel(), state()), 0..60).prop_map(Step::Voxels),
        3 => a_box,
        2 => prop::collection::vec(point, 1..5).prop_map(Step::Scan),
        2 => prop::sample::select(vec![Which::All, Which::Free, Which::Occupied]).prop_map(Step::Take),
    ]
}

/// What a mapper should hold, voxel by voxel.
#[derive(Default)]
struct Model {
    states: BTreeMap<Voxel, State>,
    seen: BTreeMap<Voxel, Stamp>,
    taken: BTreeMap<Voxel, State>,
}

impl Model {
    fn state(&self, voxel: Voxel) -> State {
        self.states.get(&voxel).copied().unwrap_or_default()
    }

    /// The voxels that an update sets.
    fn set_by(&self, step: &Step) -> BTreeMap<Voxel, State> {
        match step {
            Step::Voxels(voxels) => voxels.iter().copied().collect(),
            Step::Box { region, states, clear_unknown } => {
                let (min, max) = (region.min(), region.max());
                let mut places = states.iter();
                let mut set = BTreeMap::new();
                for z in min.z..=max.z {
                    for y in min.y..=max.y {
                        for x in min.x..=max.x {
                            let (voxel, state) = (Voxel::new(x, y, z), *places.next().unwrap());
                            if state != self.state(voxel) && (*clear_unknown || state != State::Unknown) {
                                set.insert(voxel, state);
                            }
                        }
                    }
                }
                set
            }
            Step::Scan(_) | Step::Take(_) => BTreeMap::new(),
        }
    }

    fn forget(&mut self, blocks: &[BlockIndex]) {
        let blocks: BTreeSet<BlockIndex> = blocks.iter().copied().collect();
        self.states.retain(|voxel, _| !blocks.contains(&voxel.block()));
        self.seen.retain(|voxel, _| !blocks.contains(&voxel.block()));
        self.taken.retain(|voxel, _| !blocks.contains(&voxel.block()));
    }

    fn pending(&self) -> usize {
        let is_change = |(voxel, state): &(&Voxel, &State)| {
            **state != State::Unknown && self.taken.get(voxel) != Some(state)
        };
        self.states.iter().filter(is_change).count()
    }
}

fn touched(report: &ScanReport) -> BTreeSet<Voxel> {
    report.touched.iter().flat_map(|(index, plane)| set_bits(plane).map(|bit| index.voxel(bit))).collect()
}

fn agrees(mapper: &Mapper, model: &Model) -> Result<(), TestCaseError> {
    let known = |(_, state): &(Voxel, State)| *state != State::Unknown;
    let held = mapper
        .blocks()
        .flat_map(|(index, block)| (0..512).map(move |bit| (index.voxel(bit), block.get(bit))));
    let held: BTreeMap<Voxel, State> = held.filter(known).collect();
    let expected = model.states.iter().map(|(voxel, state)| (*voxel, *state)).filter(known);
    prop_assert_eq!(held, expected.collect::<BTreeMap<_, _>>());
    prop_assert_eq!(mapper.pending(), model.pending());
    for (voxel, stamp) in &model.seen {
        // A voxel that was never known has no block to note it in.
        prop_assert!(mapper.last_seen(*voxel) == Some(*stamp) || mapper.state(*voxel) == State::Unknown);
        let is = match mapper.log_odds(*voxel).map(|nats| 1.0 / (1.0 + (-nats).exp())) {
            Some(p) if p > 0.849 => State::Occupied,
            Some(p) if p < 0.499 => State::Free,
            _ => State::Unknown,
        };
        prop_assert_eq!(is, mapper.state(*voxel), "what scans go on from, at {:?}", voxel);
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 128, ..ProptestConfig::default() })]

    #[test]
    fn a_mapper_that_is_told_states_agrees_with_a_map_of_voxels(
        steps in prop::collection::vec(step(), 1..14),
        blocks_max in prop_oneof![2 => Just(WHOLE), 1 => 8..40usize],
        sensor in prop_oneof![1 => Just(None), 1 => prop::array::uniform3(-1.0..1.0).prop_map(Some)],
    ) {
        let (mut mapper, mut model) = (mapper(blocks_max), Model::default());
        for (number, step) in (1..).zip(&steps) {
            let set = model.set_by(step);
            let report = match step {
                Step::Voxels(voxels) => {
                    mapper.insert_states(&update(number, sensor, States::Voxels(voxels))).unwrap()
                }
                Step::Box { region, states, clear_unknown } => {
                    let states = States::Box { region: *region, states, clear_unknown: *clear_unknown };
                    mapper.insert_states(&update(number, sensor, states)).unwrap()
                }
                Step::Scan(points) => {
                    let scan = Scan { stamp: Stamp(number), points: points.clone(), no_returns: Vec::new() };
                    mapper.insert(&scan, &Pose::IDENTITY, &[])
                }
                Step::Take(which) => {
                    for (voxel, state) in mapper.take_changes(*which).voxels() {
                        prop_assert_eq!(state, model.state(voxel));
                        prop_assert!(model.taken.insert(voxel, state) != Some(state));
                    }
                    ScanReport::default()
                }
            };
            prop_assert!(mapper.block_count() <= blocks_max && mapper.memory_bytes() <= blocks_max * MAP_BLOCK_BYTES);
            model.forget(&report.forgotten);
            let touched = touched(&report);
            if let Step::Voxels(_) | Step::Box { .. } = step {
                let kept = |voxel: &Voxel| report.forgotten.binary_search(&voxel.block()).is_err();
                let expected = set.iter().filter(|(voxel, _)| kept(voxel));
                // What was never known cannot be taken back.
                let noted = |voxel: &Voxel, state: State| {
                    state != State::Unknown || touched.contains(voxel) || mapper.block(voxel.block()).is_none()
                };
                for (voxel, state) in expected {
                    prop_assert!(noted(voxel, *state) && (*state == State::Unknown || touched.contains(voxel)));
                }
                prop_assert!(touched.iter().all(|voxel| set.contains_key(voxel)));
                let changed = touched.iter().filter(|voxel| {
                    set[voxel] != model.state(**voxel) && set[voxel] != State::Unknown
                });
                let reported: u32 = report.changed.iter().map(|(_, block)| block.known_count()).sum();
                prop_assert_eq!(reported as usize, changed.count());
            }
            for voxel in &touched {
                let state = set.get(voxel).copied().unwrap_or_else(|| mapper.state(*voxel));
                model.states.insert(*voxel, state);
                model.seen.insert(*voxel, Stamp(number));
            }
            agrees(&mapper, &model)?;
        }
    }

    #[test]
    fn a_box_that_comes_again_changes_nothing(steps in prop::collection::vec(step(), 1..8)) {
        let mut mapper = mapper(WHOLE);
        for (number, step) in (1..).zip(&steps) {
            let Step::Box { region, states, clear_unknown } = step else { continue };
            let states = States::Box { region: *region, states, clear_unknown: *clear_unknown };
            mapper.insert_states(&update(2 * number, None, states)).unwrap();
            let (pending, seen) = (mapper.pending(), mapper.last_seen(region.min()));
            let again = mapper.insert_states(&update(2 * number + 1, None, states)).unwrap();
            prop_assert_eq!(again, ScanReport { stamp: Stamp(2 * number + 1), ..ScanReport::default() });
            prop_assert_eq!((mapper.pending(), mapper.last_seen(region.min())), (pending, seen));
        }
    }
}

#[test]
fn a_full_map_keeps_what_is_near_the_sensor_or_else_what_was_said_last() {
    let row = |from: i32| -> Vec<(Voxel, State)> {
        (0..30).map(|block| (Voxel::new(from + 8 * block, 0, 0), State::Free)).collect()
    };
    let far = [-100.0, 0.0, 0.0];
    for (sensor, kept) in [(None, 15), (Some([0.0; 3]), 0)] {
        let mut mapper = mapper(20);
        let report = mapper.insert_states(&update(1, sensor, States::Voxels(&row(0)))).unwrap();
        assert_eq!((mapper.block_count(), report.forgotten.len(), report.touched.len()), (18, 12, 18));
        assert_eq!(mapper.state(Voxel::new(8 * kept, 0, 0)), State::Free);
        // What comes next is far away: without the sensor's place it is there that the map is kept.
        mapper.insert_states(&update(2, sensor, States::Voxels(&row(-100_000)))).unwrap();
        assert_eq!(mapper.state(Voxel::new(8 * kept, 0, 0)) == State::Free, sensor.is_some());
        mapper.insert_states(&update(3, Some(far), States::Voxels(&row(-1_000)))).unwrap();
        assert_eq!(mapper.state(Voxel::new(-1_000, 0, 0)), State::Free);
    }
}

#[test]
fn scans_go_on_from_what_was_said() {
    for (preset, misses) in [(Preset::RogMap, 54), (Preset::OctoMap, 9)] {
        let mut mapper = Mapper::new(MapperConfig::preset(preset, resolution(), 3.0)).unwrap();
        let voxel = Voxel::new(10, 0, 0);
        mapper.insert_states(&update(1, None, States::Voxels(&[(voxel, State::Occupied)]))).unwrap();
        let scan = Scan { stamp: Stamp(2), points: vec![[2.05, 0.05, 0.05]], no_returns: Vec::new() };
        let pose = Pose::from_translation([0.0, 0.05, 0.05]);
        let scan = Scan { points: vec![[2.05, 0.0, 0.0]], ..scan };
        let mut scans = 0;
        while mapper.state(voxel) == State::Occupied {
            mapper.insert(&scan, &pose, &[]);
            scans += 1;
        }
        assert_eq!(scans, misses, "{preset}");
        // And what is said later sets what scans have made.
        mapper.insert_states(&update(3, None, States::Voxels(&[(voxel, State::Unknown)]))).unwrap();
        assert_eq!((mapper.state(voxel), mapper.log_odds(voxel)), (State::Unknown, None));
        mapper.insert(&scan, &pose, &[]);
        assert_eq!(mapper.state(voxel), State::Free);
    }
}

#[test]
fn what_cannot_be_taken_in_is_named_and_changes_nothing() {
    let mut mapper = mapper(WHOLE);
    let one = [(Voxel::new(1, 2, 3), State::Free)];
    let good = update(1, None, States::Voxels(&one));
    let refused = |mapper: &mut Mapper, update: StatesUpdate<'_>| mapper.insert_states(&update).unwrap_err();
    let coarse = Resolution::from_metres(0.2).unwrap();
    let error = refused(&mut mapper, StatesUpdate { resolution: coarse, ..good });
    assert_eq!(error, StatesError::Resolution { got: coarse, expected: resolution() });
    for sensor in [[f64::NAN, 0.0, 0.0], [1e9, 0.0, 0.0]] {
        let error = refused(&mut mapper, StatesUpdate { sensor: Some(sensor), ..good });
        assert!(matches!(error, StatesError::Sensor(_)), "{error}");
    }
    let far = [one[0], (Voxel::new(0, VOXEL_LIMIT, 0), State::Free)];
    let error = refused(&mut mapper, update(1, None, States::Voxels(&far)));
    assert_eq!(error, StatesError::BeyondGrid { voxel: far[1].0, limit: VOXEL_LIMIT - 1_024 });
    let lowest = [(Voxel::new(i32::MIN, 0, 0), State::Free)];
    assert!(matches!(
        refused(&mut mapper, update(1, None, States::Voxels(&lowest))),
        StatesError::BeyondGrid { .. }
    ));
    let many = vec![one[0]; StatesUpdate::VOXELS_MAX + 1];
    let error = refused(&mut mapper, update(1, None, States::Voxels(&many)));
    assert!(matches!(error, StatesError::TooMany { got: 4_194_305, .. }), "{error}");
    let mut of_box = |min: Voxel, size: [u32; 3], states: &[State]| {
        let region = VoxelBox::new(min, size).unwrap();
        refused(&mut mapper, update(1, None, States::Box { region, states, clear_unknown: true }))
    };
    let error = of_box(Voxel::new(0, 0, 0), [1 << 28, 1 << 28, 1], &[]);
    assert!(matches!(error, StatesError::TooMany { got, .. } if got == 1 << 56), "{error}");
    let error = of_box(Voxel::new(0, 0, 0), [2, 2, 2], &[State::Free; 7]);
    assert!(error.to_string().contains("7 states") && error.to_string().contains("8 voxels"), "{error}");
    let error = of_box(Voxel::new(VOXEL_LIMIT - 1, 0, 0), [2, 1, 1], &[State::Free; 2]);
    assert!(matches!(error, StatesError::BeyondGrid { .. }), "{error}");
    assert_eq!((mapper.block_count(), mapper.pending()), (0, 0));
    // As far as it goes.
    let last = [(Voxel::new(VOXEL_LIMIT - 1_024, 1_024 - VOXEL_LIMIT, 0), State::Free)];
    assert!(mapper.insert_states(&update(1, None, States::Voxels(&last))).is_ok());
}
