//! The threads that keep what is on disk: what they are given is there, a failure is reported once, and the
//! robot begins anew under them.

mod common;

use std::sync::{Arc, Mutex};

use common::{config, corridor, wait_until};
use flockmap::{Event, Robot, RobotConfig, RobotId, Stamp};
use flockmap_node::store::memory::{Faults, MemoryDisk};
use flockmap_node::store::{EpochFile, Identity, Store, StoreOptions};
use flockmap_node::{Level, Log, StoreWriter};

/// Lines that were said.
type Lines = Arc<Mutex<Vec<(Level, String)>>>;

fn collected() -> (Log, Lines) {
    let lines = Arc::new(Mutex::new(Vec::new()));
    let to = Arc::clone(&lines);
    (Log::new(move |level, text| to.lock().unwrap().push((level, text.to_owned()))), lines)
}

fn robot(epoch: u64) -> Robot {
    Robot::new(RobotConfig { epoch, ..config(1) }, Stamp(0)).unwrap()
}

fn open(disk: &MemoryDisk) -> Store {
    open_with(disk, StoreOptions::default())
}

fn open_with(disk: &MemoryDisk, options: StoreOptions) -> Store {
    let identity = Identity { swarm: 0, robot: RobotId(1), resolution: config(1).mapper.resolution };
    Store::open(Arc::new(disk.clone()), identity, options).unwrap()
}

/// The robot sees so much of a corridor; its batches are noted. Returns how many packages that were.
fn see(robot: &mut Robot, writer: &StoreWriter, scans: usize) -> u64 {
    let mut packages = 0;
    for frame in corridor(1, scans) {
        robot.insert_scan(frame.scan.stamp, &frame.scan, &frame.t_map_sensor).unwrap();
        robot.flush(frame.scan.stamp);
        while let Some(event) = robot.poll_event() {
            if let Event::BatchClosed { packages: published, .. } = &event {
                packages += published.len() as u64;
            }
            writer.note(&event);
        }
    }
    packages
}

#[test]
fn what_is_noted_is_on_disk_and_is_made_shorter_beside_it() {
    let disk = MemoryDisk::default();
    for epoch in 1..=65 {
        drop(open(&disk).start(epoch).unwrap());
    }
    let (log, lines) = collected();
    let mut robot = robot(66);
    let writer = StoreWriter::start(Some(open(&disk).start(66).unwrap()), None, log);
    let packages = see(&mut robot, &writer, 10);
    writer.flush();
    assert_eq!((writer.counters().written, writer.counters().left_out), (packages, 0));
    wait_until("the log is one segment and that which goes on", || {
        writer.step(&robot);
        writer.counters().compactions == 1
    });
    let more = see(&mut robot, &writer, 3);
    drop(writer);
    assert_eq!(disk.files().len(), 2);
    assert_eq!(*lines.lock().unwrap(), []);

    let mut again = self::robot(67);
    open(&disk).restore(&mut again, Stamp(9_000_000));
    let own = robot.own_stream();
    let digest = |robot: &Robot| robot.fusion().layer(own).unwrap().digest();
    assert_eq!(digest(&again), digest(&robot));
    assert_eq!(again.session().received(own).unwrap().count(), packages + more);
}

#[test]
fn a_disk_that_fails_is_told_once_and_the_robot_does_not_notice() {
    for fault in
        [Faults { room: Some(500), ..Faults::default() }, Faults { calls: 0..u64::MAX, ..Faults::default() }]
    {
        let disk = MemoryDisk::default();
        disk.set_faults(fault.clone());
        let (log, lines) = collected();
        let store = open(&disk);
        let mut robot = robot(1);
        let writer = StoreWriter::start(Some(store.start(1).unwrap()), None, log);
        let packages = see(&mut robot, &writer, 10);
        writer.flush();
        let counters = writer.counters();
        assert_eq!((counters.failures, counters.written + counters.left_out), (1, packages), "{fault:?}");
        assert!(counters.left_out > 0, "{fault:?}");
        drop(writer);
        let lines = lines.lock().unwrap();
        assert_eq!(lines.len(), 1, "{lines:?}");
        assert!(lines[0].0 == Level::Error && lines[0].1.contains("flies on in memory"), "{lines:?}");
    }
}

#[test]
fn after_a_log_that_could_not_be_made_shorter_it_is_tried_again() {
    let disk = MemoryDisk::default();
    let options = StoreOptions { bytes_max: 64 << 10, ..StoreOptions::default() };
    let (log, lines) = collected();
    let mut robot = robot(1);
    let writer = StoreWriter::start(Some(open_with(&disk, options).start(1).unwrap()), None, log);
    let mut failed = 0;
    // The map soon takes more than a compacted segment may.
    for frame in corridor(1, 2_000) {
        robot.insert_scan(frame.scan.stamp, &frame.scan, &frame.t_map_sensor).unwrap();
        robot.flush(frame.scan.stamp);
        while let Some(event) = robot.poll_event() {
            writer.note(&event);
        }
        writer.flush();
        let is_unfinished = || disk.files().keys().any(|name| name.ends_with(".unfinished"));
        if is_unfinished() {
            wait_until("the compaction has ended", || {
                writer.step(&robot);
                writer.flush();
                !is_unfinished()
            });
        }
        // It may also have begun and ended unseen.
        failed = writer.counters().compactions_failed;
        if failed == 2 {
            break;
        }
    }
    assert_eq!((failed, writer.counters().failures), (2, 0), "{:?}", lines.lock().unwrap());
}

#[test]
fn a_robot_that_begins_anew_has_both_runs_and_its_epoch_on_disk() {
    let (disk, state) = (MemoryDisk::default(), MemoryDisk::default());
    let epochs = || EpochFile::open(Arc::new(state.clone()), 0, RobotId(1)).0;
    // A team-mate that took this id has a newer run of it.
    let other = robot(9 << 32).poll_transmit(Stamp(0)).unwrap().bytes;
    for has_store in [true, false] {
        let store = has_store.then(|| open(&disk).start(7 << 32).unwrap());
        let mut writer = StoreWriter::start(store, Some(epochs()), Log::silent());
        let mut robot = robot(7 << 32);
        // More batches, each with a stamp of its own, than there is room for events.
        let before = see(&mut robot, &writer, 1_300);
        let first = robot.own_stream();
        let now = Stamp(200_000_000);
        // It is refused, but heard.
        robot.handle_datagram(now, &other).unwrap_err();
        let second = robot.own_stream();
        // What was published goes out again in slices, and nobody takes the events.
        while robot.is_republishing() {
            robot.handle_timeout(now);
        }
        assert!(second > first && robot.counters().events_dropped > 0, "{:?}", robot.counters());
        writer.note_run(&robot);
        while let Some(event) = robot.poll_event() {
            writer.note(&event);
        }
        writer.flush();
        assert_eq!(epochs().last(), Some(second.epoch));
        let after = robot.counters().packages - before;
        assert_eq!(writer.counters().written, if has_store { before + after } else { 0 });
        if has_store {
            let mut again = self::robot(10 << 40);
            drop(writer);
            let mut store = open(&disk);
            assert_eq!(store.last_epoch(), Some(second.epoch));
            store.restore(&mut again, Stamp(300_000_000));
            for (run, packages) in [(first, before), (second, after)] {
                let received = again.session().received(run).map_or(0, flockmap::sync::IntervalSet::count);
                assert_eq!(received, packages, "{run:?}");
            }
        }
    }
}

#[test]
fn an_epoch_that_cannot_be_kept_is_told() {
    let disk = MemoryDisk::default();
    let (file, _) = EpochFile::open(Arc::new(disk.clone()), 0, RobotId(1));
    disk.set_faults(Faults { sync: true, ..Faults::default() });
    let (log, lines) = collected();
    let mut writer = StoreWriter::start(None, Some(file), log);
    writer.note_run(&robot(5));
    drop(writer);
    let lines = lines.lock().unwrap();
    assert!(lines.len() == 1 && lines[0].1.contains("cannot write epoch-0-1"), "{lines:?}");
}
