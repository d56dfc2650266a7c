//! The threads that keep what is on disk: what they are given is there, a failure is told once, and the robot begins anew under them.

mod common;

use std::sync::{Arc, Mutex};

use common::{config, corridor, wait_until};
use flockmap::{Event, Robot, RobotConfig, RobotId, Stamp, Stream};
use flockmap_node::store::memory::{Faults, MemoryDisk};
use flockmap_node::store::{EpochFile, Identity, Store, StoreOptions};
use flockmap_node::{Level, Log, StoreWriter};

/// Lines that were said.
type Lines = Arc<Mutex<Vec<(Level, String)>>>;

fn told() -> (Log, Lines) {
    let lines = Arc::new(Mutex::new(Vec::new()));
    let to = Arc::clone(&lines);
    (Log::new(move |level, text| to.lock().unwrap().push((level, text.to_owned()))), lines)
}

fn robot(epoch: u64) -> Robot {
    Robot::new(RobotConfig { epoch, ..config(1) }, Stamp(0)).unwrap()
}

fn open(disk: &MemoryDisk) -> Store {
    let identity = Identity { swarm: 0, robot: RobotId(1), resolution: config(1).mapper.resolution };
    Store::open(Arc::new(disk.clone()), identity, StoreOptions::default()).unwrap()
}

/// The robot sees so much of a corridor; its cycles are noted. Returns how many packages that were.
fn see(robot: &mut Robot, writer: &StoreWriter, scans: usize) -> u64 {
    let mut packages = 0;
    for frame in corridor(1, scans) {
        robot.insert_scan(frame.scan.stamp, &frame.scan, &frame.t_map_sensor).unwrap();
        robot.flush(frame.scan.stamp);
        while let Some(event) = robot.poll_event() {
            if let Event::CycleClosed { packages: told, .. } = &event {
                packages += told.len() as u64;
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
    let (log, lines) = told();
    let mut robot = robot(66);
    let mut writer = StoreWriter::start(Some(open(&disk).start(66).unwrap()), None, log);
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
    assert_eq!(again.session().held(own).unwrap().count(), packages + more);
}

#[test]
fn a_disk_that_fails_is_told_once_and_the_robot_does_not_notice() {
    for fault in
        [Faults { room: Some(500), ..Faults::default() }, Faults { calls: 0..u64::MAX, ..Faults::default() }]
    {
        let disk = MemoryDisk::default();
        disk.set_faults(fault.clone());
        let (log, lines) = told();
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
fn a_robot_that_begins_anew_has_both_runs_and_its_epoch_on_disk() {
    let (disk, state) = (MemoryDisk::default(), MemoryDisk::default());
    let epochs = || EpochFile::open(Arc::new(state.clone()), 0, RobotId(1)).0;
    let (first, second) = (7 << 32, 9 << 32 | 5);
    for has_store in [true, false] {
        let store = has_store.then(|| open(&disk).start(first).unwrap());
        let writer = StoreWriter::start(store, Some(epochs()), Log::silent());
        let packages = see(&mut robot(first), &writer, 3);
        writer.note_epoch(second);
        see(&mut robot(second), &writer, 3);
        writer.flush();
        assert_eq!(epochs().last(), Some(second));
        assert_eq!(writer.counters().written, if has_store { 2 * packages } else { 0 });
        drop(writer);
    }
    assert_eq!(open(&disk).last_epoch(), Some(second));
    let mut again = robot(10 << 32);
    open(&disk).restore(&mut again, Stamp(9_000_000));
    let held = |epoch| again.session().held(Stream { origin: RobotId(1), epoch }).map(|held| held.count());
    assert!(held(first).is_some_and(|count| count > 0));
    assert_eq!(held(first), held(second));
}

#[test]
fn an_epoch_that_cannot_be_kept_is_told() {
    let disk = MemoryDisk::default();
    let (file, _) = EpochFile::open(Arc::new(disk.clone()), 0, RobotId(1));
    disk.set_faults(Faults { sync: true, ..Faults::default() });
    let (log, lines) = told();
    let writer = StoreWriter::start(None, Some(file), log);
    writer.note_epoch(5);
    drop(writer);
    let lines = lines.lock().unwrap();
    assert!(lines.len() == 1 && lines[0].1.contains("cannot write epoch-0-1"), "{lines:?}");
}
