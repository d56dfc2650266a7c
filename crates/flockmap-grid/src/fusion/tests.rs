mod rebuild;
mod room;
mod submaps;
mod view;

use std::collections::BTreeMap;

use proptest::prelude::*;

use super::*;
use crate::{
    MapperConfig, Pose, Preset, Scan, State, StateBlock, Voxel, VoxelBox, Which, set_bits, voxel_bit,
};

const OWN: Stream = Stream { origin: RobotId(1), epoch: 1 };

fn resolution() -> Resolution {
    Resolution::from_metres(0.5).unwrap()
}

fn mapper() -> Mapper {
    Mapper::new(MapperConfig::preset(Preset::OctoMap, resolution(), 12.0)).unwrap()
}

fn stream(origin: u16) -> Stream {
    Stream { origin: RobotId(origin), epoch: 1 }
}

/// Lets come into force what was set, a few blocks at a time.
fn finish(fusion: &mut Fusion, mapper: &Mapper) {
    while fusion.work(mapper, 5) {}
    assert!(!fusion.is_rebuilding());
}

/// The rules of fusion voxel by voxel, in plain words, over a box that holds everything: the state, and the
/// number of the robot that saw it last.
fn naive(
    mapper: &Mapper,
    fusion: &Fusion,
    alignments: &BTreeMap<u16, Pose>,
    offsets: &BTreeMap<u16, i64>,
    arrivals: &[(Stream, Stamp, Stamp)],
) -> BTreeMap<Voxel, (State, u16)> {
    let mut words: BTreeMap<Voxel, Vec<(Stamp, bool, u16)>> = BTreeMap::new();
    for (index, block) in mapper.blocks() {
        for (voxel, bit) in set_bits(&block.known()).map(|bit| (index.voxel(bit), bit)) {
            let stamp = mapper.last_seen(voxel).unwrap().plus_micros(fusion.config.own_priority_micros);
            words.entry(voxel).or_default().push((stamp, block.get(bit) == State::Occupied, OWN.origin.0));
        }
    }
    let everywhere = VoxelBox::spanning(Voxel::new(-60, -60, -60), Voxel::new(60, 60, 60)).unwrap();
    for (stream, layer) in fusion.layers().filter(|(stream, _)| *stream != OWN) {
        // Before the end of the quarter of a second in which something of the stream came that is as new.
        let came_by = |stamp: Stamp| {
            let as_new = arrivals.iter().filter(|(of, newest, _)| *of == stream && *newest >= stamp);
            Stamp(as_new.map(|(_, _, now)| (now.0 / 250_000 + 1) * 250_000).min().unwrap())
        };
        let pose = alignments.get(&stream.origin.0).copied().unwrap_or_default();
        let offset = offsets.get(&stream.origin.0).copied().unwrap_or(0);
        let mut images: BTreeMap<Voxel, (Stamp, bool)> = BTreeMap::new();
        for (voxel, state) in layer.voxels().filter(|(_, state)| *state == State::Occupied) {
            let image = resolution().voxel_at(pose.transform(resolution().centre(voxel))).unwrap();
            let word = (layer.get(voxel).unwrap().1, state == State::Occupied);
            let held = images.entry(image).or_insert(word);
            *held = word.max(*held);
        }
        for target in everywhere.voxels() {
            let source =
                resolution().voxel_at(pose.inverse().transform(resolution().centre(target))).unwrap();
            if let Some((State::Free, stamp)) = layer.get(source) {
                images.entry(target).or_insert((stamp, false));
            }
        }
        for (voxel, (stamp, occupied)) in images {
            let made = stamp.plus_micros(offset).min(came_by(stamp));
            words.entry(voxel).or_default().push((made, occupied, stream.origin.0));
        }
    }
    let decide = |words: Vec<(Stamp, bool, u16)>| {
        let (stamp, occupied) = words.iter().map(|(stamp, occupied, _)| (*stamp, *occupied)).max().unwrap();
        // The own number is the lowest one.
        let of_these = words.iter().filter(|word| (word.0, word.1) == (stamp, occupied));
        let robot = of_these.map(|word| word.2).min().unwrap();
        (if occupied { State::Occupied } else { State::Free }, robot)
    };
    words.into_iter().map(|(voxel, words)| (voxel, decide(words))).collect()
}

/// The fused map, and who saw each voxel last.
fn with_origins(mapper: &Mapper, fusion: &Fusion) -> BTreeMap<Voxel, (State, u16)> {
    let mut found = BTreeMap::new();
    for (index, states) in fusion.map().blocks() {
        for (robot, plane) in fusion.origins(mapper, index) {
            for bit in set_bits(&plane) {
                let before = found.insert(index.voxel(bit), (states.get(bit), robot.0));
                assert_eq!(before, None, "two robots for one voxel");
            }
        }
    }
    found
}

#[derive(Clone, Debug)]
enum Event {
    Scan { stamp: i64, points: Vec<[f32; 3]> },
    Package { origin: u16, stamp: i64, voxels: Vec<(Voxel, State)> },
    Align { origin: u16, pose: Pose },
}

/// Stamps of all kinds: the events of a test take five seconds at most.
fn time() -> impl Strategy<Value = i64> {
    prop_oneof![8 => -1_000_000..8_000_000i64, 1 => prop::sample::select(vec![i64::MIN, i64::MAX])]
}

fn event() -> impl Strategy<Value = Event> {
    let point = [-9.0..9.0f32, -9.0..9.0f32, -3.0..3.0f32];
    let voxel = (-14..14i32, -14..14i32, -5..5i32).prop_map(|(x, y, z)| Voxel::new(x, y, z));
    let state = prop_oneof![Just(State::Free), Just(State::Occupied)];
    let pose =
        ([-3.0..3.0f64, -3.0..3.0f64, -1.0..1.0f64], [-1.0..1.0f64, -1.0..1.0f64, -1.0..1.0f64, 0.3..1.0f64])
            .prop_map(|(t, q)| Pose::new(t, q).unwrap());
    prop_oneof![
        3 => (time(), prop::collection::vec(point, 1..12))
            .prop_map(|(stamp, points)| Event::Scan { stamp, points }),
        5 => (2..4u16, time(), prop::collection::vec((voxel, state), 1..60))
            .prop_map(|(origin, stamp, voxels)| Event::Package { origin, stamp, voxels }),
        1 => (2..4u16, pose).prop_map(|(origin, pose)| Event::Align { origin, pose }),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]

    /// Whatever happens in whatever order, the map that is kept up to date is the map made from scratch.
    #[test]
    fn the_fused_map_is_what_the_rules_say(
        events in prop::collection::vec((event(), 0..700_000i64), 1..14),
        offsets in [-2_000_000..2_000_000i64, -2_000_000..2_000_000i64], with_alignment in any::<bool>(),
    ) {
        let mut mapper = mapper();
        let config = FusionConfig { own_priority_micros: 500_000, ..FusionConfig::default() };
        let mut fusion = Fusion::new(OWN, resolution(), config);
        fusion.set_clock_offset(RobotId(3), offsets[0]);
        let (mut alignments, mut arrivals, mut now) = (BTreeMap::new(), Vec::new(), Stamp(0));
        for (event, pause) in events {
            now = now.plus_micros(pause);
            match event {
                Event::Scan { stamp, points } => {
                    let scan = Scan { stamp: Stamp(stamp), points, no_returns: Vec::new() };
                    let report = mapper.insert(&scan, &Pose::from_translation([0.1, 0.2, 0.3]), &[]);
                    fusion.own_scan(&mapper, &report);
                    // What is published of oneself must change nothing in one's own fused map.
                    let changes = mapper.take_changes(Which::All);
                    fusion.apply(&mapper, OWN, &changes, Stamp(stamp), now).unwrap();
                }
                Event::Package { origin, stamp, voxels } => {
                    let changes = Changes::from_voxels(voxels);
                    fusion.apply(&mapper, stream(origin), &changes, Stamp(stamp), now).unwrap();
                    arrivals.push((stream(origin), Stamp(stamp), now));
                }
                Event::Align { origin, pose } if with_alignment => {
                    fusion.set_alignment(RobotId(origin), &pose).unwrap();
                    finish(&mut fusion, &mapper);
                    alignments.insert(origin, pose);
                }
                Event::Align { .. } => {}
            }
        }
        let mut clocks = BTreeMap::from([(3, offsets[0])]);
        let expected = naive(&mapper, &fusion, &alignments, &clocks, &arrivals);
        let found = with_origins(&mapper, &fusion);
        prop_assert_eq!(fusion.map().voxels().count(), found.len());
        let differing: Vec<_> = expected.iter().filter(|(v, s)| found.get(v) != Some(s)).take(5).collect();
        prop_assert!(differing.is_empty(), "{differing:?}");
        prop_assert_eq!(found.len(), expected.len());
        fusion.rebuild(&mapper);
        prop_assert_eq!(with_origins(&mapper, &fusion), expected);
        // A clock that turns out to be off otherwise changes when all was made, but for what would have come
        // before.
        fusion.set_clock_offset(RobotId(3), offsets[1]);
        fusion.rebuild(&mapper);
        clocks.insert(3, offsets[1]);
        let expected = naive(&mapper, &fusion, &alignments, &clocks, &arrivals);
        prop_assert_eq!(with_origins(&mapper, &fusion), expected);
    }
}

fn source(voxels: &[(Voxel, State)]) -> Changes {
    Changes::from_voxels(voxels.iter().copied())
}

#[test]
fn a_view_stays_as_it_was_while_the_map_goes_on() {
    let mapper = mapper();
    let mut fusion = Fusion::new(OWN, resolution(), FusionConfig::default());
    let (a, b) = (Voxel::new(1, 2, 3), Voxel::new(100, -200, 3));
    fusion.apply(&mapper, stream(2), &source(&[(a, State::Free)]), Stamp(1), Stamp(1)).unwrap();
    let before = fusion.view();
    fusion
        .apply(&mapper, stream(2), &source(&[(a, State::Occupied), (b, State::Free)]), Stamp(2), Stamp(2))
        .unwrap();
    assert_eq!((before.state(a), before.state(b)), (State::Free, State::Unknown));
    assert_eq!((fusion.map().state(a), fusion.map().state(b)), (State::Occupied, State::Free));
    assert_eq!(fusion.map().changed_since(before.version()), Some(vec![a.block(), b.block()]));
    assert_eq!(fusion.map().changed_since(fusion.map().version()), Some(Vec::new()));
}

#[test]
fn a_map_that_is_made_anew_has_changed_where_it_came_out_otherwise() {
    let mapper = mapper();
    let mut fusion = Fusion::new(OWN, resolution(), FusionConfig::default());
    let row = |ys: core::ops::Range<i32>| {
        source(&ys.map(|y| (Voxel::new(3, 8 * y, 3), State::Occupied)).collect::<Vec<_>>())
    };
    fusion.apply(&mapper, stream(2), &row(0..40), Stamp(1), Stamp(1)).unwrap();
    fusion.apply(&mapper, stream(3), &row(38..42), Stamp(1), Stamp(1)).unwrap();
    let before = fusion.view();
    fusion.set_muted(RobotId(3), true);
    finish(&mut fusion, &mapper);
    let gone = [BlockIndex::new(0, 40, 0), BlockIndex::new(0, 41, 0)];
    assert_eq!(fusion.map().changed_since(before.version()), Some(gone.to_vec()));
    assert_eq!(fusion.map().block(gone[0]), None);
    assert_eq!((fusion.map().blocks().count(), fusion.map().block_count()), (40, 40));
    // With most of the map goes the knowledge of what it was.
    fusion.set_muted(RobotId(2), true);
    finish(&mut fusion, &mapper);
    assert_eq!(fusion.map().changed_since(before.version()), None);
    assert_eq!(fusion.map().changed_since(fusion.map().version()), Some(Vec::new()));
    assert_eq!((fusion.map().block_count(), fusion.memory_bytes_of_others(&mapper) > 0), (0, true));
    assert_eq!(fusion.map().memory_bytes(), 0);
}

#[test]
fn what_the_mapper_has_no_room_for_leaves_nothing_behind() {
    let mut config = MapperConfig::preset(Preset::RogMap, resolution(), 12.0);
    config.memory_bytes_max = 20 * crate::MAP_BLOCK_BYTES;
    let mut mapper = Mapper::new(config).unwrap();
    let mut fusion = Fusion::new(OWN, resolution(), FusionConfig::default());
    for step in 0..400 {
        let scan = Scan { stamp: Stamp(step), points: vec![[3.0, 0.0, 0.0]], no_returns: Vec::new() };
        let at = Pose::from_translation([step as f64 * 4.0, 0.0, 0.0]);
        let report = mapper.insert(&scan, &at, &[]);
        fusion.own_scan(&mapper, &report);
        assert!(fusion.map().block_count() <= 20);
        let room = crate::memory::table_bytes(24, 200) + 24 * 4_000;
        assert!(fusion.map().memory_bytes() < room, "{} bytes", fusion.map().memory_bytes());
    }
}

#[test]
fn muting_an_origin_takes_it_out_and_unmuting_brings_it_back_without_a_resend() {
    let mapper = mapper();
    let mut fusion = Fusion::new(OWN, resolution(), FusionConfig::default());
    let voxel = Voxel::new(1, 2, 3);
    fusion.apply(&mapper, stream(2), &source(&[(voxel, State::Occupied)]), Stamp(1), Stamp(1)).unwrap();
    fusion.set_muted(RobotId(2), true);
    finish(&mut fusion, &mapper);
    assert_eq!(fusion.map().state(voxel), State::Unknown);
    fusion.set_muted(RobotId(2), false);
    finish(&mut fusion, &mapper);
    assert_eq!(fusion.map().state(voxel), State::Occupied);
}

#[test]
fn who_mutes_others_has_only_its_own_runs_in_the_map_and_whom_it_unmutes() {
    let mapper = mapper();
    let config = FusionConfig { mutes_others: true, ..FusionConfig::default() };
    let mut fusion = Fusion::new(OWN, resolution(), config);
    let former = Stream { epoch: 0, ..OWN };
    for (x, of) in [(1, former), (2, stream(2)), (3, stream(3))] {
        let changes = source(&[(Voxel::new(x, 0, 0), State::Occupied)]);
        assert_eq!(fusion.apply(&mapper, of, &changes, Stamp(1), Stamp(1)).unwrap(), 1);
    }
    let shown =
        |fusion: &Fusion| [1, 2, 3].map(|x| fusion.map().state(Voxel::new(x, 0, 0)) == State::Occupied);
    assert_eq!(shown(&fusion), [true, false, false]);
    fusion.set_muted(RobotId(3), false);
    fusion.set_muted(RobotId(1), true);
    finish(&mut fusion, &mapper);
    assert_eq!(shown(&fusion), [false, false, true]);
    // What was set stays when the last run of an origin is forgotten; of who was left as it was nothing is kept.
    for forgotten in [former, stream(2), stream(3)] {
        fusion.forget(forgotten);
        finish(&mut fusion, &mapper);
        let changes = source(&[(Voxel::new(i32::from(forgotten.origin.0), 0, 0), State::Occupied)]);
        fusion.apply(&mapper, forgotten, &changes, Stamp(2), Stamp(2)).unwrap();
    }
    assert_eq!(shown(&fusion), [false, false, true]);
    assert_eq!(fusion.layers().map(|(_, layer)| layer.len()).collect::<Vec<_>>(), [1, 1, 1]);
}

#[test]
fn teammates_are_not_obstacles() {
    let mut mapper = mapper();
    let scan =
        Scan { stamp: Stamp(0), points: vec![[5.0, 0.0, 0.0], [0.0, 5.0, 0.0]], no_returns: Vec::new() };
    let teammate = crate::Sphere { centre: [5.2, 0.1, 0.0], radius: 0.4 };
    let report = mapper.insert(&scan, &Pose::IDENTITY, &[teammate]);
    assert_eq!((report.hits, report.masked), (1, 1));
    assert_eq!(mapper.state(Voxel::new(10, 0, 0)), State::Unknown);
    assert_eq!(mapper.state(Voxel::new(0, 10, 0)), State::Occupied);
}

#[test]
fn under_the_byte_cap_the_farthest_blocks_are_forgotten_and_that_is_no_change() {
    let mut config = MapperConfig::preset(Preset::RogMap, resolution(), 12.0);
    config.memory_bytes_max = 20 * crate::MAP_BLOCK_BYTES;
    let mut mapper = Mapper::new(config).unwrap();
    for step in 0..40 {
        let scan =
            Scan { stamp: Stamp(step), points: vec![[3.0, 0.0, 0.0]], no_returns: vec![[0.0, 30.0, 0.0]] };
        mapper.insert(&scan, &Pose::from_translation([step as f64 * 4.0, 0.0, 0.0]), &[]);
        assert!(mapper.memory_bytes() <= 20 * crate::MAP_BLOCK_BYTES);
        let pending = mapper.pending();
        assert_eq!(mapper.take_changes(Which::All).len(), pending);
        assert_eq!(mapper.pending(), 0);
    }
    assert_eq!(mapper.state(Voxel::new(6, 0, 0)), State::Unknown, "far behind");
    assert_eq!(mapper.state(Voxel::new(2 * 39 * 4 + 6, 0, 0)), State::Occupied, "just seen");
}

#[test]
fn a_snapshot_fuses_as_its_parts_do_and_leaves_no_past() {
    let mapper = mapper();
    let [a, b] = [Voxel::new(0, 0, 0), Voxel::new(1, 0, 0)];
    let parts = vec![(Stamp(1), source(&[(a, State::Free)])), (Stamp(2), source(&[(b, State::Occupied)]))];
    let region = VoxelBox::spanning(a, b).unwrap();
    let mut one_by_one = Fusion::new(OWN, resolution(), FusionConfig::default());
    for (stamp, part) in &parts {
        one_by_one.apply(&mapper, stream(2), part, *stamp, *stamp).unwrap();
    }
    let mut at_once = Fusion::new(OWN, resolution(), FusionConfig::default());
    assert_eq!(
        at_once.apply_snapshot(
            &mapper,
            stream(2),
            &Snapshot { region, parts, sensors: Vec::new() },
            false,
            Stamp(2)
        ),
        Ok(2)
    );
    for voxel in [a, b] {
        assert_eq!(at_once.map().state(voxel), one_by_one.map().state(voxel));
    }
    let layers = [&at_once, &one_by_one].map(|fusion| fusion.layer(stream(2)).unwrap());
    assert_eq!(layers[0].digest(), layers[1].digest());
    assert!(layers[0].block_before(a.block(), Stamp(2)).is_err());
    assert!(layers[1].block_before(a.block(), Stamp(2)).is_ok());
}

/// The wall that the robot sees itself at so many seconds, in front of free space of a team-mate.
fn shows_own_wall(mapper: &mut Mapper, fusion: &mut Fusion, at: i64) -> bool {
    let wall = Voxel::new(10, 0, 0);
    let points = vec![[5.2, 0.2, 0.2]; 3];
    let scan = Scan { stamp: Stamp(at * 1_000_000), points, no_returns: Vec::new() };
    let report = mapper.insert(&scan, &Pose::from_translation([0.2, 0.2, 0.2]), &[]);
    fusion.own_scan(mapper, &report);
    assert_eq!(mapper.state(wall), State::Occupied);
    fusion.map().state(wall) == State::Occupied
}

#[test]
fn what_came_with_a_stamp_of_the_future_hides_nothing_that_the_robot_sees_later() {
    let free = source(&[(Voxel::new(10, 0, 0), State::Free)]);
    for ahead in [0, 9_900_000, 3_600_000_000, i64::MAX] {
        for (offset, then) in [(0, 0), (40_000_000, 40_000_000), (0, 3_600_000_000), (-9_000_000, 0)] {
            let (mut mapper, now) = (mapper(), Stamp(100_000_000));
            let mut fusion = Fusion::new(OWN, resolution(), FusionConfig::default());
            fusion.set_clock_offset(RobotId(2), offset);
            let stamp = now.plus_micros(-offset).plus_micros(ahead);
            fusion.apply(&mapper, stream(2), &free, stamp, now).unwrap();
            assert_eq!(
                fusion.layer(stream(2)).unwrap().newest(),
                Some(stamp),
                "the layer keeps what it received"
            );
            assert_eq!(fusion.map().state(Voxel::new(10, 0, 0)), State::Free);
            // Its clock is taken to be off otherwise later on.
            fusion.set_clock_offset(RobotId(2), then);
            assert!(
                shows_own_wall(&mut mapper, &mut fusion, 100),
                "{ahead} ahead, offset {offset} then {then}"
            );
            fusion.rebuild(&mapper);
            assert_eq!(fusion.map().state(Voxel::new(10, 0, 0)), State::Occupied);
            // And what the team-mate sees later shows again, with a stamp of which the layer only knows that
            // it is newer.
            fusion
                .apply(&mapper, stream(2), &free, stamp.plus_micros(1), now.plus_micros(5_000_000))
                .unwrap();
            let is_newer = ahead != i64::MAX && ahead + then - offset > 1_000_000;
            assert_eq!(
                fusion.map().state(Voxel::new(10, 0, 0)) == State::Free,
                is_newer,
                "{ahead}, {offset}, {then}"
            );
        }
    }
}

#[test]
fn a_clock_that_is_a_day_ahead_keeps_the_map_the_one_made_from_scratch() {
    let mut mapper = mapper();
    let mut fusion = Fusion::new(OWN, resolution(), FusionConfig::default());
    let day = 86_400_000_000;
    for second in 0..6_000 {
        let voxel = Voxel::new((second % 50) as i32, 0, 0);
        let state = if second % 3 == 0 { State::Occupied } else { State::Free };
        let (stamp, now) = (Stamp(day + second), Stamp(second * 1_000_000));
        fusion.apply(&mapper, stream(2), &source(&[(voxel, state)]), stamp, now).unwrap();
        if second % 100 == 7 {
            assert!(shows_own_wall(&mut mapper, &mut fusion, second));
        }
        if second % 500 == 499 {
            let kept: Vec<_> = fusion.map().voxels().collect();
            fusion.rebuild(&mapper);
            assert_eq!(kept, fusion.map().voxels().collect::<Vec<_>>());
        }
    }
    let (layer, view) = (fusion.layer(stream(2)).unwrap().memory_bytes(), fusion.map().memory_bytes());
    let of_arrivals = fusion.memory_bytes_of_others(&mapper) - layer;
    assert!((32_000..=65_536 + view).contains(&of_arrivals), "{of_arrivals} bytes");
}

#[test]
fn an_alignment_that_is_none_is_refused_and_the_map_stays() {
    let mapper = mapper();
    let mut fusion = Fusion::new(OWN, resolution(), FusionConfig::default());
    let voxels = [(Voxel::new(5, -9, 2), State::Occupied), (Voxel::new(4, -9, 2), State::Free)];
    fusion.apply(&mapper, stream(2), &source(&voxels), Stamp(1), Stamp(1)).unwrap();
    let turned = Pose::from_yaw([3.0, 2.0, 1.0], 0.4);
    fusion.set_alignment(RobotId(2), &turned).unwrap();
    finish(&mut fusion, &mapper);
    let before: Vec<_> = fusion.map().voxels().collect();
    let far = Pose::new([1.7e308, 1.7e308, 0.0], [0.0, 0.0, 0.382, 0.924]).unwrap();
    for pose in [
        Pose::from_translation([f64::NAN, 0.0, 0.0]),
        Pose::from_yaw([1.0, 0.0, 0.0], f64::NAN),
        Pose::from_translation([1e300, 0.0, 0.0]),
        Pose::from_translation([0.0, f64::NEG_INFINITY, 0.0]),
        far,
        Pose::from_translation([0.0, 0.0, 134_217_728.0]),
    ] {
        assert!(fusion.set_alignment(RobotId(2), &pose).is_err(), "{pose:?}");
        assert!(!fusion.is_rebuilding());
        assert_eq!(fusion.map().voxels().collect::<Vec<_>>(), before);
    }
    fusion.rebuild(&mapper);
    assert_eq!(fusion.map().voxels().collect::<Vec<_>>(), before);
}

/// At the end of the grid, along each axis and turned: what stays in it is where it belongs, the rest is nowhere.
#[test]
fn what_an_alignment_brings_beyond_the_end_of_the_grid_is_left_out() {
    let mapper = mapper();
    let end = crate::VOXEL_LIMIT;
    let near_the_end = |far: i32| {
        let all = (-6..=0).flat_map(move |x| (-2..2).map(move |y| (Voxel::new(far + x, y, 0), x + y)));
        all.map(|(voxel, sum)| (voxel, if sum % 3 == 0 { State::Occupied } else { State::Free }))
    };
    for (x, yaw) in [(1.25, 0.0), (1.0, 0.0), (600.0, 0.0), (1.25, 1e-9), (-1.25, core::f64::consts::PI)] {
        let pose = Pose::from_yaw([x, 0.1, 0.0], yaw);
        let mut fusion = Fusion::new(OWN, resolution(), FusionConfig::default());
        fusion.set_alignment(RobotId(2), &pose).unwrap();
        let changes = Changes::from_voxels(near_the_end(end));
        fusion.apply(&mapper, stream(2), &changes, Stamp(1), Stamp(1)).unwrap();
        for _ in 0..2 {
            let found: BTreeMap<Voxel, State> = fusion.map().voxels().collect();
            assert!(found.keys().all(|voxel| voxel.in_limits()), "{found:?}");
            let images = near_the_end(end).filter(|(_, state)| *state == State::Occupied);
            let images =
                images.filter_map(|(v, _)| resolution().voxel_at(pose.transform(resolution().centre(v))));
            for image in images {
                assert_eq!(found.get(&image), Some(&State::Occupied), "{pose:?}: {image:?}");
            }
            for (target, state) in &found {
                let source = resolution().voxel_at(pose.inverse().transform(resolution().centre(*target)));
                let source = source.map(|source| changes.voxels().find(|(voxel, _)| *voxel == source));
                assert!(
                    *state == State::Occupied || matches!(source, Some(Some((_, State::Free)))),
                    "{target:?}"
                );
            }
            fusion.rebuild(&mapper);
        }
    }
}

#[test]
fn the_same_pose_offset_or_muting_twice_costs_nothing() {
    let mapper = mapper();
    let mut fusion = Fusion::new(OWN, resolution(), FusionConfig::default());
    let changes = source(&[3, 40].map(|x| (Voxel::new(x, 4, 5), State::Occupied)));
    fusion.apply(&mapper, stream(2), &changes, Stamp(1), Stamp(1)).unwrap();
    let turned = Pose::from_yaw([1.0, 2.0, 0.0], 0.3);
    let mut costs = |change: &dyn Fn(&mut Fusion)| {
        let before = fusion.refreshed();
        change(&mut fusion);
        finish(&mut fusion, &mapper);
        fusion.refreshed() - before
    };
    for id in [2, 3].map(RobotId) {
        let is_there = id == RobotId(2);
        let align = |fusion: &mut Fusion| fusion.set_alignment(id, &turned).unwrap();
        let mute = |fusion: &mut Fusion| fusion.set_muted(id, true);
        let unmute = |fusion: &mut Fusion| fusion.set_muted(id, false);
        let set_clock = |fusion: &mut Fusion| fusion.apply_clock_offset(id, 77);
        for change in [&align as &dyn Fn(&mut Fusion), &mute, &unmute, &set_clock] {
            assert_eq!(costs(change) > 0, is_there);
            assert_eq!(costs(change), 0);
        }
    }
    // Measured in between, it is another one for a while: then it is made anew, once.
    fusion.set_clock_offset(RobotId(2), 99);
    fusion.set_clock_offset(RobotId(2), 77);
    let before = fusion.refreshed();
    fusion.apply_clock_offset(RobotId(2), 77);
    finish(&mut fusion, &mapper);
    assert!(fusion.refreshed() > before);
    let before = fusion.refreshed();
    fusion.apply_clock_offset(RobotId(2), 77);
    finish(&mut fusion, &mapper);
    assert_eq!(fusion.refreshed(), before);
}
