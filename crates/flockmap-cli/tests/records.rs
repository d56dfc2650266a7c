//! Records of other people through the program: bags, several robots in one, options for each.

mod common;

use std::path::{Path, PathBuf};

use common::{fails, good, json};
use flockmap::{Pose, Scan, Stamp};
use flockmap_io::{PointCloud, RecordWriter, write_cloud};

/// A robot in front of a wall that is `x` metres away.
fn record(path: &Path, robot: &str, x: f32) {
    let mut writer = RecordWriter::create(path, robot).unwrap();
    for number in 0..5i64 {
        let points = (-20..20).map(|y| [x, y as f32 * 0.1 + 0.05, 0.05]).collect();
        let scan = Scan { stamp: Stamp(number * 100_000), points, no_returns: Vec::new() };
        writer.write(&scan, &Pose::IDENTITY).unwrap();
    }
    writer.finish().unwrap();
}

/// A bag of two robots, split between them.
fn bag(folder: &Path) -> PathBuf {
    let bag = folder.join("two robots");
    std::fs::create_dir_all(&bag).unwrap();
    record(&bag.join("a_0.mcap"), "robot1", 3.05);
    record(&bag.join("a_1.mcap"), "robot2", 2.05);
    let metadata = "rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: mcap\n  \
                    relative_file_paths:\n    - a_0.mcap\n    - a_1.mcap\n";
    std::fs::write(bag.join("metadata.yaml"), metadata).unwrap();
    bag
}

/// A folder with one scan, and two files with poses.
fn scans(folder: &Path, name: &str) -> PathBuf {
    let folder = folder.join(name);
    std::fs::create_dir_all(folder.join("Scans")).unwrap();
    let points = (-20..20).map(|y| [3.05, y as f32 * 0.1 + 0.05, 0.05]).collect();
    write_cloud(folder.join("Scans/0.pcd"), &PointCloud { points, ..PointCloud::default() }).unwrap();
    for (file, x) in [("here.txt", 0), ("there.txt", 50)] {
        std::fs::write(folder.join(file), format!("1 0 0 {x} 0 1 0 0 0 0 1 0\n")).unwrap();
    }
    folder
}

/// The words of the command that follows this text.
fn command_after(text: &str, lead: &str) -> String {
    let line = text.lines().find(|line| line.trim_start().starts_with(lead));
    let line = line.unwrap_or_else(|| panic!("no line \"{lead}\" in {text}"));
    line.split_once("flockmap ").unwrap().1.to_owned()
}

#[test]
fn two_robots_in_one_bag_are_replayed_by_the_command_that_info_and_the_error_give() {
    let folder = tempfile::tempdir().unwrap();
    let bag = bag(folder.path());
    let plain = folder.path().join("bag");
    // The test cuts commands at their blanks.
    std::fs::rename(&bag, &plain).unwrap();
    let shown = good(&format!("info {}", plain.display()));
    assert!(
        shown.contains("rosbag2 folder, 2 files") && shown.contains("/robot2/points: 5 × sensor_msgs"),
        "{shown}"
    );
    let said = fails(&format!("replay {}", plain.display()));
    let each = command_after(&shown, "a robot for each topic:");
    assert_eq!(each, command_after(&said, "a robot for each topic:"));
    assert!(each.ends_with("--points-topic /robot1/points --points-topic /robot2/points"), "{each}");

    let out = folder.path().join("report");
    let text = good(&format!("{each} --out {}", out.display()));
    assert!(
        text.contains("agreement 100 %") && text.contains("bag /robot1/points + bag /robot2/points"),
        "{text}"
    );
    let report = json(&out.join("report.json"));
    assert_eq!(report["robots"].as_array().unwrap().len(), 2);
    assert!(std::fs::read_to_string(out.join("report.html")).unwrap().contains("data:image/png"));
    // Named twice is the same as once.
    let twice = each.replacen(" --points", &format!(" {} --points", plain.display()), 1);
    let bytes = |command: &str| {
        let file = folder.path().join("sum.json");
        good(&format!("{command} --json {}", file.display()));
        json(&file)["sum"].clone()
    };
    assert_eq!(bytes(&twice), bytes(&each));

    let one = command_after(&shown, "the scans of one robot:");
    assert!(good(&one).contains("cut by time into 2 robots"), "{one}");
    let (map, again) = (folder.path().join("map.ply"), folder.path().join("again.bt"));
    let export = format!("export {} --to {}", plain.display(), map.display());
    assert!(fails(&export).contains("--points-topic /robot1/points"));
    assert!(
        fails(&format!("{export} --points-topic /a --points-topic /b"))
            .contains("--points-topic is given 2 times")
    );
    // Free space comes back as free space, also without the resolution being said.
    good(&format!("{export} --points-topic /robot2/points --resolution 0.1 --free"));
    good(&format!("export {} --to {}", map.display(), again.display()));
    let direct = folder.path().join("direct.bt");
    good(&format!("export {} --to {} --points-topic /robot2/points", plain.display(), direct.display()));
    assert_eq!(std::fs::read(again).unwrap(), std::fs::read(direct).unwrap());
    assert!(good(&format!("info {}", map.display())).contains("more of free space"));
}

#[test]
fn the_paths_in_commands_are_words_of_a_shell() {
    let folder = tempfile::tempdir().unwrap();
    let bag = bag(folder.path());
    let output =
        std::process::Command::new(env!("CARGO_BIN_EXE_flockmap")).arg("info").arg(&bag).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(text.contains("two robots' --points-topic"), "{text}");
}

#[test]
fn the_same_scans_are_no_second_robot() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("robot1.mcap");
    record(&path, "robot1", 3.05);
    std::fs::create_dir_all(folder.path().join("sub")).unwrap();
    let other = folder.path().join("sub/../robot1.mcap");
    for second in [&path, &other] {
        let error = fails(&format!("replay {} {}", path.display(), second.display()));
        assert!(error.contains("robots 1 and 2 would have the same scans"), "{error}");
    }
    let bag = bag(folder.path());
    let plain = folder.path().join("bag");
    std::fs::rename(&bag, &plain).unwrap();
    let (bag, part) = (plain.display(), plain.join("a_0.mcap"));
    let error = fails(&format!("replay {bag} {} --points-topic /robot1/points", part.display()));
    assert!(error.contains("a_0.mcap, topic /robot1/points"), "{error}");
    let error = fails(&format!("replay {bag} {bag} --points-topic /robot1/points"));
    assert!(error.contains("another --points-topic for each"), "{error}");
}

#[test]
fn the_poses_of_one_robot_are_not_those_of_another() {
    let folder = tempfile::tempdir().unwrap();
    let (a, b) = (scans(folder.path(), "a"), scans(folder.path(), "b"));
    let (a, b) = (a.display(), b.display());
    let replay = format!("replay {a} {b} --scan-period 0.1");
    let error = fails(&format!("{replay} --poses {a}/here.txt"));
    assert!(error.contains("--poses is given once for 2 folders of scans: give it once for each"), "{error}");
    let json_path = folder.path().join("report.json");
    good(&format!("{replay} --poses {a}/here.txt --poses {b}/there.txt --json {}", json_path.display()));
    let report = json(&json_path);
    assert_eq!(report["agreement_all"], 1.0);
    // The second robot stands 50 m away.
    for (robot, wall) in [("here", 3.0), ("there", 53.0)] {
        let map = folder.path().join("map.ply");
        good(&format!("export {b} --scan-period 0.1 --poses {b}/{robot}.txt --to {}", map.display()));
        let cloud = flockmap_io::read_cloud(&map).unwrap();
        assert!(cloud.points.iter().all(|point| (point[0] - wall).abs() < 0.1), "{robot}");
    }
}

#[test]
fn options_for_records_that_do_not_fit_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let bag = bag(folder.path());
    let plain = folder.path().join("bag");
    std::fs::rename(&bag, &plain).unwrap();
    let scans = scans(folder.path(), "a");
    let (bag, scans) = (plain.display(), scans.display());
    let both = "--points-topic /robot1/points --points-topic /robot2/points";
    for (words, expected) in [
        (format!("{bag} --poses a.txt"), "--poses is for folders of scans, and there are none"),
        (format!("{bag} --scan-period 0.1"), "--scan-period is for folders of scans"),
        (format!("{scans} --points-topic /a"), "--points-topic is for records with topics"),
        ("forest --points-topic /a".to_owned(), "--points-topic is for records, and forest is a world"),
        (
            format!("{bag} {both} --odometry-topic /robot1/odometry"),
            "--odometry-topic is given once for 2 records",
        ),
        (
            format!("{bag} {both} --map-frame a --map-frame b --map-frame c"),
            "--map-frame is given 3 times for 2",
        ),
        (format!("{scans} {bag} {both}"), "--points-topic is given 2 times for 1"),
        (format!("{bag}/metadata.yaml"), "name the folder"),
        (
            format!("{bag} {both} --odometry-topic /robot1/odometry --odometry-topic /robot1/odometry"),
            "to a map",
        ),
    ] {
        let error = fails(&format!("replay {words}"));
        assert!(error.contains(expected), "`replay {words}` says: {error}");
    }
}
