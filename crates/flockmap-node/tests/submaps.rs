//! A node plays a record with submaps, and records its own.

mod common;

use std::path::Path;
use std::time::Duration;

use common::{config, corridor, new_dir, swarm};
use flockmap::{Pose, Robot, Stamp, SubmapId};
use flockmap_io::{RecordOptions, RecordWriter, open_record};
use flockmap_node::{EndOptions, FlightOptions, Log, Node, NodeOptions, Recording, Sensor};

const SCANS: usize = 12;

fn at(x: f64) -> Pose {
    Pose::from_translation([x, 0.0, 0.0])
}

/// A second submap begins with scan 4, is moved with scan 8, and the first one behind the last scan.
fn write(path: &Path) {
    let mut writer = RecordWriter::create(path, "slam").unwrap();
    for (number, frame) in corridor(1, SCANS).enumerate() {
        let stamp = frame.scan.stamp;
        match number {
            0 => writer.write_submaps(stamp, &[at(0.0)]).unwrap(),
            4 => writer.write_submaps(stamp, &[at(0.0), at(0.0)]).unwrap(),
            8 => writer.write_submaps(stamp, &[at(0.0), at(0.5)]).unwrap(),
            _ => {}
        }
        writer.write(&frame.scan, &frame.t_map_sensor).unwrap();
    }
    writer.write_submaps(Stamp(9_000_000), &[at(0.25), at(0.5)]).unwrap();
    writer.finish().unwrap();
}

/// The robot of a node that has played it, but for so much of its beginning.
fn played(path: &Path, skip: Duration, record: Option<Recording>) -> Robot {
    let options = RecordOptions { submaps_topic: Some("/slam/submaps".into()), ..RecordOptions::default() };
    let read = open_record(path, &options).unwrap();
    let (frames, submaps) = (read.frames, read.submaps);
    let sensor = Sensor::Play { frames, submaps, speed: 4.0, skip, begin: None };
    let end = EndOptions { when_quiet: Some(Duration::from_millis(200)), ..EndOptions::default() };
    let options = NodeOptions { sensor, record, end, log: Log::silent(), ..NodeOptions::new(config(1)) };
    let sockets = swarm(1).remove(0);
    Node::start(options, move || sockets.into_transport()).unwrap().join().unwrap().robot
}

#[test]
fn a_node_that_plays_a_record_has_its_submaps_and_records_them_itself() {
    let folder = new_dir("submaps");
    let (path, flight) = (folder.join("slam.mcap"), folder.join("flight.mcap"));
    write(&path);
    let options = FlightOptions { scans: true, ..FlightOptions::default() };
    let robot = played(&path, Duration::ZERO, Some(Recording { path: flight.clone(), options }));
    let poses = |robot: &Robot| {
        let submaps = (0..=robot.submap().number()).filter_map(SubmapId::new);
        submaps.map(|submap| robot.submap_pose(submap)).collect::<Vec<_>>()
    };
    assert_eq!(poses(&robot), [at(0.25), at(0.5)]);

    let topic = Some("/robot1/submaps".into());
    let read = open_record(&flight, &RecordOptions { submaps_topic: topic, ..RecordOptions::default() });
    let read = read.unwrap();
    let said: Vec<_> = read.submaps.iter().map(|pose| (pose.submap.number(), pose.t_map_submap)).collect();
    assert_eq!(said, [(0, at(0.0)), (1, at(0.0)), (1, at(0.5)), (0, at(0.25))]);
    let with_scan = |number: usize| {
        let stamp = read.poses[number].0;
        read.submaps.iter().filter(|pose| pose.stamp == stamp).count()
    };
    assert_eq!((with_scan(4), with_scan(8)), (2, 1), "before the scan that was taken in so");
    assert!(read.submaps.iter().last().unwrap().stamp > read.poses[SCANS - 1].0);

    let robot = played(&path, Duration::from_millis(600), None);
    assert_eq!(poses(&robot), [at(0.5)], "the submap that is open where it begins is its first");
}
