//! MCAP records: written and read back, in every packing, out of order, with tf chains, damaged.

mod common;

use std::io::Cursor;
use std::path::Path;

use common::{Folder, Message, mcap_of, messages_of};
use flockmap_grid::{Pose, Resolution, Scan, Stamp, Voxel};
use flockmap_io::{Frame, Problem, ReadError, RecordOptions, RecordWriter, describe, open_record};
use mcap::{Compression, WriteOptions};
use proptest::prelude::*;

fn frames(count: i64) -> Vec<Frame> {
    (0..count)
        .map(|i| {
            let points = (0..200).map(|k| [k as f32 * 0.1, (i * k % 17) as f32, -1.5]).collect();
            let no_returns = if i % 2 == 0 { vec![[30.0, i as f32, 0.0]] } else { Vec::new() };
            Frame {
                scan: Scan { stamp: Stamp(5_000_000 + i * 100_000), points, no_returns },
                t_map_sensor: Pose::from_translation([i as f64 * 0.5, 1.0, 0.25]),
                points_dropped: 0,
            }
        })
        .collect()
}

/// The file as bytes, as our own writer makes it.
fn written(frames: &[Frame]) -> Vec<u8> {
    let folder = Folder::new();
    let path = folder.join("robot7.mcap");
    let mut writer = RecordWriter::create(&path, "robot7").unwrap();
    for frame in frames {
        writer.write(&frame.scan, &frame.t_map_sensor).unwrap();
    }
    writer.finish().unwrap();
    std::fs::read(path).unwrap()
}

/// All frames, then all errors.
fn read(bytes: &[u8], options: &RecordOptions) -> Result<(Vec<Frame>, Vec<ReadError>), ReadError> {
    let folder = Folder::new();
    let path = folder.join("r.mcap");
    std::fs::write(&path, bytes).unwrap();
    let (frames, errors): (Vec<_>, Vec<_>) = open_record(&path, options)?.frames.partition(Result::is_ok);
    Ok((
        frames.into_iter().map(Result::unwrap).collect(),
        errors.into_iter().map(Result::unwrap_err).collect(),
    ))
}

/// The messages of our own file, for writing them otherwise.
struct Messages(Vec<Message>);

impl Messages {
    fn of(bytes: &[u8]) -> Self {
        Self(messages_of(bytes))
    }

    fn write(&self, options: WriteOptions, encoding: &str) -> Vec<u8> {
        mcap_of(&self.0, options, encoding)
    }
}

#[test]
fn what_is_written_is_read_back() {
    let frames = frames(30);
    let bytes = written(&frames);
    let (back, errors) = read(&bytes, &RecordOptions::default()).unwrap();
    assert_eq!(errors, []);
    assert_eq!(back, frames);
    assert_eq!(bytes, written(&frames), "the same input gives the same bytes");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn any_flight_is_read_back_bit_for_bit(
        flight in prop::collection::vec(
            (1..400_000i64, prop::array::uniform3(-1e5..1e5f64), prop::array::uniform4(-1.0..1.0f64),
             prop::collection::vec(prop::array::uniform3(-200.0..200.0f32), 0..20)), 1..12),
    ) {
        let mut stamp = Stamp(0);
        let mut frames = Vec::new();
        for (step, place, turn, points) in flight {
            let Some(pose) = Pose::new(place, turn) else { continue };
            stamp = stamp.plus_micros(step);
            let no_returns = points.iter().skip(10).copied().collect();
            // As robots make them: turned on and on.
            let t_map_sensor = frames.last().map_or(pose, |f: &Frame| f.t_map_sensor.compose(&pose));
            frames.push(Frame { scan: Scan { stamp, points, no_returns }, t_map_sensor, points_dropped: 0 });
        }
        prop_assume!(!frames.is_empty());
        let (back, errors) = read(&written(&frames), &RecordOptions::default()).unwrap();
        prop_assert_eq!(errors, vec![]);
        prop_assert_eq!(back, frames);
    }
}

/// Our own file with pictures for viewers.
fn written_with_views(frames: &[Frame]) -> Vec<u8> {
    let mut out = Cursor::new(Vec::new());
    let mut writer = RecordWriter::new(&mut out, "robot7.mcap", "robot7").unwrap();
    let resolution = Resolution::from_metres(0.1).unwrap();
    for frame in frames {
        writer.write(&frame.scan, &frame.t_map_sensor).unwrap();
        if writer.is_view_due(frame.scan.stamp) {
            writer.write_view(frame.scan.stamp, resolution, (0..50).map(|x| Voxel::new(x, 3, -1))).unwrap();
        }
    }
    writer.finish().unwrap();
    out.into_inner()
}

#[test]
fn pictures_for_viewers_are_shown_and_passed_over_by_readers() {
    let frames = frames(45);
    let bytes = written_with_views(&frames);
    assert_eq!(read(&bytes, &RecordOptions::default()).unwrap(), (frames.clone(), vec![]));
    assert_eq!(bytes, written_with_views(&frames), "the same input gives the same bytes");
    // Without tf, and without odometry, the scans are still distinguished from the pictures.
    let all = Messages::of(&bytes);
    for dropped in ["/tf", "/robot7/odometry"] {
        let messages = Messages(all.0.iter().filter(|(topic, ..)| topic != dropped).cloned().collect());
        let bytes = messages.write(WriteOptions::new(), "cdr");
        assert_eq!(read(&bytes, &RecordOptions::default()).unwrap().0, frames);
    }
    let folder = Folder::new();
    let path = folder.join("r.mcap");
    std::fs::write(&path, &bytes).unwrap();
    let text = describe(&path).unwrap().to_string();
    assert!(text.contains("/robot7/viewer/map: 3 × sensor_msgs/msg/PointCloud2"), "{text}");
    assert!(text.contains("/robot7/viewer/path: 3 × ") && text.contains("45 frames of 45 scans"), "{text}");
    // The picture itself can be asked for, too: points of the map, taken back to the sensor.
    let options = RecordOptions { points_topic: Some("/robot7/viewer/map".into()), ..Default::default() };
    let (pictures, errors) = read(&bytes, &options).unwrap();
    assert_eq!((pictures.len(), errors), (3, vec![]));
    assert_eq!(pictures[0].scan.points.len(), 50);
}

#[test]
fn two_topics_of_scans_are_still_a_question() {
    let mut messages = Messages::of(&written(&frames(3)));
    for number in 0..messages.0.len() {
        let (topic, schema, data) = messages.0[number].clone();
        if topic.ends_with("/points") {
            messages.0.push(("/other".to_owned(), schema, data));
        }
    }
    let bytes = messages.write(WriteOptions::new(), "cdr");
    let error = read(&bytes, &RecordOptions::default()).unwrap_err().to_string();
    assert!(error.contains("/other, /robot7/points"), "{error}");
}

#[test]
fn every_packing_gives_the_same_frames() {
    let frames = frames(12);
    let messages = Messages::of(&written(&frames));
    let plain = || WriteOptions::new().compression(None);
    for options in [
        plain(),
        plain().use_chunks(false),
        plain().calculate_chunk_crcs(false).emit_summary_records(false).emit_summary_offsets(false),
        WriteOptions::new().compression(Some(Compression::Zstd)).chunk_size(Some(5_000)),
        WriteOptions::new().compression(Some(Compression::Lz4)).chunk_size(Some(5_000)),
    ] {
        let bytes = messages.write(options, "cdr");
        assert_eq!(read(&bytes, &RecordOptions::default()).unwrap(), (frames.clone(), vec![]));
    }
}

#[test]
fn frames_come_in_the_order_of_their_stamps() {
    let frames = frames(20);
    let mut messages = Messages::of(&written(&frames));
    messages.0.retain(|(topic, ..)| !topic.ends_with("no_returns"));
    messages.0.chunks_mut(12).for_each(<[_]>::reverse);
    let (back, errors) =
        read(&messages.write(WriteOptions::new(), "cdr"), &RecordOptions::default()).unwrap();
    assert_eq!(errors, []);
    let stamps = |frames: &[Frame]| frames.iter().map(|f| f.scan.stamp).collect::<Vec<_>>();
    assert_eq!(stamps(&back), stamps(&frames));
    assert_eq!(back[3].t_map_sensor, frames[3].t_map_sensor);
}

#[test]
fn tf_alone_and_odometry_alone_give_the_poses() {
    let frames = frames(6);
    let all = Messages::of(&written(&frames));
    for dropped in ["/tf", "/robot7/odometry"] {
        let messages = Messages(all.0.iter().filter(|(topic, ..)| topic != dropped).cloned().collect());
        let bytes = messages.write(WriteOptions::new(), "cdr");
        assert_eq!(read(&bytes, &RecordOptions::default()).unwrap().0, frames);
    }
    let messages = Messages(all.0.iter().filter(|(topic, ..)| topic.ends_with("points")).cloned().collect());
    let error = read(&messages.write(WriteOptions::new(), "cdr"), &RecordOptions::default()).unwrap_err();
    assert!(error.to_string().contains("\"robot7/lidar\", to a map, found no odometry and no tf"), "{error}");
}

#[test]
fn a_scan_without_a_pose_in_reach_is_left_out_and_counted() {
    let frames = frames(9);
    let mut messages = Messages::of(&written(&frames));
    // No pose for the frames 3 to 8: beyond the end of the poses.
    let mut poses = 0;
    messages.0.retain(|(topic, ..)| {
        poses += u32::from(topic.ends_with("odometry"));
        topic.ends_with("points")
            || topic.ends_with("no_returns")
            || (topic.ends_with("odometry") && poses <= 3)
    });
    let folder = Folder::new();
    let path = folder.join("r.mcap");
    std::fs::write(&path, messages.write(WriteOptions::new(), "cdr")).unwrap();
    let record = open_record(&path, &RecordOptions::default()).unwrap();
    let summary = record.summary;
    let poses: Vec<_> = frames[..3].iter().map(|f| (f.scan.stamp, f.t_map_sensor)).collect();
    assert_eq!(record.poses, poses);
    assert_eq!((summary.scans, summary.frames, summary.scans_without_pose), (9, 3, 6));
    let back: Vec<Frame> = record.frames.map(Result::unwrap).collect();
    assert_eq!(back, frames[..3]);
}

#[test]
fn a_foreign_encoding_is_told_with_its_topic() {
    let messages = Messages::of(&written(&frames(2)));
    let error = read(&messages.write(WriteOptions::new(), "ros1"), &RecordOptions::default()).unwrap_err();
    let text = error.to_string();
    assert!(text.contains("/robot7/points") || text.contains("/robot7/no_returns"), "{text}");
    assert!(text.contains("\"ros1\"") && text.contains("\"cdr\""), "{text}");
}

#[test]
fn topics_can_be_named_and_an_unknown_one_is_told() {
    let frames = frames(4);
    let bytes = written(&frames);
    let named = RecordOptions {
        points_topic: Some("/robot7/points".into()),
        odometry_topic: Some("/robot7/odometry".into()),
        map_frame: Some("map".into()),
        ..Default::default()
    };
    assert_eq!(read(&bytes, &named).unwrap().0, frames);
    let wrong = RecordOptions { points_topic: Some("/cloud".into()), ..Default::default() };
    let error = read(&bytes, &wrong).unwrap_err().to_string();
    assert!(error.contains("scans on the topic /cloud") && error.contains("/robot7/points"), "{error}");
    let wrong = RecordOptions { map_frame: Some("earth".into()), ..Default::default() };
    let error = read(&bytes, &wrong).unwrap_err().to_string();
    assert!(error.contains("to \"earth\"") && error.contains("map → robot7/lidar"), "{error}");
}

#[test]
fn a_truncated_file_gives_all_before_the_cut_and_then_the_place_of_the_cut() {
    let frames = frames(40);
    let bytes = Messages::of(&written(&frames)).write(WriteOptions::new().chunk_size(Some(4_000)), "cdr");
    let mut longest = 0;
    for cut in (0..bytes.len()).step_by(997) {
        match read(&bytes[..cut], &RecordOptions::default()) {
            Ok((back, errors)) => {
                assert_eq!(back, frames[..back.len()], "cut at {cut}");
                longest = longest.max(back.len());
                if let [error] = errors.as_slice() {
                    assert!(matches!(error.problem, Problem::Truncated { .. }), "{error}");
                } else {
                    // The cut is behind the data: the index is not needed.
                    assert!(errors.is_empty() && back.len() == frames.len(), "{errors:?}");
                }
            }
            Err(error) => assert!(cut < 5_000, "cut at {cut}: {error}"),
        }
    }
    assert!(longest > 30);
}

#[test]
fn a_damaged_chunk_costs_only_its_own_frames() {
    let frames = frames(40);
    // Not packed, so that the middle of the file lies in point data.
    let options = WriteOptions::new().compression(None).chunk_size(Some(4_000));
    let mut bytes = Messages::of(&written(&frames)).write(options, "cdr");
    let middle = bytes.len() / 3;
    bytes[middle] ^= 0x10;
    let (back, errors) = read(&bytes, &RecordOptions::default()).unwrap();
    assert!(back.len() >= 30 && back.len() < 40, "{}", back.len());
    assert!(back.iter().all(|frame| frames.contains(frame)));
    let [error] = errors.as_slice() else { panic!("{errors:?}") };
    assert!(error.to_string().contains("byte ") && error.to_string().contains("chunk"), "{error}");
}

#[test]
fn flipped_and_random_bytes_never_panic_and_never_give_a_wrong_frame() {
    let frames = frames(6);
    // With a check over each chunk, what is read is right.
    let good = Messages::of(&written(&frames)).write(WriteOptions::new().chunk_size(Some(2_000)), "cdr");
    // Without one, anything may come but a panic.
    let unchecked = Messages::of(&written(&frames)).write(
        WriteOptions::new().compression(None).calculate_chunk_crcs(false).chunk_size(Some(2_000)),
        "cdr",
    );
    let mut random = 0x2545_f491_4f6c_dd1du64;
    let mut next = || {
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        random
    };
    for _ in 0..400 {
        let (mut a, mut b) = (good.clone(), unchecked.clone());
        let at = next() as usize % a.len();
        a[at] ^= 1 << (next() % 8);
        if let Ok((back, _)) = read(&a, &RecordOptions::default()) {
            assert!(back.iter().all(|f| frames.iter().any(|g| f.scan.points == g.scan.points)), "byte {at}");
        }
        for _ in 0..3 {
            let at = next() as usize % b.len();
            b[at] = next() as u8;
        }
        let _ = read(&b, &RecordOptions::default());
        let mut noise = b"\x89MCAP0\r\n".to_vec();
        noise.extend((0..200).map(|_| next() as u8 % 16));
        let _ = read(&noise, &RecordOptions::default());
    }
}

#[test]
fn sizes_beyond_the_limit_are_refused_and_named() {
    let bytes = written(&frames(3));
    let small = RecordOptions { chunk_bytes_max: 1_000, ..Default::default() };
    let error = read(&bytes, &small).unwrap_err().to_string();
    assert!(error.contains("the limit is 1000"), "{error}");
    let few = RecordOptions { scan_points_max: 100, ..Default::default() };
    let (back, errors) = read(&bytes, &few).unwrap();
    assert!(back.is_empty());
    assert!(errors[0].to_string().contains("message 1 of /robot7/points"), "{}", errors[0]);
    assert!(errors[0].to_string().contains("is 200, the limit is 100"), "{}", errors[0]);
}

#[test]
fn other_files_are_refused_with_what_was_expected() {
    let folder = Folder::new();
    let path = folder.join("a.mcap");
    std::fs::write(&path, b"#ROSBAG V2.0\n").unwrap();
    let error = open_record(&path, &RecordOptions::default()).unwrap_err();
    assert!(error.to_string().contains("expected an MCAP file"), "{error}");
    assert_eq!(error.path, path);
    assert!(open_record(Path::new("no/such.mcap"), &RecordOptions::default()).is_err());
    let scan = Scan { stamp: Stamp(-1), ..Default::default() };
    let mut writer = RecordWriter::create(folder.join("b.mcap"), "r").unwrap();
    assert!(writer.write(&scan, &Pose::IDENTITY).unwrap_err().to_string().contains("ROS 2 counts"));
}

/// Little-endian CDR of an odometry or (with `tf`) of a transform message: header, child frame, pose.
fn pose_message(tf: bool, stamp: Stamp, parent: &str, child: &str, x: f64, yaw: f64) -> Vec<u8> {
    let mut body: Vec<u8> = Vec::new();
    let mut put = |align: usize, bytes: &[u8]| {
        body.resize(body.len().next_multiple_of(align), 0);
        body.extend_from_slice(bytes);
    };
    if tf {
        put(4, &1u32.to_le_bytes());
    }
    put(4, &((stamp.0 / 1_000_000) as i32).to_le_bytes());
    put(4, &((stamp.0 % 1_000_000) as u32 * 1_000).to_le_bytes());
    for name in [parent, child] {
        put(4, &(name.len() as u32 + 1).to_le_bytes());
        put(1, name.as_bytes());
        put(1, &[0]);
    }
    for v in [x, 0.0, 0.0, 0.0, 0.0, (yaw / 2.0).sin(), (yaw / 2.0).cos()] {
        put(8, &v.to_le_bytes());
    }
    [&[0, 1, 0, 0], body.as_slice()].concat()
}

const ODOMETRY: &str = "nav_msgs/msg/Odometry";
const TF: &str = "tf2_msgs/msg/TFMessage";

/// The scans of our own file with other poses beside them.
fn with_poses(frames: &[Frame], poses: Vec<(&str, &str, Vec<u8>)>) -> Vec<u8> {
    let mut messages = Messages::of(&written(frames));
    messages.0.retain(|(topic, ..)| topic.ends_with("/points"));
    let poses = poses.into_iter().map(|(topic, schema, data)| (topic.to_owned(), schema.to_owned(), data));
    messages.0.extend(poses);
    messages.write(WriteOptions::new(), "cdr")
}

#[test]
fn odometry_of_the_body_and_fixed_tf_of_the_sensor_are_chained_and_interpolated() {
    let frames = frames(4);
    let mut poses = vec![("/tf_static", TF, pose_message(true, Stamp(0), "body", "robot7/lidar", 0.5, 0.0))];
    // Body poses midway between the scans, at 2 m/s.
    for i in 0..5 {
        let stamp = Stamp(4_950_000 + i * 100_000);
        poses.push(("/odom", ODOMETRY, pose_message(false, stamp, "odom", "/body", i as f64 * 0.2, 0.0)));
    }
    let (back, errors) = read(&with_poses(&frames, poses), &RecordOptions::default()).unwrap();
    assert_eq!((back.len(), errors), (4, vec![]));
    for (i, frame) in back.iter().enumerate() {
        let x = frame.t_map_sensor.translation()[0];
        assert!((x - (0.1 + 0.2 * i as f64 + 0.5)).abs() < 1e-9, "{x}");
    }
}

#[test]
fn points_that_are_already_in_the_map_are_taken_back_to_the_sensor() {
    let frames = frames(2);
    let yaw = core::f64::consts::FRAC_PI_2;
    // The frame of the points is the parent of the odometry.
    let poses = frames
        .iter()
        .map(|f| ("/odom", ODOMETRY, pose_message(false, f.scan.stamp, "robot7/lidar", "body", 10.0, yaw)))
        .collect();
    let (back, errors) = read(&with_poses(&frames, poses), &RecordOptions::default()).unwrap();
    assert_eq!(errors, []);
    for (frame, original) in back.iter().zip(&frames) {
        for (p, q) in frame.scan.points.iter().zip(&original.scan.points) {
            let in_map = frame.t_map_sensor.transform(p.map(f64::from));
            assert!(in_map.iter().zip(q).all(|(a, b)| (a - f64::from(*b)).abs() < 1e-4), "{in_map:?} {q:?}");
        }
    }
}

#[test]
fn a_pose_that_is_none_costs_only_itself() {
    let frames = frames(3);
    let poses = frames
        .iter()
        .enumerate()
        .map(|(i, f)| {
            let x = if i == 1 { f64::NAN } else { 1.0 };
            ("/odom", ODOMETRY, pose_message(false, f.scan.stamp, "odom", "robot7/lidar", x, 0.0))
        })
        .collect();
    let (back, errors) = read(&with_poses(&frames, poses), &RecordOptions::default()).unwrap();
    assert_eq!(back.len(), 3, "the pose in between is interpolated");
    assert!(errors[0].to_string().contains("message 2 of /odom, byte "), "{}", errors[0]);
}
