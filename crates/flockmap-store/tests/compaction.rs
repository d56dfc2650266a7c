//! How a log is made shorter: within its cap, whatever fails, and with nothing lost that the packages said.

mod common;

use common::swarm::{PERFECT, Radio, Random, Swarm, config};
use common::{
    Model, OPTIONS, Writer, contents, fly, open, restart, small_log, small_scan, start, store_events, swarm,
    two,
};
use flockmap::codec::{Content, ContentKind};
use flockmap::{Codec, Event, Package, Pose, Robot, RobotConfig, RobotId, State, Stream};
use flockmap_store::memory::{Faults, MemoryDisk};
use flockmap_store::{Notice, StoreOptions};

/// A cap that a flight of some seconds reaches.
const CAP: u64 = 256 << 10;

#[test]
fn compaction_keeps_every_layer_bit_for_bit_and_the_cap_is_held() {
    for codec in [Codec::Flock, Codec::Paper] {
        let disk = MemoryDisk::default();
        let options = StoreOptions { bytes_max: CAP, ..OPTIONS };
        let mut swarm = Swarm::new(two(codec), PERFECT, 11);
        let mut writer = start(&disk, options, 1);
        let mut random = Random(11);
        for round in 1..=400 {
            fly(&mut swarm, &mut writer, 10, &mut random, swarm::scan);
            for _ in 0..5 {
                writer.step(&swarm.robots[0]);
            }
            if writer.counters().compactions >= 3 {
                println!("{codec:?}: 3 compactions in {round} rounds, {:?}", writer.counters());
                break;
            }
        }
        let counters = writer.counters();
        println!("{codec:?}: {counters:?}");
        assert_eq!((counters.failures, counters.left_out, counters.compactions_failed), (0, 0, 0));
        assert!(counters.compactions >= 3, "{counters:?}");
        fly(&mut swarm, &mut writer, 5, &mut random, swarm::scan);
        drop(writer);
        let most = disk.bytes_most() as u64;
        assert!(most > CAP / 2 && most <= CAP, "{most} B at most");
        let (robot, restored) = restart(&disk, config(1), 2);
        assert_eq!((restored.skipped_bytes, restored.torn_bytes), (0, 0));
        for (stream, layer) in swarm.robots[0].fusion().layers() {
            let again = robot.fusion().layer(stream).unwrap();
            assert_eq!(again.digest(), layer.digest(), "{codec:?} {stream:?}");
            assert_eq!(robot.session().received(stream), swarm.robots[0].session().received(stream));
        }
    }
}

#[test]
fn compaction_keeps_what_is_held_beyond_a_gap() {
    // Packages that need no others, of which one is missing for good.
    let (_, _, packages, _) = small_log(Codec::Paper, 30);
    let of_two: Vec<&Package> =
        packages.iter().filter(|package| package.header().stream.origin == RobotId(2)).collect();
    assert!(of_two.len() > 5);
    // With all packages in memory, and with nearly none: then what they say is in the layer only.
    for (gap, store_bytes_max) in [(1, 64 << 20), (3, 64 << 20), (1, FEW), (3, FEW)] {
        let disk = MemoryDisk::default();
        // Many small segments make a compaction at once.
        for epoch in 1..=65 {
            drop(start(&disk, OPTIONS, epoch));
        }
        let mut swarm =
            Swarm::new(vec![RobotConfig { epoch: 66, ..with_room(1, store_bytes_max) }], PERFECT, 1);
        let now = swarm.now;
        for package in of_two.iter().filter(|package| package.header().index != gap) {
            swarm.robots[0].restore(now, (*package).clone()).unwrap();
        }
        let mut writer = start(&disk, OPTIONS, 66);
        writer.finish_compaction(&swarm.robots[0]);
        drop(writer);
        assert_eq!(disk.files().len(), 2, "one compacted and one that goes on");
        let (robot, _) = restart(&disk, config(1), 67);
        let stream = of_two[0].header().stream;
        assert_eq!(Model::of_robot(&robot), Model::of_robot(&swarm.robots[0]), "gap {gap}");
        let received = robot.session().received(stream).unwrap();
        assert_eq!(Some(received), swarm.robots[0].session().received(stream));
        assert!(!received.contains(gap) && received.contains(gap + 1));
    }
}

/// The least cap.
const LEAST: StoreOptions = StoreOptions { bytes_max: 64 << 10, ..OPTIONS };

/// Robot 1 flies until nothing more is stored, over ever the same few metres if `is_small`. Compactions go on
/// while it flies, or wait.
fn fly_until_full(disk: &MemoryDisk, is_small: bool, goes_on: bool) -> (Writer, Swarm) {
    let mut swarm = Swarm::new(vec![two(Codec::Paper).remove(0)], PERFECT, 41);
    let mut writer = start(disk, LEAST, 1);
    let mut random = Random(41);
    for tick in 0..40_000 {
        let scan = if is_small { small_scan } else { swarm::scan }(&mut random, swarm.now);
        let at = if is_small { f64::from(tick % 5) * 0.1 } else { f64::from(tick) * 0.3 };
        swarm.scan(0, &scan, &Pose::from_yaw([at, 0.0, 0.0], 0.0));
        swarm.robots[0].flush(swarm.now);
        swarm.run(20);
        for event in swarm.events[0].drain(..) {
            writer.note(&event);
        }
        if writer.counters().failures > 0 {
            return (writer, swarm);
        }
        if goes_on {
            writer.step(&swarm.robots[0]);
        }
    }
    panic!("never full: {:?}", writer.counters());
}

#[test]
fn there_is_never_more_on_the_disk_than_bytes_max_whether_compactions_wait_fail_or_end() {
    let most = |disk: &MemoryDisk| disk.bytes_most() as u64;
    // The log comes to its end while a compaction waits.
    let disk = MemoryDisk::default();
    let (mut writer, swarm) = fly_until_full(&disk, true, false);
    writer.finish_compaction(&swarm.robots[0]);
    let [Notice::Off(text)] = &writer.notices[..] else { panic!("{:?}", writer.notices) };
    assert!(text.contains("bytes_max (65536)") && text.contains("raise it"), "{text}");
    drop(writer);
    assert!(most(&disk) > LEAST.bytes_max / 2 && most(&disk) <= LEAST.bytes_max, "{} B", most(&disk));
    // It counts all the same.
    let (robot, _) = restart(&disk, config(1), 2);
    let own = swarm.robots[0].own_stream();
    assert_eq!(Model::of_robot(&robot).0[&own], Model::of_robot(&swarm.robots[0]).0[&own]);
    let writer = Writer::new(open(&disk, LEAST).start(2).unwrap());
    assert!(writer.notices.is_empty() && writer.counters().disk_bytes < LEAST.bytes_max / 2);

    // The map by itself takes too much: tried again and again, each time beside a longer log.
    let disk = MemoryDisk::default();
    let (writer, _) = fly_until_full(&disk, false, true);
    let counters = writer.counters();
    assert!(counters.compactions_failed > 1 && counters.failures == 1, "{counters:?}");
    assert!(
        writer.notices[0].to_string().contains("the map by itself takes more than"),
        "{:?}",
        writer.notices
    );
    assert!(most(&disk) <= LEAST.bytes_max, "{} B", most(&disk));

    // What is left of those that came to no end is not removed: it takes its room.
    let disk = MemoryDisk::default();
    let (writer, swarm) = fly_until_full(&disk, true, false);
    drop(writer);
    disk.set_faults(Faults { remove: true, ..Faults::default() });
    for epoch in 2..=12 {
        let mut writer = start(&disk, LEAST, epoch);
        if let Some(compaction) = &mut writer.compaction {
            while compaction.step(&swarm.robots[0]) {}
        }
    }
    assert!(disk.files().keys().filter(|name| name.ends_with(".unfinished")).count() > 1);
    assert!(most(&disk) <= LEAST.bytes_max, "{} B", most(&disk));
}

#[test]
fn a_log_that_has_come_to_its_end_is_made_shorter_at_the_next_start() {
    let disk = MemoryDisk::default();
    let (writer, swarm) = fly_until_full(&disk, true, false);
    drop(writer);
    // And a few starts come to nothing.
    for epoch in 2..=6 {
        drop(start(&disk, LEAST, epoch));
    }
    let mut robot = Robot::new(RobotConfig { epoch: 7, ..config(1) }, swarm.now).unwrap();
    let mut store = open(&disk, LEAST);
    store.restore(&mut robot, swarm.now);
    let mut writer = Writer::new(store.start(7).unwrap());
    writer.finish_compaction(&robot);
    let counters = writer.counters();
    assert_eq!((counters.compactions, counters.failures), (1, 0), "{:?}", writer.notices);
    assert!(counters.disk_bytes < LEAST.bytes_max / 2, "{counters:?}");
    assert!(disk.bytes_most() as u64 <= LEAST.bytes_max, "{} B", disk.bytes_most());
    drop(writer);
    let (again, _) = restart(&disk, config(1), 8);
    assert_eq!(Model::of_robot(&again), Model::of_robot(&robot));
}

/// Bytes of packages in memory: some three of them.
const FEW: usize = 2_000;

fn with_room(id: u16, store_bytes_max: usize) -> RobotConfig {
    let mut config = RobotConfig { codec: Codec::Paper, ..config(id) };
    config.session.store_bytes_max = store_bytes_max;
    config
}

/// Packages of a run of robot 2 that has ended, each of which stands by itself.
fn ended_run() -> (Stream, Vec<Package>) {
    let (_, _, packages, _) = small_log(Codec::Paper, 30);
    let stream = Stream { origin: RobotId(2), epoch: 1 };
    (stream, packages.into_iter().filter(|package| package.header().stream == stream).collect())
}

/// Only robot 3 has some packages of an ended run, most of them in its layer only, and sends them to robot 1.
/// Returns the disk of that one, and what is on it.
fn publish_beyond_a_gap(stream: Stream, packages: &[Package], gap: u32) -> (MemoryDisk, Swarm, Vec<Package>) {
    let disk = MemoryDisk::default();
    let mut writer = start(&disk, OPTIONS, 1);
    let mut swarm = Swarm::new(vec![with_room(1, FEW), with_room(3, FEW)], PERFECT, 1);
    let now = swarm.now;
    for package in packages.iter().filter(|package| package.header().index != gap) {
        swarm.robots[1].restore(now, package.clone()).unwrap();
    }
    swarm.run(60_000);
    assert_eq!(swarm.robots[0].session().received(stream), swarm.robots[1].session().received(stream));
    assert!(swarm.events[0].iter().any(|event| matches!(event, Event::SnapshotContains { .. })));
    let mut stored = Vec::new();
    store_events(&mut swarm, &mut writer, &mut stored);
    (disk, swarm, stored)
}

#[test]
fn what_a_snapshot_with_gaps_contains_is_held_fused_and_told_after_restarts_and_compactions() {
    let (stream, packages) = ended_run();
    for gap in [1, 3] {
        let (disk, swarm, _) = publish_beyond_a_gap(stream, &packages, gap);
        let (received, model) =
            (swarm.robots[1].session().received(stream).unwrap(), Model::of_robot(&swarm.robots[1]));
        let is_all_there = |robot: &Robot, when: &str| {
            assert_eq!(robot.session().received(stream), Some(received), "gap {gap}, {when}");
            assert_eq!(Model::of_robot(robot), model, "gap {gap}, {when}");
            for (voxel, (_, is_occupied)) in &model.0[&stream] {
                assert_eq!(robot.map().state(*voxel) == State::Occupied, *is_occupied, "gap {gap}, {when}");
            }
        };
        let (mut robot, _) = restart(&disk, with_room(1, FEW), 2);
        is_all_there(&robot, "after a restart");
        for epoch in [2, 2_000] {
            let mut writer = start(&disk, OPTIONS, epoch);
            compact_now(&mut writer, &robot);
            assert_eq!(writer.counters().compactions, 1);
            drop(writer);
            robot = restart(&disk, with_room(1, FEW), 3_000 + epoch).0;
            is_all_there(&robot, "after a compaction and a restart");
        }
        // The one that sent it is gone for good. A newcomer has it from the disk.
        let mut swarm = Swarm::new(vec![with_room(1, FEW), with_room(4, FEW)], PERFECT, 2);
        robot = Robot::new(RobotConfig { epoch: 9_000, ..with_room(1, FEW) }, swarm.now).unwrap();
        open(&disk, OPTIONS).restore(&mut robot, swarm.now);
        swarm.robots[0] = robot;
        swarm.run(60_000);
        is_all_there(&swarm.robots[1], "at a newcomer");
    }
}

#[test]
fn what_a_snapshot_contains_counts_only_with_all_its_chunks() {
    let (stream, packages) = ended_run();
    let (disk, swarm, stored) = publish_beyond_a_gap(stream, &packages, 1);
    let (name, bytes) = disk.files().pop_first().unwrap();
    let live = Model::of_robot(&swarm.robots[0]);
    let received = |robot: &Robot, index| {
        robot.session().received(stream).is_some_and(|received| received.contains(index))
    };
    let is_chunk = |package: &Package| package.header().content != ContentKind::Changes;
    let records = stored.iter().scan(72, |end, package| {
        *end += 9 + package.bytes().len();
        Some((package, *end))
    });
    let chunks: Vec<usize> =
        records.filter(|(package, _)| is_chunk(package)).map(|(_, end)| end - 20).collect();
    assert!(chunks.len() > 1);
    // A chunk, and the record of what they contain, which is the last one.
    for at in [chunks[0], chunks[chunks.len() - 1], bytes.len() - 1] {
        let mut spoilt = bytes.clone();
        spoilt[at] ^= 1;
        let disk = MemoryDisk::of([(name.clone(), spoilt)].into());
        let (robot, restored) = restart(&disk, with_room(1, FEW), 2);
        assert!(restored.skipped_bytes + restored.torn_bytes > 0);
        for package in &packages {
            let index = package.header().index;
            let came = stored.iter().any(|p| !is_chunk(p) && p.header().index == index);
            assert_eq!(received(&robot, index), came, "byte {at}: package {index}");
        }
        for (voxel, word) in Model::of_robot(&robot).0.remove(&stream).unwrap_or_default() {
            assert_eq!(live.0[&stream][&voxel], word, "byte {at}");
        }
    }
}

/// The log is made shorter now, since it has so many segments.
fn compact_now(writer: &mut Writer, robot: &Robot) {
    for epoch in (1_000..).skip_while(|epoch| *epoch <= robot.own_stream().epoch).take(100) {
        writer.log.note_epoch(epoch);
    }
    writer.compaction = writer.log.begin_compaction();
    writer.finish_compaction(robot);
}

/// Robot 1 flies, and its own layer has no room for all that it publishes; then the log is made shorter.
/// Returns the own packages.
fn fly_with_a_full_own_layer(disk: &MemoryDisk, store_bytes_max: usize) -> (Vec<Package>, Writer) {
    let mut config = two(Codec::Flock).remove(0);
    config.fusion.own_layer_bytes_max = 60_000;
    config.session.store_bytes_max = store_bytes_max;
    let mut swarm = Swarm::new(vec![config], PERFECT, 31);
    let mut writer = start(disk, OPTIONS, 1);
    let mut packages = Vec::new();
    let mut random = Random(31);
    for tick in 0..40 {
        let scan = swarm::scan(&mut random, swarm.now);
        swarm.scan(0, &scan, &Pose::from_yaw([f64::from(tick) * 0.1, 0.0, 0.0], random.unit()));
        swarm.run(100);
        for event in swarm.events[0].drain(..) {
            if let Event::BatchClosed { packages: published, .. } = &event {
                packages.extend_from_slice(published);
            }
            writer.log.note(swarm.now, &event);
        }
    }
    assert!(
        swarm.robots[0].counters().blocks_dropped > 0
            && swarm.robots[0].fusion().is_in_part(swarm.robots[0].own_stream())
    );
    compact_now(&mut writer, &swarm.robots[0]);
    (packages, writer)
}

/// The own run is back as its packages said it.
fn assert_all_is_back(disk: &MemoryDisk, packages: &[Package]) {
    let stream = packages[0].header().stream;
    let (robot, _) = restart(disk, config(1), 2_000);
    let mut model = Model::default();
    for (package, content) in packages.iter().zip(&contents(packages)) {
        model.add(package, content);
    }
    assert!(robot.session().received(stream).unwrap().contains_range(1, packages.len() as u32));
    assert_eq!(Model::of_robot(&robot), model);
}

#[test]
fn an_own_layer_that_lacks_what_was_told_does_not_replace_the_packages_that_told_it() {
    let disk = MemoryDisk::default();
    let (packages, writer) = fly_with_a_full_own_layer(&disk, 64 << 20);
    assert_eq!(writer.counters().compactions, 1);
    drop(writer);
    assert_eq!(disk.files().len(), 2, "one compacted and one that goes on");
    assert_all_is_back(&disk, &packages);
}

#[test]
fn where_neither_the_own_layer_nor_the_packages_in_memory_say_all_the_log_says_what_is_lacking() {
    let disk = MemoryDisk::default();
    let (packages, writer) = fly_with_a_full_own_layer(&disk, 8_000);
    let counters = writer.counters();
    assert_eq!((counters.compactions, counters.compactions_failed, counters.failures), (1, 0, 0));
    drop(writer);
    let stream = packages[0].header().stream;
    let (robot, _) = restart(&disk, config(1), 2_000);
    assert!(robot.session().received(stream).unwrap().contains_range(1, packages.len() as u32));
    // What is known is the newest that was published, and the rest is known to be lacking.
    let mut published = flockmap::grid::Layer::default();
    for (package, content) in packages.iter().zip(&contents(&packages)) {
        let Content::Changes(changes) = content else { panic!("own packages hold changes") };
        published.apply(changes, package.header().batch_end);
    }
    let layer = robot.fusion().layer(stream).unwrap();
    assert!(layer.voxels().all(|(voxel, _)| layer.get(voxel) == published.get(voxel)));
    assert!(!layer.is_empty() && layer.len() < published.len());
    assert!(layer.lost_upto().is_some() && robot.session().lost_upto(stream) == layer.lost_upto());
}

#[test]
fn a_crash_between_a_compaction_and_its_clean_up_does_no_harm() {
    let disk = MemoryDisk::default();
    let options = StoreOptions { bytes_max: CAP, ..OPTIONS };
    let mut swarm = Swarm::new(two(Codec::Flock), PERFECT, 13);
    let mut writer = start(&disk, options, 1);
    let mut random = Random(13);
    while disk.files().len() < 2 {
        fly(&mut swarm, &mut writer, 10, &mut random, swarm::scan);
    }
    disk.set_faults(Faults { remove: true, ..Faults::default() });
    writer.finish_compaction(&swarm.robots[0]);
    assert_eq!(writer.counters().failures, 1);
    drop(writer);
    assert_eq!(disk.files().len(), 3);
    disk.set_faults(Faults::default());
    disk.put("00000009-00000000000000000001.log.unfinished", vec![1, 2, 3]);
    let (robot, _) = restart(&disk, config(1), 2);
    assert_eq!(disk.files().len(), 2, "what is replaced goes, and what is unfinished");
    assert_eq!(Model::of_robot(&robot), Model::of_robot(&swarm.robots[0]));
}

#[test]
fn a_compaction_amid_losses_restores_no_wrong_voxel_and_heals() {
    let lossy = Radio { loss: 0.3, duplication: 0.1, damage: 0.02, delay_ms: (5.0, 150.0) };
    for seed in 1..=4 {
        let disk = MemoryDisk::default();
        // Many small segments make a compaction at once.
        for epoch in 1..=65 {
            drop(start(&disk, OPTIONS, epoch));
        }
        let mut configs = two(Codec::Flock);
        configs[0].epoch = 66;
        let mut swarm = Swarm::new(configs, lossy, seed);
        let mut random = Random(seed);
        let mut writer = None;
        for tick in 0..60 {
            for robot in 0..2 {
                let scan = swarm::scan(&mut random, swarm.now);
                swarm.scan(robot, &scan, &Pose::from_yaw([f64::from(tick) * 0.1, robot as f64, 0.0], 0.0));
            }
            swarm.run(100);
            if tick == 30 {
                // All so far is in the layers, and nowhere else.
                swarm.events[0].clear();
                let mut begun = start(&disk, OPTIONS, 66);
                begun.finish_compaction(&swarm.robots[0]);
                writer = Some(begun);
            }
            if let Some(writer) = &mut writer {
                store_events(&mut swarm, writer, &mut Vec::new());
            }
        }
        drop(writer);
        // What is restored stands as it stood, or is not there yet: no observation is newer or another.
        let (robot, _) = restart(&disk, config(1), 67);
        let live = Model::of_robot(&swarm.robots[0]);
        for (stream, layer) in Model::of_robot(&robot).0 {
            for (voxel, word) in layer {
                let known = live.0[&stream][&voxel];
                assert!(word == known || word.0 < known.0, "seed {seed}: {stream:?} {voxel:?}");
            }
        }
        let own = RobotConfig { epoch: 67, ..two(Codec::Flock).remove(0) };
        let mut robot = Robot::new(own, swarm.now).unwrap();
        open(&disk, OPTIONS).restore(&mut robot, swarm.now);
        swarm.robots[0] = robot;
        swarm.settle(60_000);
        assert!(swarm.agrees(), "seed {seed}");
        swarm.assert_layers_equal_own_maps(seed);
    }
}

#[test]
fn a_robot_that_begins_anew_again_and_again_leaves_few_segments_and_keeps_all() {
    let disk = MemoryDisk::default();
    let options = StoreOptions { bytes_max: CAP, ..OPTIONS };
    let mut swarm = Swarm::new(two(Codec::Flock), PERFECT, 17);
    let mut writer = start(&disk, options, 1);
    fly(&mut swarm, &mut writer, 5, &mut Random(17), small_scan);
    for epoch in 2..=1_000 {
        writer.log.note_epoch(epoch);
        // Not higher: nothing happens.
        writer.log.note_epoch(epoch - 1);
        writer.compaction = writer.compaction.take().or_else(|| writer.log.begin_compaction());
        writer.step(&swarm.robots[0]);
    }
    assert_eq!(writer.notices, []);
    let counters = writer.counters();
    assert!(counters.compactions > 5 && counters.failures == 0, "{counters:?}");
    assert!(disk.files().len() <= 80, "{} segments", disk.files().len());
    assert_eq!(open(&disk, options).last_epoch(), Some(1_000));
    drop(writer);
    let (robot, _) = restart(&disk, config(1), 1_001);
    assert_eq!(Model::of_robot(&robot), Model::of_robot(&swarm.robots[0]));
}
