//! Recorded and published files are read in full. Skips where there is no data: set `FLOCKMAP_DATA`.

use std::path::PathBuf;

use flockmap_grid::State;
use flockmap_io::{Content, OctoMap, RecordOptions, describe, open_record, read_cloud};

fn data(name: &str) -> Option<PathBuf> {
    let default = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data");
    let folder = std::env::var_os("FLOCKMAP_DATA").map_or_else(|| PathBuf::from(default), PathBuf::from);
    let path = folder.join(name);
    if !path.exists() {
        println!("skipped: no data in {}", folder.display());
        return None;
    }
    Some(path)
}

struct Expected {
    frames: u64,
    duration_s: f64,
    path_m: f64,
    points: u64,
}

fn check_record(name: &str, expected: &Expected) {
    let Some(path) = data(name) else { return };
    let record = open_record(&path, &RecordOptions::default()).unwrap();
    println!("{name}: {:?}", record.summary);
    assert_eq!(record.summary.frames, expected.frames);
    assert_eq!(record.summary.scans_without_pose, 0);
    assert!(record.summary.damages.is_empty());
    assert!(
        (record.summary.duration_s() - expected.duration_s).abs() < 0.01,
        "{}",
        record.summary.duration_s()
    );
    assert!((record.summary.path_m - expected.path_m).abs() < 0.01, "{}", record.summary.path_m);
    let (mut frames, mut points, mut last) = (0, 0, None);
    for frame in record.frames {
        let frame = frame.unwrap();
        assert!(last < Some(frame.scan.stamp), "stamps out of order");
        last = Some(frame.scan.stamp);
        frames += 1;
        points += frame.scan.points.len() as u64;
    }
    assert_eq!((frames, points), (expected.frames, expected.points));
}

#[test]
fn a_walk_with_a_livox_is_read_as_two_robots() {
    check_record("hku_mb/robot1.mcap", &HKU1);
    check_record("hku_mb/robot2.mcap", &HKU2);
}

#[test]
fn a_drive_with_an_ouster_is_read_from_a_folder() {
    check_record("kaist03", &KAIST03);
}

#[test]
fn files_of_other_writers_are_read_or_refused_with_a_reason() {
    for name in ["pointcloud2_zstd", "pointcloud2_lz4"] {
        let Some(path) = data(&format!("mcap_reader/{name}.mcap")) else { return };
        let record = open_record(path, &RecordOptions::default()).unwrap();
        assert_eq!(record.summary.frames, 20);
        assert_eq!(record.frames.map(|f| f.unwrap().scan.points.len().min(1)).sum::<usize>(), 20);
    }
    for (name, found) in [
        ("cdr_test_0", "/test_topic (test_msgs/msg/BasicTypes, encoding cdr)"),
        ("talker", "/topic (std_msgs/msg/String, encoding cdr)"),
        ("test_bag_for_seek_0", "topic1 (test_msgs/BasicTypes, encoding cdr)"),
        ("topics_and_services", "/parameter_events"),
        ("wrong_rmw_test_0", "/test_topic (test_msgs/msg/BasicTypes, encoding wrong_format)"),
    ] {
        let Some(path) = data(&format!("mcap_reader/{name}.mcap")) else { return };
        let error = open_record(&path, &RecordOptions::default()).unwrap_err().to_string();
        println!("{error}");
        assert!(error.contains(name) && error.contains("expected a topic with sensor_msgs/msg/PointCloud2"));
        assert!(error.contains(found), "{error}");
        let Content::Mcap { topics, record, .. } = describe(&path).unwrap().content else { panic!("{name}") };
        assert!(!topics.is_empty() && record.is_err());
    }
}

#[test]
fn buildings_are_read_as_octomap_reads_them() {
    for (name, free, occupied, leaves) in BUILDINGS {
        let Some(path) = data(&format!("buildings/{name}.bt")) else { return };
        let map = OctoMap::read(&path).unwrap();
        println!("{}", describe(&path).unwrap());
        assert_eq!(
            (map.voxel_count(State::Free), map.voxel_count(State::Occupied), map.cubes().len()),
            (free, occupied, leaves),
            "{name}"
        );
    }
}

#[test]
fn published_clouds_are_read_in_full() {
    for (name, points, size) in CLOUDS {
        let Some(path) = data(name) else { return };
        let cloud = read_cloud(&path).unwrap();
        println!("{}", describe(&path).unwrap());
        let [low, high] = cloud.bounds().unwrap();
        assert_eq!(cloud.points.len(), points, "{name}");
        for axis in 0..3 {
            assert!((high[axis] - low[axis] - size[axis]).abs() < 0.06, "{name}: {low:?} {high:?}");
        }
    }
}

const HKU1: Expected = Expected { frames: 230, duration_s: 121.700, path_m: 49.169, points: 1_136_838 };
const HKU2: Expected = Expected { frames: 229, duration_s: 137.900, path_m: 46.113, points: 1_166_507 };
const KAIST03: Expected = Expected { frames: 21, duration_s: 11.305, path_m: 23.582, points: 765_919 };

/// Free and occupied voxels of the finest size, and leaves, as counted by OctoMap's own library.
const BUILDINGS: [(&str, u64, u64, usize); 3] = [
    ("fr_079", 4_807_673, 401_373, 1_476_170),
    ("fr_078_tidyup", 2_610_011, 287_664, 1_163_901),
    ("geb079", 950_759, 185_673, 428_144),
];

const CLOUDS: [(&str, usize, [f64; 3]); 5] = [
    ("worlds/cubicle_office.pcd", 299_236, [31.0, 31.0, 2.4]),
    ("worlds/octa_maze.pcd", 305_236, [35.0, 35.0, 2.4]),
    ("worlds/pillar.pcd", 144_640, [14.5, 27.4, 3.9]),
    ("forest_plot/TLS_Clip.laz", 400_754, [23.875, 29.061, 35.844]),
    ("forest_plot/MLS_Clip.laz", 301_477, [27.109, 25.830, 34.278]),
];
