//! What is set or forgotten comes into force in slices.

use super::*;

/// What can happen to a map.
#[derive(Clone, Debug)]
enum Step {
    Scan(Vec<[f32; 3]>),
    Package(u16, i64, Vec<(Voxel, State)>),
    Align(u16, Pose),
    Mute(u16, bool),
    /// Set, or measured.
    Clock(u16, i64, bool),
    Forget(u16),
    Work(usize),
}

fn step() -> impl Strategy<Value = Step> {
    let point = [-9.0..9.0f32, -9.0..9.0f32, -3.0..3.0f32];
    let voxel = (-30..30i32, -14..14i32, -5..5i32).prop_map(|(x, y, z)| Voxel::new(x, y, z));
    let state = prop_oneof![Just(State::Free), Just(State::Occupied)];
    let origin = 2..5u16;
    let pose = ([-3.0..3.0f64, -3.0..3.0, -1.0..1.0], [-1.0..1.0f64, -1.0..1.0, -1.0..1.0, 0.3..1.0f64]);
    let pose = prop_oneof![
        3 => pose.prop_map(|(t, q)| Pose::new(t, q).unwrap()),
        1 => Just(Pose::IDENTITY),
        1 => (-9..9i32).prop_map(|x| Pose::from_translation([f64::from(x), 0.0, 0.0])),
    ];
    prop_oneof![
        2 => prop::collection::vec(point, 1..12).prop_map(Step::Scan),
        5 => (origin.clone(), -2_000_000..3_000_000i64, prop::collection::vec((voxel, state), 1..60))
            .prop_map(|(origin, stamp, voxels)| Step::Package(origin, stamp, voxels)),
        2 => (origin.clone(), pose).prop_map(|(origin, pose)| Step::Align(origin, pose)),
        2 => (origin.clone(), any::<bool>()).prop_map(|(origin, is)| Step::Mute(origin, is)),
        2 => (origin.clone(), -3_000_000..3_000_000i64, any::<bool>())
            .prop_map(|(origin, micros, is_set)| Step::Clock(origin, micros, is_set)),
        1 => origin.prop_map(Step::Forget),
        8 => (0..40usize).prop_map(Step::Work),
    ]
}

/// A client of versions, which takes over what changed since it last looked.
struct Client {
    at: u64,
    blocks: BTreeMap<BlockIndex, StateBlock>,
}

impl Client {
    fn look(&mut self, map: &MapView) {
        let all = || map.blocks().collect::<BTreeMap<_, _>>();
        match map.changed_since(self.at) {
            None => self.blocks = all(),
            Some(changed) => changed.into_iter().for_each(|index| {
                match map.block(index) {
                    Some(block) => self.blocks.insert(index, block),
                    None => self.blocks.remove(&index),
                };
            }),
        }
        self.at = map.version();
        assert!(self.blocks == all(), "who took over what changed has another map");
    }
}

fn voxels(fusion: &Fusion) -> Vec<(Voxel, State)> {
    fusion.map().voxels().collect()
}

/// One thing done to a map.
fn take(step: &Step, mapper: &mut Mapper, fusions: &mut [&mut Fusion], now: Stamp) {
    if let Step::Scan(points) = step {
        let scan = Scan { stamp: now, points: points.clone(), no_returns: Vec::new() };
        let report = mapper.insert(&scan, &Pose::from_translation([0.1, 0.2, 0.3]), &[]);
        fusions.iter_mut().for_each(|fusion| fusion.own_scan(mapper, &report));
    }
    for fusion in fusions {
        match step {
            Step::Scan(_) | Step::Work(_) => {}
            Step::Package(origin, stamp, voxels) => {
                let changes = Changes::from_voxels(voxels.iter().copied());
                fusion.apply(mapper, stream(*origin), &changes, Stamp(*stamp), now).unwrap();
            }
            Step::Align(origin, pose) => fusion.set_alignment(RobotId(*origin), pose).unwrap(),
            Step::Mute(origin, is_muted) => fusion.set_muted(RobotId(*origin), *is_muted),
            Step::Clock(origin, micros, true) => fusion.apply_clock_offset(RobotId(*origin), *micros),
            Step::Clock(origin, micros, false) => fusion.set_clock_offset(RobotId(*origin), *micros),
            Step::Forget(origin) => fusion.forget(stream(*origin)),
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]

    /// Whatever is set, received, seen and forgotten while it goes on: it ends with the map by what was set last, no
    /// slice is larger than asked for, and who follows versions never misses anything.
    #[test]
    fn a_map_made_in_slices_is_the_one_made_at_once(
        steps in prop::collection::vec((step(), any::<bool>()), 1..40),
    ) {
        let (mut mapper, mut now) = (mapper(), Stamp(0));
        let new = || Fusion::new(OWN, resolution(), FusionConfig::default());
        let (mut sliced, mut at_once) = (new(), new());
        let mut clients = [0, 1].map(|_| Client { at: 0, blocks: BTreeMap::new() });
        for (step, looks) in &steps {
            now = now.plus_micros(100_000);
            take(step, &mut mapper, &mut [&mut sliced, &mut at_once], now);
            at_once.rebuild(&mapper);
            if let Step::Work(blocks_max) = step {
                let before = (sliced.refreshed(), sliced.is_rebuilding(), voxels(&sliced));
                let is_more = sliced.work(&mapper, *blocks_max);
                prop_assert!(sliced.refreshed() - before.0 <= (*blocks_max).max(1) as u64);
                prop_assert_eq!(is_more, sliced.has_work());
                prop_assert!(sliced.cubes_left().is_none() || voxels(&sliced) == before.2, "half of the new");
                prop_assert!(before.1 || sliced.refreshed() == before.0);
            }
            clients[1].look(sliced.map());
            if *looks {
                clients[0].look(sliced.map());
                sliced.maps_mut().for_each(|fused| fused.view.pack());
            }
        }
        // What was measured alone counts for what is fused from then on.
        for id in 2..5 {
            let offset = sliced.wanted.origin(RobotId(id)).clock_offset_micros;
            sliced.apply_clock_offset(RobotId(id), offset);
        }
        finish(&mut sliced, &mapper);
        clients.iter_mut().for_each(|client| client.look(sliced.map()));
        prop_assert_eq!(voxels(&sliced), voxels(&at_once));
        prop_assert_eq!(with_origins(&mapper, &sliced), with_origins(&mapper, &at_once));
        let streams = |fusion: &Fusion| fusion.layers().map(|(s, layer)| (s, layer.digest())).collect::<Vec<_>>();
        prop_assert_eq!(streams(&sliced), streams(&at_once));
        prop_assert_eq!(sliced.sources.bytes(), at_once.sources.bytes());
        let kept = voxels(&sliced);
        sliced.rebuild(&mapper);
        prop_assert_eq!(voxels(&sliced), kept);
    }

    /// Of two robots that hear the same, one is told nothing new: until the other has made its map anew, it shows the
    /// same.
    #[test]
    fn until_all_is_worked_out_the_map_is_the_one_by_the_settings_before(
        before in prop::collection::vec(step(), 1..20),
        settings in prop::collection::vec(step(), 1..8),
        during in prop::collection::vec(step(), 1..20),
    ) {
        let (mut mapper, mut now) = (mapper(), Stamp(0));
        let new = || Fusion::new(OWN, resolution(), FusionConfig::default());
        let (mut sliced, mut plain) = (new(), new());
        let far = Changes::from_voxels([(Voxel::new(90, 90, 90), State::Free)]);
        for step in &before {
            now = now.plus_micros(100_000);
            take(step, &mut mapper, &mut [&mut sliced, &mut plain], now);
            plain.rebuild(&mapper);
            sliced.rebuild(&mapper);
        }
        for origin in 2..5 {
            for fusion in [&mut sliced, &mut plain] {
                fusion.apply(&mapper, stream(origin), &far, now, now).unwrap();
            }
        }
        let is_setting = |step: &Step| {
            matches!(step, Step::Align(..) | Step::Mute(..) | Step::Clock(_, _, true) | Step::Forget(_))
        };
        for step in settings.iter().filter(|step| is_setting(step)) {
            let before = sliced.refreshed();
            take(step, &mut mapper, &mut [&mut sliced], now);
            prop_assert_eq!(sliced.refreshed(), before, "it returns at once");
        }
        let forgotten: Vec<_> = settings.iter().filter(|step| matches!(step, Step::Forget(_))).collect();
        for step in &during {
            now = now.plus_micros(100_000);
            if matches!(step, Step::Scan(_) | Step::Package(..)) && forgotten.is_empty() {
                take(step, &mut mapper, &mut [&mut sliced, &mut plain], now);
            }
            sliced.work(&mapper, 1);
            if !sliced.is_rebuilding() {
                break;
            }
            prop_assert_eq!(voxels(&sliced), voxels(&plain));
        }
    }
}

/// A row of blocks with one voxel each.
fn row(ys: core::ops::Range<i32>, state: State) -> Changes {
    Changes::from_voxels(ys.map(|y| (Voxel::new(3, 8 * y, 3), state)))
}

#[test]
fn a_slice_works_out_as_many_blocks_as_asked_for_and_only_what_is_reached() {
    let mapper = mapper();
    let mut fusion = Fusion::new(OWN, resolution(), FusionConfig::default());
    fusion.apply(&mapper, stream(2), &row(0..1_000, State::Free), Stamp(1), Stamp(1)).unwrap();
    fusion.apply(&mapper, stream(3), &row(5_000..9_000, State::Free), Stamp(1), Stamp(1)).unwrap();
    fusion.set_muted(RobotId(2), true);
    let (before, mut slices) = (fusion.refreshed(), 0);
    loop {
        let before = fusion.refreshed();
        let is_more = fusion.work(&mapper, 50);
        assert!(fusion.refreshed() - before <= 50);
        slices += 1;
        assert_eq!(fusion.map().block_count(), if is_more { 5_000 } else { 4_000 });
        if !is_more {
            break;
        }
    }
    assert_eq!(fusion.refreshed() - before, 1_000, "each of its blocks once, and none of the other's");
    assert!((20..60).contains(&slices), "{slices}");
}

#[test]
fn what_is_set_while_a_map_is_made_comes_into_force_after_it() {
    let mapper = mapper();
    let mut fusion = Fusion::new(OWN, resolution(), FusionConfig::default());
    fusion.apply(&mapper, stream(2), &row(0..100, State::Free), Stamp(1), Stamp(1)).unwrap();
    let at = |x: f64| Pose::from_translation([x, 0.0, 0.0]);
    let shown = |fusion: &Fusion| fusion.map().bounding_box().unwrap().min().x;
    fusion.set_alignment(RobotId(2), &at(10.0)).unwrap();
    assert!(fusion.work(&mapper, 10));
    // Another one: the map that is being made comes first, so that one comes into force however often others are set.
    fusion.set_alignment(RobotId(2), &at(20.0)).unwrap();
    let mut seen = vec![shown(&fusion)];
    while fusion.work(&mapper, 10) {
        seen.push(shown(&fusion));
    }
    seen.push(shown(&fusion));
    seen.dedup();
    assert_eq!(seen, [3, 23, 43]);
    // Back again before it began: nothing is to do.
    let before = fusion.refreshed();
    fusion.set_alignment(RobotId(2), &at(10.0)).unwrap();
    fusion.set_alignment(RobotId(2), &at(20.0)).unwrap();
    assert!(!fusion.work(&mapper, 10));
    assert_eq!((fusion.refreshed(), fusion.is_rebuilding()), (before, false));
    // The one that is being made once more: it is not begun anew.
    fusion.set_alignment(RobotId(2), &at(10.0)).unwrap();
    while fusion.work(&mapper, 10) {
        fusion.set_alignment(RobotId(2), &at(10.0)).unwrap();
    }
    assert_eq!((fusion.refreshed() - before, shown(&fusion)), (200, 23));
}

#[test]
fn an_offset_that_is_measured_while_another_one_is_to_come_changes_nothing_that_is_shown() {
    let mut mapper = mapper();
    let mut fusion = Fusion::new(OWN, resolution(), FusionConfig::default());
    fusion.apply(&mapper, stream(2), &row(0..100, State::Free), Stamp(1), Stamp(1)).unwrap();
    fusion.apply_clock_offset(RobotId(2), 5_000_000);
    assert!(fusion.work(&mapper, 10));
    // Every package says once more which offset is set.
    fusion.set_clock_offset(RobotId(2), 5_000_000);
    fusion.set_clock_offset(RobotId(2), 5_000_001);
    let wall = Voxel::new(10, 0, 0);
    let free = source(&[(wall, State::Free)]);
    assert!(shows_own_wall(&mut mapper, &mut fusion, 9));
    // By its own clock before the wall was seen, by the other one after it.
    fusion.apply(&mapper, stream(2), &free, Stamp(8_000_000), Stamp(20_000_000)).unwrap();
    assert_eq!(fusion.map().state(wall), State::Occupied);
    finish(&mut fusion, &mapper);
    assert_eq!(fusion.map().state(wall), State::Free);
    fusion.apply_clock_offset(RobotId(2), 0);
    finish(&mut fusion, &mapper);
    assert_eq!(fusion.map().state(wall), State::Occupied);
}

#[test]
fn a_stream_that_is_forgotten_stays_in_the_map_and_in_memory_until_the_map_is_made_without_it() {
    let mapper = mapper();
    let config = FusionConfig { streams_max: 2, ..FusionConfig::default() };
    let mut fusion = Fusion::new(OWN, resolution(), config);
    fusion.apply(&mapper, stream(2), &row(0..100, State::Free), Stamp(1), Stamp(1)).unwrap();
    fusion.set_clock_offset(RobotId(2), 7);
    let held = fusion.memory_bytes_of_others(&mapper);
    fusion.forget(stream(2));
    assert!(fusion.layer(stream(2)).is_none() && fusion.layers().next().is_none());
    assert_eq!((fusion.map().block_count(), fusion.memory_bytes_of_others(&mapper)), (100, held));
    assert_eq!(fusion.sensors().count(), 0);
    // It comes back while it is leaving, with nothing of what it had.
    fusion.work(&mapper, 10);
    fusion.apply(&mapper, stream(2), &row(50..51, State::Occupied), Stamp(2), Stamp(2)).unwrap();
    assert_eq!(fusion.layer(stream(2)).unwrap().block_count(), 1);
    assert_eq!(fusion.map().block_count(), 100);
    assert_eq!(fusion.map().state(Voxel::new(3, 400, 3)), State::Occupied);
    assert!(fusion.memory_bytes_of_others(&mapper) > held);
    // And is forgotten once more; as many may be leaving as there may be.
    fusion.forget(stream(2));
    let full = fusion.apply(&mapper, stream(3), &row(0..1, State::Free), Stamp(2), Stamp(2));
    assert_eq!(full, Err(FusionError::StreamsFull(stream(3), 2)));
    finish(&mut fusion, &mapper);
    assert_eq!((fusion.map().block_count(), fusion.memory_bytes_of_others(&mapper)), (0, 0));
    fusion.apply(&mapper, stream(3), &row(0..1, State::Free), Stamp(2), Stamp(2)).unwrap();
    // With the last one goes how far its clock was off.
    assert_eq!(fusion.wanted.origin(RobotId(2)).clock_offset_micros, 0);
    assert_eq!(fusion.shown.settings.origin(RobotId(2)).clock_offset_micros, 0);
}

#[test]
fn the_limit_of_bytes_counts_both_maps() {
    let mapper = mapper();
    let config = FusionConfig { layer_bytes_max: 200_000, ..FusionConfig::default() };
    let mut fusion = Fusion::new(OWN, resolution(), config);
    let mut blocks = 0;
    while fusion.take_dropped().is_empty() {
        fusion.apply(&mapper, stream(2), &row(blocks..blocks + 1, State::Free), Stamp(1), Stamp(1)).unwrap();
        blocks += 1;
    }
    let held = fusion.memory_bytes_of_others(&mapper);
    fusion.set_alignment(RobotId(2), &Pose::from_translation([64.0, 0.0, 0.0])).unwrap();
    let (mut most, mut dropped) = (0, 0);
    while fusion.work(&mapper, 9) {
        let view = fusion.next.as_ref().map_or(0, |next| next.fused.view.memory_bytes());
        let both = fusion.memory_bytes_of_others(&mapper);
        assert!(both <= held + view, "{held}, {view}: {both}");
        most = most.max(both);
        // There is room for the one map, and not for both.
        fusion.apply(&mapper, stream(3), &row(0..1, State::Free), Stamp(2), Stamp(2)).unwrap();
        dropped += fusion.take_dropped().iter().map(|dropped| dropped.blocks).sum::<usize>();
    }
    assert!(most > held && dropped > 0, "{held}, {most}: {dropped}");
}
