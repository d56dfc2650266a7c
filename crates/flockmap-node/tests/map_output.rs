//! Planners of other processes read the fused map of a node, over real sockets.
#![cfg(unix)]

mod common;

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

use common::{PATIENCE, config, corridor, frames, loopback, new_dir, swarm, wait_until};
use flockmap::{MapView, Pose, RobotId, Stamp, State, SubmapId, Voxel};
use flockmap_feed::{Address, Client, ClientError, Event, Mirror, MirrorOptions, ReaderHello};
use flockmap_node::{
    MapOutput, MessageLimits, Node, NodeHandle, NodeOptions, Sensor, SensorMessage, UdpSockets,
};

fn output(folder: &Path) -> MapOutput {
    let unix = Some((folder.join("map.sock"), 0o600));
    MapOutput { unix, tcp: Some(loopback()), ..MapOutput::default() }
}

/// Robots of which the first gives its map out.
fn start(robots: usize, scans: usize, output: MapOutput) -> Vec<NodeHandle> {
    let mut output = Some(output);
    let start = |(k, sockets): (usize, UdpSockets)| {
        let id = k as u16 + 1;
        let frames = frames(corridor(id, scans));
        let sensor = Sensor::play(frames, 4.0);
        let options = NodeOptions { sensor, map_output: output.take(), ..NodeOptions::new(config(id)) };
        Node::start(options, move || sockets.into_transport()).unwrap()
    };
    swarm(robots).into_iter().enumerate().map(start).collect()
}

/// A client of the socket whose address begins so, or of TCP.
fn client(node: &NodeHandle, is_unix: bool, options: MirrorOptions) -> Client {
    let mut addresses = node.map_addresses().iter();
    let address = addresses.find(|address| address.starts_with("unix:") == is_unix).unwrap();
    Client::new(address.parse::<Address>().unwrap(), Mirror::new(options))
}

fn plain(node: &NodeHandle) -> Client {
    client(node, true, MirrorOptions::default())
}

fn tcp(node: &NodeHandle) -> TcpStream {
    let address = node.map_addresses().iter().find(|address| !address.starts_with("unix:")).unwrap();
    let stream = TcpStream::connect(address.as_str()).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream
}

fn voxels(map: &MapView) -> BTreeMap<Voxel, State> {
    map.voxels().collect()
}

/// Reads until the mirror is complete and has this map.
fn follow_until_equal(client: &mut Client, expected: &BTreeMap<Voxel, State>) {
    wait_until("the mirror has the map", || {
        client.next(Duration::from_millis(20)).unwrap();
        client.mirror().is_complete() && client.mirror().map().is_some_and(|map| voxels(map) == *expected)
    });
}

fn next_event(client: &mut Client, wanted: Event) {
    wait_until("it comes", || client.next(Duration::from_millis(20)).unwrap() == Some(wanted));
}

/// Waits until nothing is left to map or to hear.
fn final_map(nodes: &[NodeHandle]) -> BTreeMap<Voxel, State> {
    wait_until("all has been seen and heard", || {
        nodes.iter().all(|node| {
            let status = node.status().unwrap();
            status.sensor_ended && status.streams.len() == nodes.len() && status.packages().1 == 0
        }) && {
            let layers = |node: &NodeHandle| {
                let read = |robot: &mut flockmap::Robot| {
                    robot
                        .fusion()
                        .layers()
                        .map(|(stream, layer)| (stream, layer.digest()))
                        .collect::<Vec<_>>()
                };
                node.with_robot(move |robot, _| read(robot)).unwrap()
            };
            nodes.iter().all(|node| layers(node) == layers(&nodes[0]))
        }
    });
    voxels(&nodes[0].with_robot(|robot, _| robot.view()).unwrap())
}

#[test]
fn readers_that_are_fast_slow_or_killed_and_back_end_with_the_map() {
    let folder = new_dir("map-readers");
    let nodes = start(2, 30, output(&folder));
    let mut fast = client(&nodes[0], true, MirrorOptions { origins: true, ..MirrorOptions::default() });
    let mut slow = client(&nodes[0], false, MirrorOptions::default()).at_most(100_000);
    let mut back = plain(&nodes[0]);
    for client in [&mut fast, &mut slow, &mut back] {
        next_event(client, Event::Hello);
    }
    // One that says hello and never reads is there all the time.
    let mut deaf = tcp(&nodes[0]);
    deaf.write_all(&ReaderHello::default().emit()).unwrap();
    while fast.mirror().map().is_none_or(|map| map.block_count() < 20) {
        fast.next(Duration::from_millis(20)).unwrap();
        back.next(Duration::from_millis(1)).unwrap();
    }
    let had = back.mirror().have().unwrap();
    back.disconnect();
    let expected = final_map(&nodes);
    follow_until_equal(&mut fast, &expected);
    next_event(&mut back, Event::Hello);
    assert!(back.mirror().node().unwrap().goes_on, "{had:?}");
    follow_until_equal(&mut back, &expected);
    follow_until_equal(&mut slow, &expected);

    // Who saw each voxel last is what the node says.
    let mirrored: Vec<Voxel> = expected.keys().copied().collect();
    let seen: BTreeMap<Voxel, _> =
        mirrored.iter().filter_map(|voxel| Some((*voxel, fast.mirror().origin(*voxel)?))).collect();
    let by_node = nodes[0]
        .with_robot(|robot, _| {
            let blocks: Vec<_> = robot.map().blocks().map(|(index, _)| index).collect();
            let mut seen = BTreeMap::new();
            for index in blocks {
                for (id, plane) in robot.fusion().origins(robot.mapper(), index) {
                    seen.extend(flockmap::grid::set_bits(&plane).map(|bit| (index.voxel(bit), id)));
                }
            }
            seen
        })
        .unwrap();
    assert_eq!(seen.len(), by_node.len());
    // A clock offset that was measured since counts already, where both saw a voxel at about the same time.
    let equal = seen.iter().filter(|(voxel, id)| by_node[voxel] == **id).count();
    assert!(equal * 10 >= seen.len() * 9, "{equal} of {}", seen.len());
    assert!([1, 2].iter().all(|id| by_node.values().any(|seen| seen.0 == *id)), "both robots saw something");

    // Poses of both robots, and counters; what came while the map was not complete is older.
    wait_until("poses of both and the newest counters come", || {
        fast.next(Duration::from_millis(20)).unwrap();
        let counters = &fast.mirror().counts().counters;
        let is_newest = counters.iter().any(|(name, value)| name == "node_frames" && *value == 30);
        is_newest && fast.mirror().robots().len() == 2
    });
    let [own, other] = fast.mirror().robots() else { unreachable!() };
    assert!((own.position[0] - (3.0 + 0.1 * 29.0)).abs() < 1e-9 && own.orientation.is_some(), "{own:?}");
    // To a sixteenth of a voxel, at the batch that was closed last.
    assert!((6.0..=8.95).contains(&other.position[0]) && other.orientation.is_none(), "{other:?}");
    assert_eq!(nodes[0].status().unwrap().map_readers, 4);
    assert!(nodes[0].status().unwrap().node.map_bytes_out > fast.bytes_in());
    drop(deaf);
    wait_until("who went counts no more", || nodes[0].status().unwrap().map_readers == 3);

    // The end of the node is the end of the feed, and nothing is left behind.
    nodes[0].stop();
    wait_until("the end is said", || match fast.next(Duration::from_millis(20)) {
        Err(ClientError::Ended(reason)) => reason.contains("ends"),
        Err(error) => panic!("{error}"),
        Ok(_) => false,
    });
    for node in nodes {
        node.stop();
        node.join().unwrap();
    }
    assert!(!folder.join("map.sock").exists());
    assert_eq!(voxels(fast.mirror().map().unwrap()), expected);
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn a_node_that_starts_again_has_another_feed_and_the_mirror_keeps_up() {
    let folder = new_dir("map-restart");
    let first = start(1, 10, output(&folder));
    let mut mirror = plain(&first[0]);
    let expected = final_map(&first);
    follow_until_equal(&mut mirror, &expected);
    let feed = mirror.mirror().node().unwrap().feed;
    for node in first {
        node.stop();
        node.join().unwrap();
    }
    let second = start(1, 25, output(&folder));
    let expected = final_map(&second);
    let version = mirror.mirror().map().unwrap().version();
    wait_until("the mirror has the other map", || {
        // Until the other node is there, it cannot be reached.
        let _ = mirror.next(Duration::from_millis(20));
        let has_other = mirror.mirror().node().is_some_and(|node| node.feed != feed);
        has_other && mirror.mirror().is_complete() && voxels(mirror.mirror().map().unwrap()) == expected
    });
    assert!(mirror.mirror().map().unwrap().version() > version);
    drop(second);
    std::fs::remove_dir_all(folder).unwrap();
}

/// What is read until the connection ends, as text where it is some.
fn rest_of(stream: &mut TcpStream) -> String {
    let mut bytes = Vec::new();
    // A connection may also end with a reset.
    let _ = stream.read_to_end(&mut bytes);
    String::from_utf8_lossy(&bytes).into_owned()
}

#[test]
fn garbage_and_talkers_are_closed_and_counted_and_disturb_nobody() {
    let folder = new_dir("map-garbage");
    let nodes = start(1, 10, output(&folder));
    let counts = || nodes[0].status().unwrap().node;
    let mut http = tcp(&nodes[0]);
    http.write_all(b"GET / HTTP/1.1\r\n\r\n").unwrap();
    assert!(rest_of(&mut http).contains("this is no feed"));
    wait_until("it is counted", || counts().map_readers_closed == 1);
    let mut damaged = tcp(&nodes[0]);
    let mut hello = ReaderHello::default().emit();
    hello[6] = b'X';
    damaged.write_all(&hello).unwrap();
    assert!(rest_of(&mut damaged).contains("magic"));
    let mut later = tcp(&nodes[0]);
    let mut hello = ReaderHello::default().emit();
    hello[9] = 9;
    later.write_all(&hello).unwrap();
    assert!(rest_of(&mut later).contains("version 9"));
    let mut talker = tcp(&nodes[0]);
    talker.write_all(&ReaderHello::default().emit()).unwrap();
    talker.write_all(b"and more").unwrap();
    rest_of(&mut talker);
    wait_until("all are counted", || counts().map_readers_closed == 4);
    // Half a hello, and gone.
    tcp(&nodes[0]).write_all(&[1, 2]).unwrap();
    let expected = final_map(&nodes);
    follow_until_equal(&mut plain(&nodes[0]), &expected);
    drop(nodes);
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn a_reader_too_many_is_told_and_comes_in_when_there_is_a_place() {
    let folder = new_dir("map-places");
    let nodes = start(1, 5, MapOutput { readers_max: 2, ..output(&folder) });
    let mut there: Vec<Client> = (0..2).map(|_| plain(&nodes[0])).collect();
    there.iter_mut().for_each(|client| next_event(client, Event::Hello));
    let mut late = plain(&nodes[0]);
    let refused = loop {
        match late.next(PATIENCE) {
            Ok(_) => {}
            Err(error) => break error.to_string(),
        }
    };
    assert!(refused.contains("2 readers are there") && refused.contains("readers_max"), "{refused}");
    assert!(nodes[0].status().unwrap().node.map_readers_refused >= 1);
    there.clear();
    wait_until("there is a place", || matches!(late.next(Duration::from_millis(20)), Ok(Some(Event::Hello))));
    drop(late);

    // Who says nothing keeps nobody out.
    let silent: Vec<TcpStream> = (0..5).map(|_| tcp(&nodes[0])).collect();
    let expected = final_map(&nodes);
    let mut reader = plain(&nodes[0]);
    wait_until("it comes in", || matches!(reader.next(Duration::from_millis(20)), Ok(Some(Event::Hello))));
    follow_until_equal(&mut reader, &expected);
    drop(silent);
    drop(nodes);
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn a_socket_that_cannot_be_opened_is_named_and_nothing_is_left_running() {
    let folder = new_dir("map-taken");
    let first = start(1, 1, output(&folder));
    let options = NodeOptions { map_output: Some(output(&folder)), ..NodeOptions::new(config(2)) };
    let sockets = swarm(1).remove(0);
    let error = Node::start(options, move || sockets.into_transport()).unwrap_err().to_string();
    assert!(error.contains("map.sock") && error.contains("[map_output] listen_unix"), "{error}");
    drop(first);
    let missing = PathBuf::from("/nowhere/map.sock");
    let map_output = Some(MapOutput { unix: Some((missing, 0o600)), ..MapOutput::default() });
    let options = NodeOptions { map_output, ..NodeOptions::new(config(2)) };
    let sockets = swarm(1).remove(0);
    let error = Node::start(options, move || sockets.into_transport()).unwrap_err().to_string();
    assert!(error.contains("mkdir -p"), "{error}");
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn readers_are_told_how_submaps_lie_when_a_loop_is_closed_those_of_a_team_mate_too() {
    let start = |(k, sockets): (usize, UdpSockets)| {
        let sensor = Sensor::Tcp(loopback(), MessageLimits::default());
        let map_output = Some(MapOutput { tcp: Some(loopback()), ..MapOutput::default() });
        let options = NodeOptions { sensor, map_output, ..NodeOptions::new(config(k as u16 + 1)) };
        Node::start(options, move || sockets.into_transport()).unwrap()
    };
    let nodes: Vec<NodeHandle> = swarm(2).into_iter().enumerate().map(start).collect();
    let wanted = MirrorOptions { submaps: true, ..MirrorOptions::default() };
    let mut readers = [0, 1].map(|k| client(&nodes[k], false, wanted));
    let mut plain = client(&nodes[0], false, MirrorOptions::default());

    // Two submaps of robot 1.
    let mut stream = TcpStream::connect(nodes[0].sensor_address().unwrap()).unwrap();
    for (number, mut frame) in corridor(1, 10).enumerate() {
        if number == 5 {
            stream.write_all(&SensorMessage::BeginSubmap.emit()).unwrap();
        }
        frame.scan.stamp = Stamp(0);
        stream.write_all(&SensorMessage::Scan(frame).emit()).unwrap();
    }
    let second = SubmapId::new(1).unwrap();
    let lie = |client: &Client| {
        let runs = client.mirror().submaps();
        let run = runs.iter().find(|run| run.stream.origin == RobotId(1))?;
        Some([run.pose(SubmapId::FIRST)?, run.pose(second)?])
    };
    let mut until = |what: &str, reader: usize, expected: [Pose; 2]| {
        wait_until(what, || {
            readers[reader].next(Duration::from_millis(20)).unwrap();
            lie(&readers[reader]) == Some(expected)
        });
    };
    for reader in [0, 1] {
        until("the second one is there, and lies as the first does", reader, [Pose::IDENTITY; 2]);
    }

    // A loop is closed.
    let pose = Pose::from_yaw([0.0, 0.4, 0.0], 0.02);
    stream.write_all(&SensorMessage::SubmapPose(Some(1), pose).emit()).unwrap();
    wait_until("it is moved", || nodes[0].status().unwrap().robot.submap_poses == 1);
    let moved = nodes[0].with_robot(move |robot, _| robot.submap_pose(second)).unwrap();
    for reader in [0, 1] {
        until("the second one lies as it was said", reader, [Pose::IDENTITY, moved]);
    }

    // Robot 2 learns how the map of robot 1 lies in its own: its readers are told of the whole way.
    let alignment = Pose::from_yaw([10.0, 0.0, 0.0], 0.5);
    nodes[1].with_robot(move |robot, _| robot.set_alignment(RobotId(1), &alignment)).unwrap().unwrap();
    until("both lie by the alignment", 1, [alignment, alignment.compose(&moved)]);
    until("where nothing is aligned nothing has changed", 0, [Pose::IDENTITY, moved]);

    // Who does not ask is told nothing of it.
    let mut has_counters = false;
    wait_until("counters have come", || {
        let event = plain.next(Duration::from_millis(20)).unwrap();
        assert_ne!(event, Some(Event::Submaps));
        has_counters |= event == Some(Event::Counters);
        has_counters && plain.mirror().is_complete()
    });
    assert!(plain.mirror().submaps().is_empty());
}
