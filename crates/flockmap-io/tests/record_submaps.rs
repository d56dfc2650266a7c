//! Submaps in records: written and read back, from a SLAM's own topic, damaged, too many.

mod common;

use common::{Folder, mcap_of, messages_of};
use flockmap_grid::{Pose, Scan, Stamp, SubmapId};
use flockmap_io::ros::{self, Header, PoseArray, encode};
use flockmap_io::{Record, RecordOptions, RecordWriter, open_record};
use mcap::WriteOptions;

const POSE_ARRAY: &str = "geometry_msgs/msg/PoseArray";

fn at(x: f64) -> Pose {
    Pose::from_translation([x, 0.0, 0.0])
}

fn stamp(number: i64) -> Stamp {
    Stamp(1_000_000 * number)
}

/// A file of our own writer: ten scans, one a second from 1 s on, and before each what is said of submaps there.
fn written(submaps: &dyn Fn(i64) -> Option<Vec<Pose>>) -> Vec<u8> {
    let mut out = std::io::Cursor::new(Vec::new());
    let mut writer = RecordWriter::new(&mut out, "robot7.mcap", "robot7").unwrap();
    for number in 1..=10 {
        if let Some(poses) = submaps(number) {
            writer.write_submaps(stamp(number), &poses).unwrap();
        }
        let points = vec![[3.0, 0.0, number as f32]];
        writer.write(&Scan { stamp: stamp(number), points, no_returns: Vec::new() }, &at(0.0)).unwrap();
    }
    writer.finish().unwrap();
    out.into_inner()
}

/// Ten scans, and behind each of these messages of a SLAM on `/slam/submaps`.
fn of_slam(messages: &[(usize, Vec<u8>)]) -> Vec<u8> {
    let scans = messages_of(&written(&|_| None));
    let mut all = Vec::new();
    let mut scan = 0;
    for message in scans {
        scan += usize::from(message.0.ends_with("/points"));
        let is_scan = message.0.ends_with("/points");
        all.push(message);
        let said = messages.iter().filter(|(behind, _)| is_scan && *behind == scan);
        all.extend(said.map(|(_, data)| ("/slam/submaps".to_owned(), POSE_ARRAY.to_owned(), data.clone())));
    }
    mcap_of(&all, WriteOptions::new(), "cdr")
}

fn list(now: Stamp, poses: &[Pose]) -> Vec<u8> {
    let poses = poses.iter().map(|pose| (*pose).into()).collect();
    encode(&PoseArray { header: Header::new(now, "map"), poses })
}

fn opened(bytes: &[u8], topic: Option<&str>) -> Result<Record, String> {
    let folder = Folder::new();
    let path = folder.join("r.mcap");
    std::fs::write(&path, bytes).unwrap();
    let options = RecordOptions { submaps_topic: topic.map(str::to_owned), ..RecordOptions::default() };
    let record = open_record(&path, &options).map_err(|error| error.to_string())?;
    assert_eq!(record.summary.frames, 10);
    Ok(record)
}

/// Microseconds, number and x of each pose of a record.
fn shown(record: &Record) -> Vec<(i64, u16, f64)> {
    let poses = record.submaps.iter();
    poses.map(|p| (p.stamp.0, p.submap.number(), p.t_map_submap.translation()[0])).collect()
}

#[test]
fn what_is_written_of_submaps_is_read_back_where_it_is_asked_for() {
    let turned = Pose::from_yaw([1.0, -2.0, 0.5], 0.3).rounded().unwrap();
    let said = |number| match number {
        1 => Some(vec![at(0.0)]),
        4 => Some(vec![at(0.0), at(0.0)]),
        7 => Some(vec![turned, at(0.25)]),
        _ => None,
    };
    let bytes = written(&said);
    assert_eq!(bytes, written(&said), "the same input gives the same bytes");
    let record = opened(&bytes, Some("/robot7/submaps")).unwrap();
    let poses: Vec<_> = record.submaps.iter().map(|p| (p.stamp, p.submap.number(), p.t_map_submap)).collect();
    let expected =
        [(stamp(1), 0, at(0.0)), (stamp(4), 1, at(0.0)), (stamp(7), 0, turned), (stamp(7), 1, at(0.25))];
    assert_eq!(poses, expected);
    assert!(opened(&bytes, None).unwrap().submaps.is_empty());
}

#[test]
fn the_lists_of_a_slam_count_from_their_stamps() {
    let bytes = of_slam(&[
        (1, list(stamp(2), &[at(0.0)])),
        (5, list(stamp(4), &[at(0.0), at(0.5)])),
        (6, list(stamp(6), &[at(0.0), at(0.5)])),
        (10, list(stamp(60), &[at(-1.0)])),
    ]);
    let record = opened(&bytes, Some("/slam/submaps")).unwrap();
    let expected = [(2_000_000, 0, 0.0), (4_000_000, 1, 0.5), (60_000_000, 0, -1.0)];
    assert_eq!(shown(&record), expected);
}

#[test]
fn a_list_without_a_stamp_counts_behind_the_scan_before_it() {
    let bytes = of_slam(&[(3, list(Stamp(0), &[at(0.5)])), (5, list(Stamp(0), &[at(0.5), at(1.0)]))]);
    let record = opened(&bytes, Some("/slam/submaps")).unwrap();
    assert_eq!(shown(&record), [(3_000_001, 0, 0.5), (5_000_001, 1, 1.0)]);
}

#[test]
fn a_topic_that_does_not_say_how_submaps_lie_is_refused_with_those_that_may() {
    let bytes = of_slam(&[(1, list(stamp(1), &[at(0.0)]))]);
    for topic in ["/submaps", "/robot7/points"] {
        let error = opened(&bytes, Some(topic)).unwrap_err();
        let expected = format!(
            "expected poses of submaps on the topic {topic} (geometry_msgs/msg/PoseArray in the encoding \"cdr\"), \
             found /slam/submaps"
        );
        assert!(error.ends_with(&expected), "{error}");
    }
    let error = opened(&of_slam(&[]), Some("/slam/submaps")).unwrap_err();
    assert!(error.ends_with("found no topic of that type"), "{error}");
}

#[test]
fn a_list_that_is_none_is_left_out_with_its_message_and_byte() {
    let good = |x: f64| list(stamp(2), &[at(x)]);
    let numbers = |pose: ros::Pose| encode(&PoseArray { header: Header::default(), poses: vec![pose] });
    let nan = numbers(ros::Pose { position: [f64::NAN, 0.0, 0.0], ..ros::Pose::default() });
    let unturned = numbers(ros::Pose { orientation: [0.0; 4], ..ros::Pose::default() });
    let far = list(stamp(2), &[at(215_000.0)]);
    let many = list(stamp(2), &vec![at(0.0); SubmapId::COUNT + 1]);
    let mut promised = list(stamp(2), &[at(0.0)]);
    // The number of poses is behind the header: 4 bytes before the data, a stamp, "map" with its length and zero.
    promised[4 + 8 + 8..][..4].copy_from_slice(&4_000u32.to_le_bytes());
    let cut = good(1.0)[..60].to_vec();
    for (message, expected) in [
        (nan, "expected a finite position"),
        (unturned, "a quaternion that is not zero"),
        (far, "within ±214 km"),
        (many, "the number of submaps is 4097, the limit is 4096"),
        (promised, "ends too early: expected a pose"),
        (cut, "ends too early: expected a pose"),
        (b"what".to_vec(), "plain CDR"),
    ] {
        let bytes = of_slam(&[(1, good(0.5)), (2, message), (3, list(stamp(4), &[at(0.75)]))]);
        let record = opened(&bytes, Some("/slam/submaps")).unwrap();
        let damages: Vec<String> = record.summary.damages.iter().map(ToString::to_string).collect();
        assert_eq!(damages.len(), 1, "{damages:?}");
        assert!(damages[0].contains(expected) && damages[0].contains("/slam/submaps"), "{damages:?}");
        assert!(damages[0].contains("message 2"), "{damages:?}");
        assert_eq!(shown(&record), [(2_000_000, 0, 0.5), (4_000_000, 0, 0.75)], "nothing of it is taken");
    }
}

#[test]
fn a_list_with_any_byte_changed_is_left_out_or_says_poses() {
    let whole = list(stamp(2), &[at(0.5), Pose::from_yaw([1.0, 2.0, 3.0], 0.5)]);
    for place in 0..whole.len() {
        for change in [0x01, 0x80, 0xff] {
            let mut message = whole.clone();
            message[place] ^= change;
            let record = opened(&of_slam(&[(1, message)]), Some("/slam/submaps")).unwrap();
            let numbers: Vec<u16> = record.submaps.iter().map(|pose| pose.submap.number()).collect();
            let damages = record.summary.damages.len();
            let is_taken = damages == 0 && [&[][..], &[0], &[0, 1]].contains(&&numbers[..]);
            assert!(is_taken || (damages == 1 && numbers.is_empty()), "byte {place}: {numbers:?}");
            let are_poses = record.submaps.iter().all(|p| p.t_map_submap.rounded() == Ok(p.t_map_submap));
            assert!(are_poses, "byte {place}");
        }
    }
}

#[test]
fn as_many_submaps_as_a_run_may_have_are_read() {
    let all: Vec<Pose> = (0..SubmapId::COUNT).map(|number| at(number as f64 * 0.5)).collect();
    let record = opened(&of_slam(&[(1, list(stamp(2), &all))]), Some("/slam/submaps")).unwrap();
    assert_eq!((record.submaps.len(), record.summary.damages), (SubmapId::COUNT, Vec::new()));
}

#[test]
fn what_no_reader_would_take_is_not_written() {
    let out = std::io::Cursor::new(Vec::new());
    let mut writer = RecordWriter::new(out, "robot7.mcap", "robot7").unwrap();
    let mut error = |poses: &[Pose]| writer.write_submaps(stamp(1), poses).unwrap_err().to_string();
    let many = error(&vec![at(0.0); SubmapId::COUNT + 1]);
    assert!(many.contains("4097 submaps") && many.contains("at most 4096"), "{many}");
    let far = error(&[at(1e9)]);
    assert!(far.contains("a pose of a submap"), "{far}");
}
