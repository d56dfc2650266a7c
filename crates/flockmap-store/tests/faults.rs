//! A disk of which any call fails, once or from then on, also with the power cut behind it: no start is
//! refused, no voxel is wrong, and nothing is lost that was safe.

mod common;

use common::swarm::{PERFECT, Random, Swarm, config};
use common::{Model, OPTIONS, Writer, contents, fly, identity, open, restart, small_scan, start, two};
use flockmap::{Codec, Event, Package, Pose, Robot, RobotConfig, RobotId, Stamp, Stream};
use flockmap_store::memory::{Faults, MemoryDisk, PowerCut};
use flockmap_store::{Notice, Store};
use std::time::Duration;

/// So many runs leave so many segments that the next one makes them one.
const RUNS_BEFORE: u64 = 66;

/// What a former run of robot 1 left: the packages of two robots in a segment with a torn end, an unfinished
/// segment, and the empty segments of many runs.
fn before() -> (MemoryDisk, Vec<Package>) {
    let disk = MemoryDisk::default();
    let mut swarm = Swarm::new(two(Codec::Paper), PERFECT, 21);
    let mut writer = start(&disk, OPTIONS, 1);
    let packages = fly(&mut swarm, &mut writer, 6, &mut Random(21), small_scan);
    drop(writer);
    for epoch in 2..=RUNS_BEFORE {
        drop(start(&disk, OPTIONS, epoch));
    }
    let (name, mut bytes) = disk.files().pop_first().unwrap();
    bytes.extend_from_slice(&[0xf1, 0x0c, 1]);
    disk.put(&name, bytes);
    disk.put("00000099-00000000000000000001.log.unfinished", vec![1, 2, 3]);
    (disk, packages)
}

/// A run on a disk that may fail: it restores, sees something, hears that its epoch is used and begins anew,
/// sees more, and makes its log shorter.
struct Run {
    /// All packages that there are.
    packages: Vec<Package>,
    /// The first so many are safe.
    safe: usize,
    writer: Writer,
}

const EPOCHS: [u64; 2] = [100, 200];

fn run(disk: &MemoryDisk, before: &[Package]) -> Run {
    let mut store = Store::open(std::sync::Arc::new(disk.clone()), identity(), OPTIONS).unwrap();
    let robot =
        |epoch: u64| Robot::new(RobotConfig { epoch, ..two(Codec::Paper).remove(0) }, Stamp(0)).unwrap();
    let mut first = robot(EPOCHS[0]);
    store.restore(&mut first, Stamp(1_000));
    let writer = Writer::new(store.start(EPOCHS[0]).unwrap());
    let mut run = Run { packages: before.to_vec(), safe: before.len(), writer };
    run.see(&mut first, 1);
    // What the first one has comes with it.
    let mut second = robot(EPOCHS[1]);
    for package in &run.packages {
        let stream = package.header().stream;
        if first.session().received(stream).is_some_and(|received| received.contains(package.header().index))
        {
            second.restore(Stamp(1_000), package.clone()).unwrap();
        }
    }
    while second.poll_event().is_some() {}
    run.writer.log.note_epoch(EPOCHS[1]);
    run.see(&mut second, 2);
    while run.writer.compaction.is_some() {
        run.writer.step(&second);
    }
    run.see(&mut second, 3);
    run
}

impl Run {
    fn see(&mut self, robot: &mut Robot, round: i64) {
        let stamp = Stamp(2_000_000 + round * 100_000);
        robot
            .insert_scan(stamp, &small_scan(&mut Random(round.unsigned_abs()), stamp), &Pose::IDENTITY)
            .unwrap();
        robot.flush(stamp);
        while let Some(event) = robot.poll_event() {
            if let Event::BatchClosed { packages, .. } = &event {
                self.packages.extend_from_slice(packages);
            }
            self.writer.note(&event);
            if self.writer.counters().failures == 0 {
                self.safe = self.packages.len();
            }
        }
    }
}

/// Starts once more, on a disk that works.
fn check(disk: &MemoryDisk, run: &Run, what: &str) {
    let offs = run.writer.notices.iter().filter(|notice| matches!(notice, Notice::Off(_))).count();
    assert_eq!(run.writer.counters().failures, offs as u64, "{what}: {:?}", run.writer.notices);
    assert!(offs <= 1, "{what}: {:?}", run.writer.notices);
    let mut store = open(disk, OPTIONS);
    let last = store.last_epoch().unwrap();
    if offs == 0 {
        assert_eq!(last, EPOCHS[1], "{what}");
    }
    let mut robot = Robot::new(RobotConfig { epoch: 300, ..config(1) }, Stamp(0)).unwrap();
    let restored = store.restore(&mut robot, Stamp(500_000_000));
    assert_eq!((restored.damaged_segments, restored.skipped_bytes), (0, 0), "{what}");
    let is_received = |package: &Package| {
        let header = package.header();
        robot.session().received(header.stream).is_some_and(|received| received.contains(header.index))
    };
    for package in &run.packages[..run.safe] {
        assert!(is_received(package), "{what}: {package:?} was safe; {:?}", run.writer.notices);
    }
    let mut model = Model::default();
    for (package, content) in run.packages.iter().zip(contents(&run.packages)) {
        if is_received(package) {
            model.add(package, &content);
        }
    }
    assert_eq!(Model::of_robot(&robot), model, "{what}");
}

/// Runs on a copy of the disk with these calls failing. Returns whether there was one of them.
fn fails(files: &MemoryDisk, before: &[Package], calls: std::ops::Range<u64>, cut: Option<PowerCut>) -> bool {
    let disk = MemoryDisk::of(files.files());
    disk.set_faults(Faults { calls: calls.clone(), ..Faults::default() });
    let run = run(&disk, before);
    let is_hit = disk.calls() > calls.start;
    disk.set_faults(Faults::default());
    if let Some(cut) = cut {
        disk.cut_power(cut);
    }
    check(&disk, &run, &format!("calls {calls:?}, {cut:?}"));
    is_hit
}

#[test]
fn a_run_on_a_sound_disk_begins_anew_and_keeps_both_of_its_parts() {
    let (disk, before) = before();
    let run = run(&disk, &before);
    check(&disk, &run, "no fault");
    assert_eq!(run.writer.notices, []);
    let counters = run.writer.counters();
    assert_eq!((counters.compactions, counters.left_out), (1, 0), "{counters:?}");
    assert_eq!(run.safe, run.packages.len());
    let mut robot = Robot::new(RobotConfig { epoch: 300, ..config(1) }, Stamp(0)).unwrap();
    open(&disk, OPTIONS).restore(&mut robot, Stamp(500_000_000));
    for epoch in EPOCHS {
        let stream = Stream { origin: RobotId(1), epoch };
        assert!(
            robot.session().received(stream).is_some_and(|received| !received.is_empty()),
            "{stream:?} is a former run"
        );
    }
    println!("{} calls", disk.calls());
}

#[test]
fn whichever_call_fails_the_robot_flies_and_nothing_safe_is_lost() {
    let (disk, before) = before();
    let mut call = 0;
    while fails(&disk, &before, call..call + 1, None) {
        call += 1;
    }
    println!("each of {call} calls has failed");
    assert!(call > 100);
}

#[test]
fn a_disk_that_dies_at_any_call_costs_nothing_that_was_safe() {
    let (disk, before) = before();
    let cuts = [
        None,
        Some(PowerCut { bytes_kept: 0, names_kept: false }),
        Some(PowerCut { bytes_kept: 5, names_kept: true }),
    ];
    let mut call = 0;
    while cuts.map(|cut| fails(&disk, &before, call..u64::MAX, cut)).contains(&true) {
        call += 1;
    }
    println!("the disk has died at each of {call} calls");
    assert!(call > 100);
}

/// After a former run that left `files`, the disk is full for a while; then one call more fails. Returns whether there
/// was such a call.
fn goes_on(files: &MemoryDisk, is_full_at_start: bool, call: Option<u64>) -> bool {
    let disk = MemoryDisk::of(files.files());
    let mut swarm = Swarm::new(two(Codec::Paper), PERFECT, 23);
    let mut random = Random(23);
    let full = || disk.set_faults(Faults { room: Some(300), ..Faults::default() });
    if is_full_at_start {
        full();
    }
    let mut writer = start(&disk, OPTIONS, 1_000);
    fly(&mut swarm, &mut writer, 2, &mut random, small_scan);
    full();
    fly(&mut swarm, &mut writer, 4, &mut random, small_scan);
    let counters = writer.counters();
    assert!(counters.is_off && counters.failures == 1 && counters.left_out > 0, "{counters:?}");
    // Still full: nothing new is said.
    writer.pass(Duration::from_secs(15));
    writer.step(&swarm.robots[0]);
    writer.step(&swarm.robots[0]);
    writer.pass(Duration::from_secs(15));
    assert_eq!((writer.notices.len(), writer.counters().is_off), (1, true), "{:?}", writer.notices);
    let first = disk.calls() + call.unwrap_or_default();
    let calls = call.map_or(0..0, |_| first..first + 1);
    disk.set_faults(Faults { calls, ..Faults::default() });
    // What comes meanwhile is there as well.
    for part in 0..8 {
        writer.pass(Duration::from_secs(700));
        if part < 6 {
            fly(&mut swarm, &mut writer, 1, &mut random, small_scan);
        }
        while writer.compaction.is_some() {
            writer.step(&swarm.robots[0]);
        }
    }
    let what = format!("{call:?}: {:?} {:?}", writer.notices, writer.counters());
    assert!(!writer.counters().is_off, "{what}");
    assert!(
        matches!(writer.notices.last(), Some(Notice::Warning(text)) if text.contains("works again")),
        "{what}"
    );
    drop(writer);
    let is_hit = call.is_none() || disk.calls() > first;
    disk.set_faults(Faults::default());
    let (robot, restored) = restart(&disk, two(Codec::Paper).remove(0), 2_000);
    assert_eq!((restored.damaged_segments, restored.skipped_bytes), (0, 0), "{what}");
    let of = &swarm.robots[0];
    for stream in of.session().streams() {
        assert_eq!(robot.session().received(stream), of.session().received(stream), "{stream:?} {what}");
    }
    assert_eq!(Model::of_robot(&robot), Model::of_robot(of), "{what}");
    is_hit
}

#[test]
fn a_disk_that_has_room_again_has_all_that_came_meanwhile_whichever_call_fails_then() {
    let files = MemoryDisk::default();
    for is_full_at_start in [false, true] {
        assert!(goes_on(&files, is_full_at_start, None));
        let mut call = 0;
        while goes_on(&files, is_full_at_start, Some(call)) {
            call += 1;
        }
        println!("each of {call} calls has failed");
        assert!(call > 20);
    }
}
