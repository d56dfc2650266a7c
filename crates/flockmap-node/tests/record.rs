//! A node records its flight while it flies.

mod common;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use common::{Shared, config, corridor, frames, new_dir, swarm, wait_until};
use flockmap::{State, Voxel};
use flockmap_feed::{Event, Mirror, MirrorOptions};
use flockmap_io::{RecordOptions, open_flight, open_record};
use flockmap_node::{
    FlightOptions, Level, Log, Node, NodeHandle, NodeOptions, Recording, Sensor, StartError, UdpSockets,
};

const SCANS: usize = 30;

/// Two robots of which the first records its flight, and what it logs as a warning or an error.
fn start(path: PathBuf, options: FlightOptions) -> (Vec<NodeHandle>, Shared<Vec<String>>) {
    let lines = Shared::<Vec<String>>::default();
    let mut record = Some(Recording { path, options });
    let start = |(k, sockets): (usize, UdpSockets)| {
        let id = k as u16 + 1;
        let sensor = Sensor::play(frames(corridor(id, SCANS)), 4.0);
        let said = Arc::clone(&lines);
        let log = Log::new(move |level, text| {
            if id == 1 && matches!(level, Level::Warning | Level::Error) {
                said.lock().unwrap().push(text.to_owned());
            }
        });
        let options = NodeOptions { sensor, record: record.take(), log, ..NodeOptions::new(config(id)) };
        Node::start(options, move || sockets.into_transport()).unwrap()
    };
    let nodes = swarm(2).into_iter().enumerate().map(start).collect();
    (nodes, lines)
}

/// Waits for the end of both, and gives what the first one saw last.
fn end(nodes: Vec<NodeHandle>) -> (BTreeMap<Voxel, State>, flockmap_node::NodeStatus) {
    wait_until("all has been seen and heard", || {
        nodes.iter().all(|node| {
            let status = node.status().unwrap();
            status.sensor_ended && status.streams.len() == 2 && status.packages().1 == 0
        })
    });
    nodes.iter().for_each(NodeHandle::stop);
    let mut ended: Vec<_> = nodes.into_iter().map(|node| node.join().unwrap()).collect();
    let first = ended.remove(0);
    (first.robot.map().voxels().collect(), first.status)
}

/// What a mirror makes of the frames of a record, which must be whole.
fn played(path: &Path, options: MirrorOptions) -> Mirror {
    let mut mirror = Mirror::new(options);
    for frame in open_flight(path).unwrap() {
        let frame = frame.unwrap();
        assert_eq!(&*frame.topic, "/robot1/feed");
        assert!(!matches!(mirror.push(&mut &frame.bytes[..]), Ok(Some(Event::Unknown(_)))));
    }
    mirror
}

#[test]
fn a_flight_that_was_recorded_plays_back_to_the_map_of_the_node() {
    let folder = new_dir("record");
    let path = folder.join("flight.mcap");
    let options = FlightOptions { scans: true, origins: true, ..FlightOptions::default() };
    let (nodes, lines) = start(path.clone(), options);
    let (map, status) = end(nodes);

    let mirror = played(&path, MirrorOptions { origins: true, ..MirrorOptions::default() });
    assert!(mirror.end().is_some() && mirror.is_complete());
    assert_eq!(mirror.map().unwrap().voxels().collect::<BTreeMap<_, _>>(), map);
    assert!(map.keys().all(|voxel| mirror.origin(*voxel).is_some()), "who saw what");
    assert_eq!(mirror.robots().len(), 2);
    assert!(mirror.scan().is_some() && !mirror.counts().counters.is_empty());

    // The scans are a record.
    let record = open_record(&path, &RecordOptions::default()).unwrap();
    let read: Vec<_> = record.frames.collect::<Result<_, _>>().unwrap();
    let flown: Vec<_> = corridor(1, SCANS).collect();
    assert_eq!(read.len(), SCANS);
    for (read, flown) in read.iter().zip(&flown) {
        assert_eq!((&read.scan.points, &read.t_map_sensor), (&flown.scan.points, &flown.t_map_sensor));
    }
    let counters = status.node;
    assert_eq!((counters.record_scans_left_out, counters.record_stopped), (0, 0));
    assert_eq!(counters.record_bytes, std::fs::metadata(&path).unwrap().len());
    assert!(lines.lock().unwrap().iter().all(|line| !line.contains("record")), "{lines:?}");
}

#[test]
fn a_record_that_is_full_ends_with_one_warning_and_the_robot_flies_on() {
    let folder = new_dir("record-full");
    let path = folder.join("flight.mcap");
    let options = FlightOptions { scans: true, bytes_max: 100_000, ..FlightOptions::default() };
    let (nodes, lines) = start(path.clone(), options);
    let (map, status) = end(nodes);
    let counters = status.node;
    assert_eq!((counters.record_stopped, counters.frames), (1, SCANS as u64));
    assert!(counters.record_scans_left_out > 0 && !map.is_empty());
    let said = lines.lock().unwrap();
    let of_record: Vec<_> = said.iter().filter(|line| line.contains("record")).collect();
    assert!(matches!(of_record[..], [line] if line.contains("100000 bytes")), "{said:?}");
    assert!(std::fs::metadata(&path).unwrap().len() <= 100_000);
    assert!(open_flight(&path).unwrap().all(|frame| frame.is_ok()), "it is whole");
}

#[test]
fn a_record_that_cannot_be_made_stops_the_start() {
    let path = new_dir("record-nowhere").join("no such folder/flight.mcap");
    let record = Some(Recording { path, options: FlightOptions::default() });
    let options = NodeOptions { record, ..NodeOptions::new(config(1)) };
    let sockets = swarm(1).remove(0);
    let error = Node::start(options, move || sockets.into_transport()).unwrap_err();
    assert!(matches!(error, StartError::System { .. }));
    let text = error.to_string();
    assert!(text.starts_with("cannot record the flight: ") && text.contains("flight.mcap"), "{text}");
}

#[test]
fn a_start_that_fails_behind_the_record_ends_it() {
    let path = new_dir("record-start").join("flight.mcap");
    let record = Some(Recording { path: path.clone(), options: FlightOptions::default() });
    let sensor = Sensor::play(frames(corridor(1, 1)), 0.0);
    let options = NodeOptions { record, sensor, ..NodeOptions::new(config(1)) };
    let sockets = swarm(1).remove(0);
    let error = Node::start(options, move || sockets.into_transport()).unwrap_err();
    assert!(matches!(error, StartError::Option(_)), "{error}");
    assert!(open_flight(&path).unwrap().all(|frame| frame.is_ok()), "it is whole");
}
