//! rosbag2 folders: split, packed, damaged, incomplete, hostile, and with several robots in them.

mod common;

use std::io::Cursor;
use std::path::Path;

use common::{Folder, Message, messages_of};
use flockmap_grid::{Pose, Scan, Stamp};
use flockmap_io::{
    Frame, Problem, ReadError, RecordKind, RecordOptions, RecordSummary, RecordWriter, TopicOf, describe,
    open_record,
};
use proptest::prelude::*;

fn frames(count: i64, x: f64) -> Vec<Frame> {
    (0..count)
        .map(|i| Frame {
            scan: Scan {
                stamp: Stamp(5_000_000 + i * 100_000),
                points: (0..50).map(|k| [k as f32 * 0.1, (i * k % 17) as f32, -1.5]).collect(),
                no_returns: Vec::new(),
            },
            t_map_sensor: Pose::from_translation([x + i as f64 * 0.5, 1.0, 0.25]),
            points_dropped: 0,
        })
        .collect()
}

/// What a robot of this name records.
fn messages(robot: &str, frames: &[Frame]) -> Vec<Message> {
    let mut bytes = Cursor::new(Vec::new());
    let mut writer = RecordWriter::new(&mut bytes, "robot.mcap", robot).unwrap();
    frames.iter().for_each(|frame| writer.write(&frame.scan, &frame.t_map_sensor).unwrap());
    writer.finish().unwrap();
    messages_of(&bytes.into_inner())
}

/// The same with all topics in a namespace, and names of frames that other robots have too.
fn namespaced(robot: &str, frames: &[Frame]) -> Vec<Message> {
    let rename = |(topic, schema, mut data): Message| {
        let starts = |at: &usize| data[*at..].starts_with(robot.as_bytes());
        let places: Vec<usize> = (0..data.len()).filter(starts).collect();
        for at in places {
            data[at..at + robot.len()].fill(b'r');
        }
        let topic = if topic == "/tf" { format!("/{robot}/tf") } else { topic };
        (topic, schema, data)
    };
    messages(robot, frames).into_iter().map(rename).collect()
}

fn mcap_of(messages: &[Message]) -> Vec<u8> {
    common::mcap_of(messages, mcap::WriteOptions::new().compression(None).chunk_size(Some(4_000)), "cdr")
}

/// As `ros2 bag record` of Jazzy writes it.
fn metadata(files: &[&str], packing: [&str; 2]) -> String {
    let [format, mode] = packing;
    let paths: String = files.iter().map(|file| format!("    - {file}\n")).collect();
    let each: String = files
        .iter()
        .map(|file| {
            format!(
                "    - path: {file}\n      starting_time:\n        nanoseconds_since_epoch: 5000000000\n      \
                 duration:\n        nanoseconds: 100\n      message_count: 9\n"
            )
        })
        .collect();
    format!(
        "rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: mcap\n  duration:\n    nanoseconds: 3000000000\n  \
         starting_time:\n    nanoseconds_since_epoch: 5000000000\n  message_count: 90\n  topics_with_message_count:\n    \
         - topic_metadata:\n        name: /robot1/points\n        type: sensor_msgs/msg/PointCloud2\n        \
         serialization_format: cdr\n        offered_qos_profiles:\n          - history: keep_last\n            depth: 10\n            \
         deadline:\n              sec: 9223372036\n              nsec: 854775807\n        \
         type_description_hash: RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5\n      \
         message_count: 30\n  compression_format: \"{format}\"\n  compression_mode: \"{mode}\"\n  \
         relative_file_paths:\n{paths}  files:\n{each}  custom_data: ~\n  ros_distro: jazzy\n"
    )
}

/// A bag of one recording in three files, the first of which has no say in the order.
const FILES: [&str; 3] = ["flight_9.mcap", "flight_10.mcap", "part of another name.mcap"];

fn split(folder: &Folder, messages: &[Message]) {
    for (file, part) in FILES.iter().zip(messages.chunks(messages.len().div_ceil(3))) {
        std::fs::write(folder.join(file), mcap_of(part)).unwrap();
    }
    std::fs::write(folder.join("metadata.yaml"), metadata(&FILES, ["", ""])).unwrap();
}

fn read(
    path: &Path,
    options: &RecordOptions,
) -> Result<(RecordSummary, Vec<Frame>, Vec<ReadError>), ReadError> {
    let record = open_record(path, options)?;
    let (mut frames, mut errors) = (Vec::new(), Vec::new());
    for frame in record.frames {
        match frame {
            Ok(frame) => frames.push(frame),
            Err(error) => errors.push(error),
        }
    }
    Ok((record.summary, frames, errors))
}

fn refused(folder: &Folder) -> String {
    open_record(folder.join(""), &RecordOptions::default()).map(drop).unwrap_err().to_string()
}

#[test]
fn a_split_bag_is_one_record() {
    let (folder, frames) = (Folder::new(), frames(30, 0.0));
    split(&folder, &messages("robot1", &frames));
    let (summary, back, errors) = read(&folder.join(""), &RecordOptions::default()).unwrap();
    assert_eq!((back, errors), (frames, vec![]));
    assert_eq!((summary.frames, summary.scans_without_pose, summary.damages), (30, 0, vec![]));
    assert_eq!(summary.points_topic.as_deref(), Some("/robot1/points"));
    assert_eq!(summary.map_frame.as_deref(), Some("map"));
    assert_eq!(RecordKind::of(folder.join("")).unwrap(), RecordKind::Bag);
    let text = describe(folder.join("")).unwrap().to_string();
    assert!(text.contains("rosbag2 folder, 3 files, "), "{text}");
    assert!(text.contains("/robot1/points: 30 × sensor_msgs/msg/PointCloud2"), "{text}");
}

#[test]
fn more_scans_than_may_wait_come_in_the_order_of_the_files() {
    // Read in the order of their names, the last part would be first: too far out of order.
    let (folder, frames) = (Folder::new(), frames(900, 0.0));
    split(&folder, &messages("robot1", &frames));
    assert_eq!(read(&folder.join(""), &RecordOptions::default()).unwrap().1, frames);
    let wrong = metadata(&[FILES[2], FILES[0], FILES[1]], ["", ""]);
    std::fs::write(folder.join("metadata.yaml"), wrong).unwrap();
    assert!(refused(&folder).contains("the number of scans that lie out of order"), "{}", refused(&folder));
}

#[test]
fn packed_files_and_packed_messages_are_unpacked() {
    let frames = frames(300, 0.0);
    let messages = messages("robot1", &frames);
    let folder = Folder::new();
    let packed = zstd::bulk::compress(&mcap_of(&messages), 3).unwrap();
    std::fs::write(folder.join("a_0.mcap.zstd"), &packed).unwrap();
    std::fs::write(folder.join("metadata.yaml"), metadata(&["a_0.mcap.zstd"], ["zstd", "FILE"])).unwrap();
    assert_eq!(read(&folder.join(""), &RecordOptions::default()).unwrap().1, frames);
    let (summary, back, _) = read(&folder.join("a_0.mcap.zstd"), &RecordOptions::default()).unwrap();
    assert_eq!((summary.frames, back), (300, frames.clone()));
    // Cut short, all before the cut is there, and then the place.
    std::fs::write(folder.join("a_0.mcap.zstd"), &packed[..packed.len() * 2 / 3]).unwrap();
    let (_, back, errors) = read(&folder.join(""), &RecordOptions::default()).unwrap();
    assert!(back.len() > 100 && back.len() < 300 && back == frames[..back.len()]);
    assert!(matches!(errors[..], [ReadError { problem: Problem::Truncated { .. }, .. }]), "{errors:?}");

    let folder = Folder::new();
    let pack = |(topic, schema, data): Message| (topic, schema, zstd::bulk::compress(&data, 1).unwrap());
    let mut packed: Vec<Message> = messages.into_iter().map(pack).collect();
    packed.push(("/tf".into(), "tf2_msgs/msg/TFMessage".into(), b"not packed".to_vec()));
    std::fs::write(folder.join("a_0.mcap"), mcap_of(&packed)).unwrap();
    std::fs::write(folder.join("metadata.yaml"), metadata(&["a_0.mcap"], ["zstd", "MESSAGE"])).unwrap();
    let (_, back, errors) = read(&folder.join(""), &RecordOptions::default()).unwrap();
    assert_eq!(back, frames);
    let [error] = &errors[..] else { panic!("{errors:?}") };
    assert!(error.to_string().contains("expected messages packed with zstd"), "{error}");
}

#[test]
fn a_missing_or_cut_part_costs_only_its_own_scans() {
    let (folder, frames) = (Folder::new(), frames(30, 0.0));
    split(&folder, &messages("robot1", &frames));
    let second = folder.join(FILES[1]);
    let bytes = std::fs::read(&second).unwrap();
    std::fs::write(&second, &bytes[..bytes.len() / 2]).unwrap();
    let (summary, back, errors) = read(&folder.join(""), &RecordOptions::default()).unwrap();
    assert!(back.len() > 20 && back.iter().all(|frame| frames.contains(frame)), "{}", back.len());
    assert_eq!(back.last(), frames.last());
    let [error] = &errors[..] else { panic!("{errors:?}") };
    assert!(error.path == second && matches!(error.problem, Problem::Truncated { .. }), "{error}");
    assert_eq!(summary.damages, errors);

    std::fs::remove_file(&second).unwrap();
    let (_, back, errors) = read(&folder.join(""), &RecordOptions::default()).unwrap();
    assert!(back.len() >= 19 && back.iter().all(|frame| frames.contains(frame)), "{}", back.len());
    let [error] = &errors[..] else { panic!("{errors:?}") };
    assert!(error.path == second && matches!(error.problem, Problem::Io { .. }), "{error}");

    FILES.iter().for_each(|file| drop(std::fs::remove_file(folder.join(file))));
    let error = refused(&folder);
    assert!(error.contains("flight_9.mcap: cannot read"), "{error}");
}

#[test]
fn a_bag_reads_no_file_outside_of_its_folder() {
    let outside = Folder::new();
    let secret = outside.join("secret.mcap");
    std::fs::write(&secret, mcap_of(&messages("robot1", &frames(3, 0.0)))).unwrap();
    let folder = Folder::new();
    std::fs::create_dir_all(folder.join("bag")).unwrap();
    std::fs::copy(&secret, folder.join("beside.mcap")).unwrap();
    let bag = |file: &str| {
        std::fs::write(folder.join("bag/metadata.yaml"), metadata(&[file], ["", ""])).unwrap();
        open_record(folder.join("bag"), &RecordOptions::default()).map(drop).unwrap_err().to_string()
    };
    for file in
        [&secret.display().to_string(), "../beside.mcap", "a/../../beside.mcap", "''", "./../beside.mcap"]
    {
        let error = bag(file);
        assert!(
            error.contains("metadata.yaml: line ") && error.contains("within the folder of the bag"),
            "{error}"
        );
    }
}

#[test]
fn a_bag_in_another_storage_says_how_to_convert_it() {
    let folder = Folder::new();
    let text = metadata(&["a_0.db3"], ["", ""]);
    std::fs::write(folder.join("metadata.yaml"), text.replace("identifier: mcap", "identifier: sqlite3"))
        .unwrap();
    std::fs::write(folder.join("a_0.db3"), b"SQLite format 3\0").unwrap();
    assert!(refused(&folder).contains("--dst-storage mcap") && refused(&folder).contains("sqlite3"));
    std::fs::write(folder.join("metadata.yaml"), text).unwrap();
    assert!(refused(&folder).contains("--dst-storage mcap"), "{}", refused(&folder));
    std::fs::remove_file(folder.join("metadata.yaml")).unwrap();
    assert!(refused(&folder).contains("--dst-storage mcap"), "{}", refused(&folder));
    let error = open_record(folder.join("a_0.db3"), &RecordOptions::default()).unwrap_err().to_string();
    assert!(error.contains("--dst-storage mcap"), "{error}");
    let error = describe(folder.join("a_0.db3")).unwrap_err().to_string();
    assert!(error.contains("--dst-storage mcap"), "{error}");
}

#[test]
fn a_folder_without_metadata_is_read_where_its_files_leave_no_doubt() {
    let (folder, frames) = (Folder::new(), frames(30, 0.0));
    let messages = messages("robot1", &frames);
    let bag = folder.join("flight");
    std::fs::create_dir_all(&bag).unwrap();
    std::fs::write(bag.join("any name.mcap"), mcap_of(&messages)).unwrap();
    assert_eq!(read(&bag, &RecordOptions::default()).unwrap().1, frames, "there is one");
    std::fs::remove_file(bag.join("any name.mcap")).unwrap();
    // As a recorder that was switched off leaves them.
    for (number, part) in messages.chunks(messages.len() / 11).enumerate() {
        std::fs::write(bag.join(format!("flight_{number}.mcap")), mcap_of(part)).unwrap();
    }
    assert_eq!(read(&bag, &RecordOptions::default()).unwrap().1, frames, "numbered");
    // Records of two robots side by side are not one record.
    std::fs::rename(bag.join("flight_3.mcap"), bag.join("robot_3.mcap")).unwrap();
    let error = open_record(&bag, &RecordOptions::default()).unwrap_err().to_string();
    assert!(
        error.contains("ros2 bag reindex -s mcap") && error.contains("12 files .mcap without it"),
        "{error}"
    );
    // Nor is a file and what it was packed to.
    std::fs::rename(bag.join("robot_3.mcap"), bag.join("flight_4.mcap.zstd")).unwrap();
    assert!(open_record(&bag, &RecordOptions::default()).is_err());
}

#[test]
fn metadata_that_asks_for_much_is_refused() {
    let folder = Folder::new();
    let path = folder.join("metadata.yaml");
    std::fs::File::create(&path).unwrap().set_len(17 << 20).unwrap();
    assert!(refused(&folder).contains("the file in bytes is 17825792, the limit is 16777216"));
    std::fs::write(&path, format!("a: {}", "[".repeat(100_000))).unwrap();
    assert!(refused(&folder).contains("metadata.yaml: line 1"), "{}", refused(&folder));
    let many: Vec<String> = (0..65_537).map(|number| format!("{number}.mcap")).collect();
    let many: Vec<&str> = many.iter().map(String::as_str).collect();
    std::fs::write(&path, metadata(&many, ["", ""])).unwrap();
    assert!(refused(&folder).contains("the number of files of a bag is 65537"), "{}", refused(&folder));
    // Each line would be ten times the one before it.
    let mut text = "a0: &a0 [x,x,x,x,x,x,x,x,x,x]\n".to_owned();
    for i in 1..40 {
        let before = format!("*a{}", i - 1);
        text += &format!("a{i}: &a{i} [{}]\n", [before.as_str(); 10].join(","));
    }
    std::fs::write(&path, text + "rosbag2_bagfile_information:\n  relative_file_paths: *a39\n").unwrap();
    assert!(refused(&folder).contains("expected the metadata of a bag"), "{}", refused(&folder));
}

#[test]
fn metadata_that_is_none_is_told() {
    let folder = Folder::new();
    for (text, expected) in [
        ("", "below \"rosbag2_bagfile_information:\""),
        ("- a\n- b\n", "below \"rosbag2_bagfile_information:\""),
        ("rosbag2_bagfile_information:\n  version: 5\n", "files of a bag in relative_file_paths, found none"),
        ("a: [1, 2\nb: 3\n", "expected YAML, as ros2 bag writes it"),
        ("a: \"\u{1}", "metadata.yaml: line "),
    ] {
        std::fs::write(folder.join("metadata.yaml"), text).unwrap();
        assert!(refused(&folder).contains(expected), "{text:?}: {}", refused(&folder));
    }
    let twice = metadata(&["a.mcap", "b.mcap", "a.mcap"], ["", ""]);
    std::fs::write(folder.join("metadata.yaml"), twice).unwrap();
    assert!(refused(&folder).contains("each file once") && refused(&folder).contains("a.mcap"));
    std::fs::write(folder.join("metadata.yaml"), metadata(&["a.mcap"], ["lz4", "FILE"])).unwrap();
    assert!(refused(&folder).contains("found \"lz4, file\""), "{}", refused(&folder));
    std::fs::write(folder.join("metadata.yaml"), b"a: \xff").unwrap();
    assert!(refused(&folder).contains("YAML in UTF-8"));
}

proptest! {
    #[test]
    fn damaged_metadata_never_panics(
        cut in any::<prop::sample::Index>(),
        flips in prop::collection::vec((any::<prop::sample::Index>(), "[ \\-\\[\\]{}:&*!|>'\"%@,#?~\n\t\\x00a]"), 0..6),
    ) {
        let folder = Folder::new();
        let mut text = metadata(&FILES, ["", ""]).into_bytes();
        for (at, with) in flips {
            let at = at.index(text.len());
            text[at] = with.as_bytes()[0];
        }
        text.truncate(cut.index(text.len() + 1));
        std::fs::write(folder.join("metadata.yaml"), text).unwrap();
        // None of the files is there.
        prop_assert!(open_record(folder.join(""), &RecordOptions::default()).is_err());
    }
}

/// A bag of two robots whose names of frames are the same.
fn two_robots(folder: &Folder, of: impl Fn(&str, &[Frame]) -> Vec<Message>) -> [Vec<Frame>; 2] {
    let flights = [frames(12, 0.0), frames(12, 100.0)];
    let [a, b] = [of("robot1", &flights[0]), of("robot2", &flights[1])];
    // One after the other, as they were recorded together.
    let both: Vec<Message> = a.into_iter().zip(b).flat_map(|(a, b)| [a, b]).collect();
    split(folder, &both);
    flights
}

#[test]
fn each_robot_of_a_bag_has_its_own_poses() {
    for of in [messages, namespaced] {
        for without in ["", "odometry", "tf"] {
            let folder = Folder::new();
            let kept = |robot: &str, frames: &[Frame]| {
                let mut messages = of(robot, frames);
                messages.retain(|(topic, ..)| without.is_empty() || !topic.ends_with(without));
                messages
            };
            let flights = two_robots(&folder, kept);
            let error = open_record(folder.join(""), &RecordOptions::default()).unwrap_err();
            let topics = vec!["/robot1/points".to_owned(), "/robot2/points".to_owned()];
            assert_eq!(error.problem, Problem::SeveralTopics { of: TopicOf::Scans, topics });
            for (robot, flight) in ["robot1", "robot2"].iter().zip(flights) {
                let points_topic = Some(format!("/{robot}/points"));
                let options = RecordOptions { points_topic, ..RecordOptions::default() };
                let (_, back, errors) = read(&folder.join(""), &options).unwrap();
                assert_eq!((back, errors), (flight, vec![]), "{robot} without {without:?}");
            }
        }
    }
}

#[test]
fn odometry_of_another_robot_is_not_taken() {
    let folder = Folder::new();
    let of = |robot: &str, frames: &[Frame]| {
        let mut messages = namespaced(robot, frames);
        // Nothing tells where robot 1 was.
        messages.retain(|(topic, ..)| topic.ends_with("points") || topic == "/robot2/odometry");
        messages.resize(24, messages[0].clone());
        messages
    };
    two_robots(&folder, of);
    let points_topic = Some("/robot1/points".to_owned());
    let options = RecordOptions { points_topic, ..RecordOptions::default() };
    let error = open_record(folder.join(""), &options).unwrap_err();
    let topics = vec!["/robot2/odometry".to_owned()];
    assert_eq!(error.problem, Problem::SeveralTopics { of: TopicOf::Odometry, topics }, "{error}");
}
