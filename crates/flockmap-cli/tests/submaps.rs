//! Records of a SLAM that closes loops: replayed with its submaps, they are right on every robot.

mod common;

use std::path::{Path, PathBuf};

use common::{fails, good, json};
use flockmap::{Pose, Resolution, Robot, RobotConfig, Scan, Stamp, State, SubmapId};
use flockmap_cli::options::SourceArgs;
use flockmap_cli::{sources, swarm};
use flockmap_io::RecordWriter;
use flockmap_netsim::RadioConfig;

fn at(x: f64) -> Pose {
    Pose::from_translation([x, 0.0, 0.0])
}

/// A robot that stands in front of a wall 3 m away, and in its second half is taken to have gone 1 m further, which a
/// closure at `closes_at` puts right. Scans after it come with corrected poses.
fn record(path: &Path, robot: &str, closes_at: i64) {
    let mut writer = RecordWriter::create(path, robot).unwrap();
    for number in 0..=20i64 {
        let stamp = Stamp(number * 100_000);
        if number == 0 {
            writer.write_submaps(stamp, &[at(0.0)]).unwrap();
        }
        if number == 10 {
            writer.write_submaps(stamp, &[at(0.0), at(0.0)]).unwrap();
        }
        // In two steps, of which the second is not said to others before the first has had its time.
        if number == closes_at - 1 {
            writer.write_submaps(stamp, &[at(0.0), at(-0.5)]).unwrap();
        }
        if number == closes_at {
            writer.write_submaps(stamp, &[at(0.0), at(-1.0)]).unwrap();
        }
        if number < 20 {
            // Each half sees another part of the wall, that neither puts right what the other saw.
            let first = if number < 10 { -20 } else { 20 };
            let points = (first..first + 20).map(|y| [3.05, y as f32 * 0.1 + 0.05, 0.05]).collect();
            let drift = match number {
                _ if number < 10 || number >= closes_at => 0.0,
                _ if number < closes_at - 1 => 1.0,
                _ => 0.5,
            };
            writer.write(&Scan { stamp, points, no_returns: Vec::new() }, &at(drift)).unwrap();
        }
    }
    writer.finish().unwrap();
}

/// The records of that robot, and of one that sees nothing but what it hears.
fn records(folder: &Path, closes_at: i64) -> [PathBuf; 2] {
    let paths = ["robot1", "robot2"].map(|name| folder.join(format!("{name}.mcap")));
    record(&paths[0], "robot1", closes_at);
    let mut writer = RecordWriter::create(&paths[1], "robot1").unwrap();
    writer.write_submaps(Stamp(0), &[at(0.0)]).unwrap();
    writer.write(&Scan::default(), &at(0.0)).unwrap();
    writer.finish().unwrap();
    paths
}

/// The robots of a replay of these records.
fn flown(paths: &[PathBuf], topic: Option<&str>) -> Vec<Robot> {
    let submaps_topic = topic.iter().map(|topic| (*topic).to_owned()).collect();
    let source = SourceArgs { submaps_topic, ..SourceArgs::default() };
    let sources = match paths {
        [record] => sources::open_parts(record, &source).unwrap(),
        records => sources::open(records, &source, 7.0, false).unwrap(),
    };
    let resolution = Resolution::from_metres(0.1).unwrap();
    let config = |id| RobotConfig::new(id, resolution, 7.0);
    let run = swarm::run(sources.robots, config, RadioConfig::default()).unwrap();
    assert!(run.arrived.is_some());
    run.members.into_iter().map(|member| member.robot).collect()
}

/// What a robot shows of both halves of the wall, at the place where it is, and where the drift has put it.
fn wall(robot: &Robot) -> [State; 4] {
    let state = |x, y| robot.map().state_at([x, y, 0.05]);
    [state(3.05, -0.95), state(4.05, -0.95), state(3.05, 2.95), state(4.05, 2.95)]
}

const RIGHT: [State; 4] = [State::Occupied, State::Unknown, State::Occupied, State::Unknown];

#[test]
fn a_replay_has_the_submaps_of_the_record_and_shows_them_right_everywhere() {
    let folder = tempfile::tempdir().unwrap();
    // A closure in flight, and one behind the last scan.
    for closes_at in [15, 20] {
        let paths = records(folder.path(), closes_at);
        let robots = flown(&paths, Some("/robot1/submaps"));
        assert_eq!(robots.iter().map(|robot| robot.submap().number()).collect::<Vec<_>>(), [1, 0]);
        assert_eq!(robots[0].submap_pose(SubmapId::new(1).unwrap()), at(-1.0));
        for robot in &robots {
            assert_eq!(wall(robot), RIGHT, "a closure at {closes_at}");
        }
    }
    let paths = records(folder.path(), 20);
    let robots = flown(&paths, None);
    for robot in &robots {
        let [_, _, right, drifted] = wall(robot);
        assert!(right != State::Occupied && drifted == State::Occupied, "without the topic");
    }
}

#[test]
fn each_part_of_a_record_that_is_cut_has_submaps_of_its_own_and_hears_of_the_closure() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("robot1.mcap");
    record(&path, "robot1", 20);
    let robots = flown(&[path], Some("/robot1/submaps"));
    // The second one begins in the second submap of the record.
    let poses: Vec<_> = robots.iter().map(|robot| robot.submap_pose(robot.submap())).collect();
    assert!(robots[1].submap() == SubmapId::FIRST && poses[1] == at(-1.0), "{poses:?}");
    assert!(robots.iter().all(|robot| wall(robot) == RIGHT));
}

#[test]
fn the_program_says_what_submaps_took_and_refuses_what_does_not_fit() {
    let folder = tempfile::tempdir().unwrap();
    let [first, second] = records(folder.path(), 15);
    let (first, second, file) = (first.display(), second.display(), folder.path().join("report.json"));
    let replay = format!("replay {first} {second} --submaps-topic /robot1/submaps");
    let text = good(&format!("{replay} --json {}", file.display()));
    assert!(text.contains("Submaps: 1 begun beside the first of each robot"), "{text}");
    let report = json(&file);
    assert_eq!(report["agreement_all"], 1.0);
    let sum = |key: &str| {
        report["robots"].as_array().unwrap().iter().map(|robot| robot[key].as_u64().unwrap()).sum::<u64>()
    };
    assert_eq!([sum("submaps_begun"), sum("submap_poses")], [1, 2]);
    assert!((1..200).contains(&sum("submap_package_bytes")), "{report}");
    for (words, expected) in [
        (format!("{replay} --submap-length 5"), "cannot be used with"),
        (format!("replay {first} --submaps-topic /slam"), "found /robot1/submaps"),
        (format!("{replay} --submaps-topic /a --submaps-topic /b"), "--submaps-topic is given 3 times for 2"),
        (
            "replay forest --submaps-topic /slam".to_owned(),
            "--submaps-topic is for records, and forest is a world",
        ),
    ] {
        let error = fails(&words);
        assert!(error.contains(expected), "`{words}` says: {error}");
    }
}
