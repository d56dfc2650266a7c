//! Simulated swarms written as records, as a user runs them.

mod common;

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use common::{fails, good, json};

const SMALL: &str = "--robots 2 --resolution 0.25 --range 6 --seconds 3";

/// A room of 9 × 7 × 2.6 m with three poles: made and flown in no time.
fn room(folder: &Path) -> String {
    let mut points = Vec::new();
    let mut put = |x: i32, y: i32, z: i32| points.push([x, y, z].map(|cell| cell as f32 * 0.1 + 0.05));
    for x in 0..90 {
        for y in 0..70 {
            let is_wall = x == 0 || x == 89 || y == 0 || y == 69;
            let is_pole = [(40, 30), (60, 50), (20, 50)].contains(&(x, y));
            let height = if is_wall || is_pole { 26 } else { 1 };
            (0..height).for_each(|z| put(x, y, z));
        }
    }
    let path = folder.join("room.pcd");
    let cloud = flockmap_io::PointCloud { points, ..Default::default() };
    flockmap_io::write_cloud(&path, &cloud).unwrap();
    path.display().to_string()
}

fn bytes(folder: &Path, robot: u32) -> Vec<u8> {
    std::fs::read(folder.join(format!("robot{robot}.mcap"))).expect("the record is there")
}

#[test]
fn the_same_flight_gives_the_same_files_with_one_thread_and_with_two() {
    let folder = tempfile::tempdir().unwrap();
    let room = room(folder.path());
    let fly = |name: &str, more: &str| {
        let out = folder.path().join(name);
        good(&format!("sim fly --scene {room} {SMALL} {more} --out {}", out.display()));
        [1, 2].map(|robot| bytes(&out, robot))
    };
    let first = fly("a", "--threads 1");
    assert!(first == fly("b", "--threads 2"), "the number of threads shows in the files");
    assert!(first != fly("d", "--seed 2"), "the seed does not show in the files");
}

#[test]
fn a_replay_of_the_files_is_the_replay_of_the_flight() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().display();
    let room = room(folder.path());
    let flight = "--resolution 0.25 --range 6 --seconds 3 --lidar mid360 --no-returns --moving-obstacles 3 --range-noise 0.02 --seed 4";
    good(&format!("sim fly --scene {room} --robots 2 {flight} --out {out}"));
    let seen = bytes(folder.path(), 1);
    good(&format!("sim fly --scene {room} --robots 2 {flight} --hide-team-mates --out {out}/hidden"));
    assert_ne!(seen.len(), bytes(&folder.path().join("hidden"), 1).len(), "nobody is seen");
    let radio = "--see-team-mates --resolution 0.25 --range 6 --loss 0.2 --delay-ms 20 --seed 4";
    good(&format!("replay {out}/robot1.mcap {out}/robot2.mcap {radio} --json {out}/files.json"));
    good(&format!(
        "replay {room} --see-team-mates {flight} --loss 0.2 --delay-ms 20 --json {out}/flight.json"
    ));
    let (files, flight) = (json(&folder.path().join("files.json")), json(&folder.path().join("flight.json")));
    assert!(files["sum"]["total_bytes"].as_u64().unwrap() > 5_000);
    for what in ["sum", "kb_per_second", "agreement"] {
        assert_eq!(files[what], flight[what], "{what}");
    }
    for robot in [0, 1] {
        assert_eq!(files["robots"][robot]["layers"], flight["robots"][robot]["layers"]);
    }
}

#[test]
fn a_flight_tells_what_it_wrote_and_shows_its_map() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().display();
    let room = room(folder.path());
    std::fs::write(folder.path().join("robot3.mcap"), b"of an earlier flight").unwrap();
    let text = good(&format!("sim fly --scene {room} {SMALL} --out {out} --json {out}/flight.json"));
    assert!(text.contains("robot2") && text.contains("metres"), "{text}");
    let facts = json(&folder.path().join("flight.json"));
    for robot in facts["robots"].as_array().unwrap() {
        assert_eq!(robot["scans"], 30);
        assert!(robot["points"].as_u64().unwrap() > 10_000, "{robot}");
        assert_eq!(
            robot["file_bytes"],
            bytes(folder.path(), if robot["robot"] == "robot1" { 1 } else { 2 }).len()
        );
    }
    let text = good(&format!("info {out}/robot1.mcap"));
    assert!(text.contains("30 frames of 30 scans (0 without a pose)"), "{text}");
    // At 0 s, at 2 s, and at the end.
    assert!(text.contains("/robot1/viewer/map: 3 ×") && text.contains("/robot1/viewer/path: 3 ×"), "{text}");
    good(&format!("sim fly --scene {room} {SMALL} --no-view --out {out}"));
    assert!(!good(&format!("info {out}/robot1.mcap")).contains("viewer"));
}

#[test]
fn an_exploration_is_recorded_and_its_files_do_not_depend_on_threads() {
    let folder = tempfile::tempdir().unwrap();
    let room = room(folder.path());
    let explore = |name: &str, more: &str| {
        let out = folder.path().join(name);
        let words = "--robots 2 --resolution 0.25 --range 6 --lidar mid360 --seconds-max 3";
        let text = good(&format!(
            "sim explore --scene {room} {words} {more} --out {0} --json {0}.json",
            out.display()
        ));
        (text, json(&out.with_extension("json")), [1, 2].map(|robot| bytes(&out, robot)))
    };
    let (text, facts, records) = explore("a", "--threads 1 --loss 0.1 --delay-ms 20 --budget-kb-s 50");
    assert!(text.contains("the time was over") && text.contains("voxels that can be seen"), "{text}");
    assert_eq!(facts["ended"], "time-out");
    assert_eq!((&facts["seconds"], &facts["robots"][1]["scans"]), (&3.0.into(), &30.into()));
    assert!(facts["seen_share"].as_f64().unwrap() > 0.005, "{facts}");
    assert!(facts["total_bytes"].as_u64().unwrap() > 1_000, "{facts}");
    let info = good(&format!("info {}/robot2.mcap", folder.path().join("a").display()));
    assert!(
        info.contains("30 frames of 30 scans (0 without a pose)") && info.contains("/robot2/viewer/map: 3"),
        "{info}"
    );
    let again = explore("b", "--threads 2 --loss 0.1 --delay-ms 20 --budget-kb-s 50").2;
    assert!(records == again, "the number of threads shows in the files");
    let (_, alone, _) = explore("c", "--no-sync");
    assert_eq!((&alone["total_bytes"], &alone["sync"]), (&0.into(), &false.into()));
}

#[test]
fn scans_are_as_the_options_say() {
    let folder = tempfile::tempdir().unwrap();
    let room = room(folder.path());
    let fly = |name: &str, more: &str| {
        let out = folder.path().join(name);
        let words = "--robots 1 --resolution 0.25 --range 6 --seconds 1 --no-view";
        good(&format!("sim fly --scene {room} {words} {more} --out {0} --json {0}.json", out.display()));
        let points = json(&out.with_extension("json"))["robots"][0]["points"].as_f64().unwrap();
        (points, bytes(&out, 1))
    };
    let plain = fly("plain", "");
    let dropped = fly("dropped", "--drop-out 0.25");
    assert!((dropped.0 / plain.0 - 0.75).abs() < 0.02, "{} of {}", dropped.0, plain.0);
    let crowded = fly("crowded", "--moving-obstacles 8");
    assert!(crowded.0 != plain.0, "no obstacle is seen");
    let other = fly("other", "--range-noise 0.02 --scan-motion --rendering polar");
    assert!((other.0 / plain.0 - 1.0).abs() < 0.2 && other.1 != plain.1, "{} of {}", other.0, plain.0);
    assert!(
        other == fly("again", "--range-noise 0.02 --scan-motion --rendering polar"),
        "not the same twice"
    );
}

#[test]
fn a_flight_that_is_interrupted_leaves_whole_files() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("records");
    let mut flight = Command::new(env!("CARGO_BIN_EXE_flockmap"))
        .args("sim fly --robots 1 --resolution 0.25 --seconds 600 --scene".split_whitespace())
        .arg(room(folder.path()))
        .arg("--out")
        .arg(&out)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let record = out.join("robot1.mcap");
    // The first chunk is on disk: it flies.
    while std::fs::metadata(&record).map_or(0, |m| m.len()) < 100_000 {
        assert!(flight.try_wait().unwrap().is_none(), "the flight is over");
        std::thread::sleep(Duration::from_millis(20));
    }
    let kill = Command::new("kill").args(["-INT", &flight.id().to_string()]).status().unwrap();
    assert!(kill.success());
    assert_eq!(flight.wait().unwrap().code(), Some(130));
    let text = good(&format!("info {}", record.display()));
    assert!(text.contains("(0 without a pose)") && !text.contains("damage"), "{text}");
    // The index, with which viewers open a file, is written as well.
    assert!(std::fs::read(&record).unwrap().ends_with(b"\x89MCAP0\r\n"));
}

#[test]
fn what_cannot_be_flown_is_said() {
    for (words, expected) in [
        ("sim fly --scene nowhere", "nowhere"),
        ("sim fly --threads 0", "--threads"),
        ("sim fly --moving-obstacles 2000", "--moving-obstacles: count is 2000"),
        ("sim explore --moving-obstacles 2", "unexpected argument '--moving-obstacles'"),
        ("replay a.mcap --see-team-mates", "--see-team-mates: one record"),
        ("sim fly --drop-out 2", "--drop-out is 2, expected 0 to 1"),
        ("sim explore --threads 0", "--threads is 0, expected 1 to 64"),
        ("sim explore --loss 2", "--loss is 2"),
        ("sim explore --no-sync --loss 0.1", "--no-sync"),
        ("sim explore --scene nowhere", "nowhere"),
        ("sim fly --robots 999", "999"),
        ("sim fly --resolution 0", "--resolution is 0"),
    ] {
        let error = fails(words);
        assert!(error.contains(expected), "`{words}` says: {error}");
    }
}
