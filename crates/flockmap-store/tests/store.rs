//! The store: cut at every byte, spoilt, and on disks that fail.

mod common;

use std::collections::BTreeMap;
use std::sync::OnceLock;

use common::swarm::{PERFECT, Radio, Random, Swarm, config};
use common::{
    Model, OPTIONS, Writer, contents, fly, open, restart, small_log, small_scan, start, store_events, swarm,
    two,
};
use flockmap::codec::Content;
use flockmap::{Codec, Event, Package, Pose, RestoreError, Robot, RobotConfig, RobotId, Stamp, Stream};
use flockmap_store::Notice;
use flockmap_store::memory::{Faults, MemoryDisk};
use proptest::prelude::*;

#[test]
fn a_kill_at_any_byte_loses_what_was_behind_it_and_nothing_else() {
    for codec in [Codec::Flock, Codec::Paper] {
        let (name, bytes, packages, swarm) = small_log(codec, 12);
        let streams = packages.iter().map(|p| p.header().stream).collect::<std::collections::BTreeSet<_>>();
        assert!(streams.len() == 2 && packages.len() > 4, "{} packages", packages.len());
        // Where each record ends.
        let mut ends = vec![72];
        ends.extend(packages.iter().scan(72, |end, package| {
            *end += 9 + package.bytes().len();
            Some(*end)
        }));
        assert_eq!(ends.last(), Some(&bytes.len()), "a record is its package and 9 bytes");
        let contents = contents(&packages);
        let mut models = vec![Model::default()];
        for (package, content) in packages.iter().zip(&contents) {
            let mut next = models.last().unwrap().clone();
            next.add(package, content);
            models.push(next);
        }
        assert_eq!(models.last(), Some(&Model::of_robot(&swarm.robots[0])));

        println!("{codec:?}: {} packages, cut at each of {} bytes", packages.len(), bytes.len());
        for length in 0..=bytes.len() {
            let disk = MemoryDisk::of([(name.clone(), bytes[..length].to_vec())].into());
            let (robot, restored) = restart(&disk, config(1), 2);
            let whole = ends.iter().filter(|end| **end <= length).count().saturating_sub(1);
            assert_eq!((restored.packages, restored.merged), (whole as u64, whole as u64), "{length}");
            assert_eq!((restored.skipped_bytes, restored.damaged_segments), (0, 0), "{length}");
            let end = if length < 72 { 0 } else { ends[whole] };
            assert_eq!(restored.torn_bytes, (length - end) as u64, "{length}");
            assert_eq!(Model::of_robot(&robot), models[whole], "{length}");
            // What is torn is reported once.
            let again = restart(&disk, config(1), 2).1;
            assert_eq!((again.torn_bytes, again.packages), (0, restored.packages), "{length}");
        }
    }
}

#[test]
fn a_former_run_is_an_older_layer_in_the_map_and_what_was_lost_comes_back_from_others() {
    let disk = MemoryDisk::default();
    let mut swarm = Swarm::new(two(Codec::Flock), PERFECT, 5);
    let mut writer = start(&disk, OPTIONS, 1);
    let mut random = Random(5);
    fly(&mut swarm, &mut writer, 40, &mut random, swarm::scan);
    drop(writer);
    let (before, bytes) = (Model::of_robot(&swarm.robots[0]), swarm.bytes);
    let in_all = bytes;
    // The last 3,000 bytes were not safe.
    let files: BTreeMap<_, _> =
        disk.files().into_iter().map(|(name, f)| (name, f[..f.len() - 3_000].to_vec())).collect();
    let disk = MemoryDisk::of(files);
    let mut robot = Robot::new(RobotConfig { epoch: 2, ..two(Codec::Flock).remove(0) }, swarm.now).unwrap();
    let mut store = open(&disk, OPTIONS);
    assert_eq!(store.last_epoch(), Some(1));
    let restored = store.restore(&mut robot, swarm.now);
    assert!(restored.packages > 20 && restored.packages == restored.merged, "{restored:?}");
    let mut writer = Writer::new(store.start(2).unwrap());
    // The own former layer is in the fused map, as there is no newer observation.
    let own = Stream { origin: RobotId(1), epoch: 1 };
    let layer = robot.fusion().layer(own).unwrap();
    assert!(layer.len() > 1_000);
    let agreeing = layer.voxels().filter(|(voxel, state)| robot.map().state(*voxel) == *state).count();
    assert!(agreeing * 10 > layer.len() * 9, "{agreeing} of {}", layer.len());
    assert_eq!(robot.mapper().blocks().count(), 0);

    swarm.robots[0] = robot;
    swarm.settle(20_000);
    store_events(&mut swarm, &mut writer, &mut Vec::new());
    assert!(swarm.agrees());
    let after = Model::of_robot(&swarm.robots[0]);
    assert_eq!(after, before, "both former streams are whole again");
    let repair = swarm.bytes - bytes;
    println!("{in_all} B for the flight, {repair} B after the restart");
    assert!(repair < 3_200 + in_all / 20, "{repair} of {in_all} B");
    // And it goes on, and starts once more, with both runs.
    fly(&mut swarm, &mut writer, 10, &mut random, swarm::scan);
    drop(writer);
    swarm.assert_layers_equal_own_maps(5);
    let (robot, restored) = restart(&disk, config(1), 3);
    assert_eq!(Model::of_robot(&robot), Model::of_robot(&swarm.robots[0]));
    assert_eq!(restored.torn_bytes, 0);
    assert_eq!(robot.fusion().layers().count(), 3);
}

#[test]
fn a_package_of_this_run_or_a_later_one_is_not_taken_for_a_former_one() {
    let (_, _, packages, _) = small_log(Codec::Flock, 2);
    let package = packages.iter().find(|p| p.header().stream.origin == RobotId(1)).unwrap();
    let mut robot = Robot::new(config(1), Stamp(0)).unwrap();
    let error = robot.restore(Stamp(0), package.clone()).unwrap_err();
    assert!(matches!(error, RestoreError::NotFormer { .. }), "{error}");
    assert!(error.to_string().contains("higher epoch"));
    assert_eq!(robot.fusion().layers().count(), 0);
}

/// Name and bytes of a segment, and the packages in it with what they say.
type HonestLog = (String, Vec<u8>, Vec<Package>, Vec<Content>);

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, ..ProptestConfig::default() })]
    #[test]
    fn spoilt_bytes_never_make_a_voxel_wrong(
        spoilt in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
        cut_out in any::<(prop::sample::Index, u8)>(),
    ) {
        static LOG: OnceLock<HonestLog> = OnceLock::new();
        let (name, honest, packages, contents) = LOG.get_or_init(|| {
            let (name, bytes, packages, _) = small_log(Codec::Flock, 12);
            let contents = contents(&packages);
            (name, bytes, packages, contents)
        });
        let mut bytes = honest.clone();
        for (at, value) in &spoilt {
            bytes[at.index(honest.len())] = *value;
        }
        // Now and then a piece is missing altogether.
        if cut_out.1 % 4 == 0 {
            let at = cut_out.0.index(honest.len());
            bytes.drain(at..(at + usize::from(cut_out.1)).min(honest.len()));
        }
        let disk = MemoryDisk::of([(name.clone(), bytes)].into());
        let (robot, restored) = restart(&disk, config(1), 2);
        prop_assert!(restored.packages <= packages.len() as u64);
        // Each layer is what the packages say that are held, and no more.
        let mut model = Model::default();
        for (package, content) in packages.iter().zip(contents) {
            let received = robot.session().received(package.header().stream);
            if received.is_some_and(|received| received.contains(package.header().index)) {
                model.add(package, content);
            }
        }
        prop_assert_eq!(Model::of_robot(&robot), model);
    }
}

#[test]
fn behind_a_damaged_place_reading_goes_on() {
    let (name, mut bytes, packages, _) = small_log(Codec::Paper, 12);
    let second = 72 + 9 + packages[0].bytes().len();
    bytes[second + 20] ^= 4;
    let disk = MemoryDisk::of([(name.clone(), bytes.clone())].into());
    let (_, restored) = restart(&disk, config(1), 2);
    assert_eq!(restored.packages, packages.len() as u64 - 1);
    assert_eq!(restored.skipped_bytes, 9 + packages[1].bytes().len() as u64);
    assert_eq!(restored.torn_bytes, 0);
    // One of the two headers may be spoilt, not both.
    bytes[9] ^= 1;
    let disk = MemoryDisk::of([(name.clone(), bytes.clone())].into());
    assert_eq!(restart(&disk, config(1), 2).1, restored);
    bytes[44] ^= 1;
    let disk = MemoryDisk::of([(name, bytes)].into());
    let (_, restored) = restart(&disk, config(1), 2);
    assert_eq!((restored.packages, restored.damaged_segments), (0, 1));
    assert_eq!(open(&disk, OPTIONS).last_epoch(), Some(1), "the name still has the epoch");
}

#[test]
fn on_a_disk_that_fails_the_robot_flies_on_and_says_so_once() {
    let faults = [
        ("no storage space", Faults { room: Some(700), ..Faults::default() }),
        ("input/output error", Faults { sync: true, ..Faults::default() }),
        ("no storage space", Faults { room: Some(0), ..Faults::default() }),
    ];
    for (name, fault) in faults {
        let disk = MemoryDisk::default();
        let mut swarm = Swarm::new(two(Codec::Flock), PERFECT, 7);
        let mut writer = start(&disk, OPTIONS, 1);
        let mut random = Random(7);
        let mut stored = fly(&mut swarm, &mut writer, 5, &mut random, small_scan);
        disk.set_faults(fault);
        stored.extend(fly(&mut swarm, &mut writer, 20, &mut random, small_scan));
        let counters = writer.counters();
        assert_eq!(counters.failures, 1, "{name}");
        assert!(counters.left_out > 0 && counters.written > 0, "{name}: {counters:?}");
        let [Notice::Off(text)] = &writer.notices[..] else { panic!("{:?}", writer.notices) };
        assert!(text.contains("flies on in memory") && text.contains(name), "{text}");
        assert!(swarm.agrees());

        // What was written before is there, and nothing else.
        disk.set_faults(Faults::default());
        let (robot, restored) = restart(&disk, config(1), 2);
        assert!(restored.packages >= counters.written && restored.packages < stored.len() as u64);
        let mut model = Model::default();
        let contents = contents(&stored);
        for (package, content) in stored.iter().zip(&contents).take(restored.packages as usize) {
            model.add(package, content);
        }
        assert_eq!(Model::of_robot(&robot), model, "{name}");
    }
}

#[test]
fn a_disk_that_refuses_from_the_start_stops_no_robot() {
    let disk = MemoryDisk::default();
    disk.set_faults(Faults { create: true, ..Faults::default() });
    let writer = start(&disk, OPTIONS, 1);
    assert_eq!(writer.counters().failures, 1);
    assert!(writer.notices[0].to_string().contains("cannot begin a segment: permission denied"));
}

#[test]
fn what_cannot_be_read_is_left_out_and_not_cut_off() {
    let (name, bytes, packages, _) = small_log(Codec::Flock, 12);
    let disk = MemoryDisk::of([(name.clone(), bytes.clone())].into());
    disk.set_faults(Faults { readable: Some(bytes.len() / 2), ..Faults::default() });
    let (_, restored) = restart(&disk, config(1), 2);
    assert_eq!((restored.damaged_segments, restored.torn_bytes), (1, 0));
    assert!(restored.packages > 0 && restored.packages < packages.len() as u64);
    disk.set_faults(Faults::default());
    assert_eq!(restart(&disk, config(1), 2).1.packages, packages.len() as u64);
    assert_eq!(disk.files()[&name], bytes);
}

#[test]
fn a_snapshot_that_was_received_is_there_after_a_restart() {
    let lossy = Radio { loss: 0.2, duplication: 0.1, damage: 0.02, delay_ms: (5.0, 80.0) };
    for seed in 1..=3 {
        let mut configs = two(Codec::Flock);
        for config in &mut configs {
            config.session.snapshot_range_max = Some(5);
        }
        let mut swarm = Swarm::new(configs, lossy, seed);
        swarm.cut = vec![(0, 1)];
        let mut random = Random(seed);
        for tick in 0..40 {
            let scan = swarm::scan(&mut random, swarm.now);
            swarm.scan(1, &scan, &Pose::from_yaw([f64::from(tick) * 0.1, 0.0, 0.0], 0.0));
            swarm.run(100);
        }
        let disk = MemoryDisk::default();
        let mut writer = start(&disk, OPTIONS, 1);
        swarm.cut.clear();
        swarm.settle(60_000);
        assert!(swarm.events[0].iter().any(|event| matches!(event, Event::CaughtUp { .. })), "seed {seed}");
        fly(&mut swarm, &mut writer, 10, &mut random, swarm::scan);
        assert!(swarm.agrees(), "seed {seed}");
        drop(writer);
        let (robot, _) = restart(&disk, config(1), 2);
        assert_eq!(Model::of_robot(&robot), Model::of_robot(&swarm.robots[0]), "seed {seed}");
        let stream = swarm.robots[1].own_stream();
        assert_eq!(
            robot.session().received(stream),
            swarm.robots[0].session().received(stream),
            "seed {seed}"
        );
    }
}
