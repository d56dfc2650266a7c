//! Nodes in one process over real sockets on loopback.

mod common;

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use common::{PATIENCE, config, corridor, frames, loopback, swarm, wait_until};
use flockmap::{Cast, Event, Path, Resolution, RobotId, State, Stream, Transmit, Voxel, VoxelBox};
use flockmap_node::{
    Clock, EndOptions, Level, Log, MessageLimits, Node, NodeHandle, NodeOptions, Observation, OwnedStates,
    SendResult, Sensor, SensorMessage, StatesMessage, Transport, UdpOptions, UdpSockets, UdpTransport,
};

fn play(robot: u16, scans: usize) -> Sensor {
    Sensor::play(frames(corridor(robot, scans)), 4.0)
}

/// The digests of all layers that a node holds.
fn digests(node: &NodeHandle) -> Vec<(Stream, u64)> {
    let read = |robot: &mut flockmap::Robot| {
        let mut digests: Vec<_> = robot.fusion().layers().map(|(s, layer)| (s, layer.digest())).collect();
        digests.sort_unstable();
        digests
    };
    node.with_robot(move |robot, _| read(robot)).unwrap_or_default()
}

/// Waits until every sensor has ended and all nodes hold equal layers of `streams` streams.
fn wait_until_equal(nodes: &[NodeHandle], streams: usize) {
    wait_until("every sensor has ended", || {
        nodes.iter().all(|node| node.status().is_some_and(|status| status.sensor_ended))
    });
    wait_until("all nodes hold equal layers", || {
        let first = digests(&nodes[0]);
        first.len() == streams && nodes.iter().all(|node| digests(node) == first)
    });
}

#[test]
fn three_nodes_end_with_equal_layers() {
    let clock = Clock::new();
    let start = |(k, sockets): (usize, UdpSockets)| {
        let id = k as u16 + 1;
        let options = NodeOptions { clock, sensor: play(id, 20), ..NodeOptions::new(config(id)) };
        Node::start(options, move || sockets.into_transport()).unwrap()
    };
    let nodes: Vec<NodeHandle> = swarm(3).into_iter().enumerate().map(start).collect();
    wait_until_equal(&nodes, 3);
    let status = nodes[0].status().unwrap();
    assert_eq!((status.peers.len(), status.node.frames, status.robot.scans), (2, 20, 20));
    assert!(!status.timings.pack.is_empty() && !status.timings.receive_to_insert.is_empty());
    assert!(status.node.bytes_out > 0 && status.packages().1 == 0, "{status:?}");
    for node in &nodes {
        node.stop();
    }
    for node in nodes {
        let ended = node.join().unwrap();
        assert_eq!(ended.summary.streams.len(), 3);
        assert!(ended.summary.streams.iter().all(|s| s.missing == 0 && s.voxels > 1_000), "{ended:?}");
        // The own layer is what the mapper knows.
        let own = ended.robot.fusion().layer(ended.robot.own_stream()).unwrap();
        assert!(own.voxels().all(|(voxel, state)| ended.robot.mapper().state(voxel) == state));
        let json = serde_json::to_value(&ended.summary).unwrap();
        assert_eq!(json["streams"][0]["digest"].as_str().unwrap().len(), 16);
    }
}

/// Loses every third datagram that it should send.
struct Lossy(UdpTransport, u32);

impl Transport for Lossy {
    async fn receive(&mut self, buffer: &mut [u8]) -> std::io::Result<(usize, Path)> {
        self.0.receive(buffer).await
    }

    fn set_paths(&mut self, paths: &[Path]) {
        self.0.set_paths(paths);
    }

    async fn send(&mut self, transmit: &Transmit) -> SendResult {
        self.1 += 1;
        if self.1.is_multiple_of(3) {
            return SendResult { copies: 1, failed: 0 };
        }
        self.0.send(transmit).await
    }
}

#[test]
fn nodes_on_a_lossy_transport_end_with_equal_layers() {
    let start = |(k, sockets): (usize, UdpSockets)| {
        let id = k as u16 + 1;
        let options = NodeOptions { sensor: play(id, 15), ..NodeOptions::new(config(id)) };
        Node::start(options, move || Ok(Lossy(sockets.into_transport()?, id.into()))).unwrap()
    };
    let nodes: Vec<NodeHandle> = swarm(2).into_iter().enumerate().map(start).collect();
    wait_until_equal(&nodes, 2);
}

/// Loses the first so many datagrams with packages, which are longer than requests of two robots.
struct LosesPackages(UdpTransport, u32);

impl Transport for LosesPackages {
    async fn receive(&mut self, buffer: &mut [u8]) -> std::io::Result<(usize, Path)> {
        self.0.receive(buffer).await
    }

    fn set_paths(&mut self, paths: &[Path]) {
        self.0.set_paths(paths);
    }

    async fn send(&mut self, transmit: &Transmit) -> SendResult {
        if transmit.bytes.len() > 200 && self.1 > 0 {
            self.1 -= 1;
            return SendResult { copies: 1, failed: 0 };
        }
        self.0.send(transmit).await
    }
}

#[test]
fn a_node_that_lingers_ends_when_its_peers_have_all_that_it_published() {
    let mut sockets = swarm(2).into_iter();
    let mut next = || sockets.next().unwrap();
    let (one, two) = (next(), next());
    let mut options = NodeOptions { sensor: play(1, 20), ..NodeOptions::new(config(1)) };
    options.end.linger = PATIENCE;
    let one = Node::start(options, move || Ok(LosesPackages(one.into_transport()?, 10))).unwrap();
    let two = Node::start(NodeOptions::new(config(2)), move || two.into_transport()).unwrap();
    wait_until("they hear each other, and all is seen", || {
        [&one, &two].iter().all(|node| node.status().is_some_and(|status| status.peers.len() == 1))
            && one.status().is_some_and(|status| status.sensor_ended)
    });
    one.stop();
    let one = one.join().unwrap().robot;
    let own = one.fusion().layer(one.own_stream()).unwrap();
    assert!(own.voxels().count() > 1_000);
    let expected = (one.own_stream(), own.digest());
    wait_until("what was confirmed is merged", || digests(&two).contains(&expected));
}

#[test]
fn an_observer_sees_scans_and_what_others_sent() {
    let seen: common::Shared<(usize, usize, usize)> = Arc::default();
    let mut sockets = swarm(2).into_iter();
    let (first, second) = (sockets.next().unwrap(), sockets.next().unwrap());
    let in_node = Arc::clone(&seen);
    let mut options = NodeOptions { sensor: play(1, 10), ..NodeOptions::new(config(1)) };
    options.observer = Some(Box::new(move |now, robot, observation| {
        let mut seen = in_node.lock().unwrap();
        match observation {
            Observation::Scan { scan, report } => {
                assert!(!scan.points.is_empty() && scan.stamp <= now);
                assert!(report.hits > 0);
                seen.0 += 1;
            }
            Observation::Event(Event::BatchClosed { .. }) => seen.1 += 1,
            Observation::Event(Event::Merged { stream, .. }) => {
                assert!(robot.fusion().layer(*stream).is_some());
                seen.2 += 1;
            }
            _ => {}
        }
    }));
    let one = Node::start(options, move || first.into_transport()).unwrap();
    let options = NodeOptions { sensor: play(2, 10), ..NodeOptions::new(config(2)) };
    let two = Node::start(options, move || second.into_transport()).unwrap();
    wait_until_equal(&[one, two], 2);
    let (scans, batches, merged) = *seen.lock().unwrap();
    assert!(scans == 10 && batches > 0 && merged > 0, "{scans} {batches} {merged}");
}

#[test]
fn a_quiet_node_ends_by_itself_and_says_so_far() {
    let lines: common::Shared<Vec<(Level, String)>> = Arc::default();
    let in_log = Arc::clone(&lines);
    let mut options = NodeOptions { sensor: play(1, 5), ..NodeOptions::new(config(1)) };
    options.end.when_quiet = Some(Duration::from_millis(100));
    options.status_period = Some(Duration::from_millis(50));
    options.log = Log::new(move |level, text| in_log.lock().unwrap().push((level, text.to_owned())));
    let sockets = UdpSockets::bind(&UdpOptions::new(loopback())).unwrap();
    let ended = Node::start(options, move || sockets.into_transport()).unwrap().join().unwrap();
    assert_eq!(ended.summary.counters["robot"]["scans"], 5);
    let lines = lines.lock().unwrap();
    assert!(lines.iter().any(|(_, text)| text == "sensor ended after 5 scans"), "{lines:?}");
    assert!(
        lines.iter().any(|(level, text)| *level == Level::Status && text.contains("voxels")),
        "{lines:?}"
    );
}

#[test]
fn a_dropped_handle_stops_its_node() {
    let sockets = UdpSockets::bind(&UdpOptions::new(loopback())).unwrap();
    let address = sockets.local_addr().unwrap();
    let options = NodeOptions { prometheus: Some(loopback()), ..NodeOptions::new(config(1)) };
    drop(Node::start(options, move || sockets.into_transport()).unwrap());
    wait_until("the port is free", || std::net::UdpSocket::bind(address).is_ok());
}

#[test]
fn a_node_that_cannot_start_says_why() {
    let start = |options: NodeOptions| {
        let sockets = UdpSockets::bind(&UdpOptions::new(loopback())).unwrap();
        Node::start(options, move || sockets.into_transport()).unwrap_err().to_string()
    };
    let mut robot = config(1);
    robot.batch.publish_period_ms = 0;
    assert!(start(NodeOptions::new(robot)).contains("publish_period_ms is 0"));

    let sensor = Sensor::play(frames(corridor(1, 1)), 0.0);
    assert!(start(NodeOptions { sensor, ..NodeOptions::new(config(1)) }).contains("speed is 0"));

    let taken = std::net::TcpListener::bind(loopback()).unwrap();
    let address = taken.local_addr().unwrap();
    let sensor = Sensor::Tcp(address, MessageLimits::default());
    let text = start(NodeOptions { sensor, ..NodeOptions::new(config(1)) });
    assert!(text.contains("sensor socket") && text.contains(&address.port().to_string()), "{text}");
    assert!(text.contains("another port in [sensor] listen_tcp"), "{text}");
    let options = NodeOptions { prometheus: Some(address), ..NodeOptions::new(config(1)) };
    let text = start(options);
    assert!(text.contains("metrics") && text.contains("another port in [metrics] prometheus"), "{text}");
}

fn start_independent(options: NodeOptions) -> NodeHandle {
    let sockets = UdpSockets::bind(&UdpOptions::new(loopback())).unwrap();
    Node::start(options, move || sockets.into_transport()).unwrap()
}

#[test]
fn counters_are_served_to_prometheus() {
    let node = start_independent(NodeOptions { prometheus: Some(loopback()), ..NodeOptions::new(config(1)) });
    let address = node.prometheus_address().unwrap();
    let ask = |request: &str| {
        let mut stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        answer
    };
    let answer = ask("GET /metrics HTTP/1.1\r\nHost: x\r\n\r\n");
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    assert!(head.starts_with("HTTP/1.1 200 OK\r\n"), "{head}");
    assert!(head.contains("content-type: text/plain; version=0.0.4; charset=utf-8"), "{head}");
    assert!(head.contains(&format!("content-length: {}", body.len())), "{head}");
    assert!(body.contains("flockmap_peers{robot=\"robot1\"} 0\n"), "{body}");
    assert!(ask("GET / HTTP/1.1\r\n\r\n").starts_with("HTTP/1.1 404"));
    assert!(ask("POST /metrics HTTP/1.1\r\n\r\n").starts_with("HTTP/1.1 405"));
    assert!(ask("hello\r\n\r\n").starts_with("HTTP/1.1 400"));
    assert!(
        ask(&format!("GET /metrics HTTP/1.1\r\nX: {}\r\n\r\n", "x".repeat(9_000)))
            .starts_with("HTTP/1.1 431")
    );
    let head_only = ask("HEAD /metrics HTTP/1.1\r\n\r\n");
    assert!(head_only.starts_with("HTTP/1.1 200") && head_only.ends_with("\r\n\r\n"));
}

#[test]
fn idle_clients_delay_nobody_who_asks_for_counters() {
    let node = start_independent(NodeOptions { prometheus: Some(loopback()), ..NodeOptions::new(config(1)) });
    let address = node.prometheus_address().unwrap();
    // If each were waited for, even a few at a time, it would be far longer than the patience.
    let mut idle: Vec<TcpStream> = (0..100).map(|_| TcpStream::connect(address).unwrap()).collect();
    for client in &mut idle {
        // Some have begun to ask.
        client.write_all(b"GET /metr").unwrap();
    }
    let mut client = TcpStream::connect(address).unwrap();
    client.set_read_timeout(Some(PATIENCE)).unwrap();
    client.write_all(b"GET /metrics HTTP/1.1\r\n\r\n").unwrap();
    let mut answer = String::new();
    client.read_to_string(&mut answer).unwrap();
    assert!(answer.starts_with("HTTP/1.1 200 OK"), "{answer}");
}

#[test]
fn a_node_takes_stamped_scans_whatever_is_done_to_the_system_clock() {
    use std::sync::LazyLock;
    use std::sync::atomic::{AtomicI64, Ordering};
    use std::time::{Instant, SystemTime, UNIX_EPOCH};
    /// Where the system clock was put, and what it goes by.
    static SYSTEM_S: AtomicI64 = AtomicI64::new(1_800_000_000);
    static BEGAN: LazyLock<Instant> = LazyLock::new(Instant::now);
    fn system() -> SystemTime {
        UNIX_EPOCH + Duration::from_secs(SYSTEM_S.load(Ordering::Relaxed).unsigned_abs()) + BEGAN.elapsed()
    }

    let lines: common::Shared<Vec<String>> = Arc::default();
    let in_log = Arc::clone(&lines);
    let mut options = NodeOptions::new(config(1));
    let clock = Clock::with_system_time(system);
    options.clock = clock;
    options.sensor = Sensor::Tcp(loopback(), MessageLimits::default());
    options.log = Log::new(move |_, text| in_log.lock().unwrap().push(text.to_owned()));
    let node = start_independent(options);
    let mut stream = TcpStream::connect(node.sensor_address().unwrap()).unwrap();
    let mut steps = 0;
    // Forwards, back to 1970, and forwards again; the program knows nothing of it.
    for (round, to) in [0, 3_600, -1_800_000_000 + 60, 1_900_000_000].into_iter().enumerate() {
        SYSTEM_S.fetch_add(to, Ordering::Relaxed);
        for mut frame in corridor(0, 5) {
            frame.scan.stamp = clock.system_now();
            stream.write_all(&SensorMessage::Scan(frame).emit()).unwrap();
        }
        wait_until("the scans are mapped", || node.status().unwrap().robot.scans == 5 * (round as u64 + 1));
        steps += u64::from(to != 0);
        wait_until("the step is counted", || node.status().unwrap().node.clock_steps >= steps);
    }
    let status = node.status().unwrap();
    assert_eq!((status.node.sensor_faults, status.node.frames, status.node.clock_steps), (0, 20, 3));
    let lines = lines.lock().unwrap();
    let steps: Vec<&String> = lines.iter().filter(|l| l.contains("system clock was stepped by ")).collect();
    assert!(steps.len() == 3 && steps[0].contains("+3") && steps[1].contains("by -17999999"), "{lines:?}");
}

#[test]
fn any_program_can_feed_scans_over_tcp() {
    let sensor = Sensor::Tcp(loopback(), MessageLimits::default());
    let node = start_independent(NodeOptions { sensor, ..NodeOptions::new(config(1)) });
    let address: SocketAddr = node.sensor_address().unwrap().parse().unwrap();
    let mut stream = TcpStream::connect(address).unwrap();
    for mut frame in corridor(0, 5) {
        frame.scan.stamp = flockmap::Stamp(0);
        stream.write_all(&SensorMessage::Scan(frame).emit()).unwrap();
    }
    wait_until("the scans are mapped", || {
        node.with_robot(|robot, _| robot.map().state_at([0.1, 2.1, 1.1])) == Some(State::Occupied)
            && node.status().unwrap().robot.scans == 5
    });
    stream.write_all(b"this is not a scan").unwrap();
    wait_until("the fault is counted", || node.status().unwrap().node.sensor_faults == 1);
    assert_eq!(stream.read(&mut [0]).unwrap_or(0), 0, "the connection is closed");
}

#[test]
fn states_from_a_mapper_elsewhere_reach_a_team_mate_and_wrong_ones_are_named() {
    let lines: common::Shared<Vec<String>> = Arc::default();
    let in_log = Arc::clone(&lines);
    let seen: common::Shared<u32> = Arc::default();
    let in_node = Arc::clone(&seen);
    let mut sockets = swarm(2).into_iter();
    let (first, second) = (sockets.next().unwrap(), sockets.next().unwrap());
    let sensor = Sensor::Tcp(loopback(), MessageLimits::default());
    let mut options = NodeOptions { sensor, ..NodeOptions::new(config(1)) };
    options.log = Log::new(move |_, text| in_log.lock().unwrap().push(text.to_owned()));
    options.observer = Some(Box::new(move |_, _, observation| {
        if let Observation::States { report } = observation {
            *in_node.lock().unwrap() +=
                report.changed.iter().map(|(_, block)| block.known_count()).sum::<u32>();
        }
    }));
    let resolution = options.robot.mapper.resolution;
    let fed = Node::start(options, move || first.into_transport()).unwrap();
    let listens = Node::start(NodeOptions::new(config(2)), move || second.into_transport()).unwrap();

    let mut stream = TcpStream::connect(fed.sensor_address().unwrap()).unwrap();
    let (wall, behind) = (Voxel::new(20, 0, 0), Voxel::new(21, 0, 0));
    let voxels = OwnedStates::Voxels(vec![(Voxel::new(19, 0, 0), State::Free), (wall, State::Occupied)]);
    let region = VoxelBox::spanning(wall, behind).unwrap();
    let a_box = OwnedStates::Box { region, states: vec![State::Occupied; 2], clear_unknown: false };
    let mut say = |resolution, states| {
        let message = StatesMessage { stamp: flockmap::Stamp(0), resolution, sensor: Some([0.0; 3]), states };
        stream.write_all(&SensorMessage::States(message).emit()).unwrap();
    };
    say(Resolution::from_metres(0.37).unwrap(), voxels.clone());
    say(resolution, voxels);
    say(resolution, a_box);
    wait_until("the team-mate has it", || {
        listens.with_robot(move |robot, _| (robot.map().state(wall), robot.map().state(behind)))
            == Some((State::Occupied, State::Occupied))
    });
    let status = fed.status().unwrap();
    assert_eq!((status.node.states, status.robot.states, status.node.sensor_faults), (3, 2, 1));
    assert_eq!((status.timings.insert_states.len(), *seen.lock().unwrap()), (2, 3), "the wall is not new");
    let lines = lines.lock().unwrap();
    assert!(
        lines.iter().any(|line| line.contains("states left out: voxels of 0.37 m, expected")),
        "{lines:?}"
    );
}

#[test]
fn a_few_silent_programs_keep_no_sensor_out() {
    let sensor = Sensor::Tcp(loopback(), MessageLimits::default());
    let node = start_independent(NodeOptions { sensor, ..NodeOptions::new(config(1)) });
    let address = node.sensor_address().unwrap().to_owned();
    let _silent: Vec<TcpStream> = (0..6).map(|_| TcpStream::connect(&address).unwrap()).collect();
    let mut stream = TcpStream::connect(&address).unwrap();
    let mut frame = corridor(0, 1).next().unwrap();
    frame.scan.stamp = flockmap::Stamp(0);
    stream.write_all(&SensorMessage::Scan(frame).emit()).unwrap();
    wait_until("the scan is mapped", || node.status().unwrap().robot.scans == 1);
}

#[cfg(unix)]
#[test]
fn any_program_can_feed_scans_over_a_unix_socket() {
    let path = std::env::temp_dir().join(format!("flockmap-test-{}.sock", std::process::id()));
    // As a killed node leaves it.
    drop(std::os::unix::net::UnixListener::bind(&path).unwrap());
    let sensor = Sensor::Unix { path: path.clone(), mode: 0o600, limits: MessageLimits::default() };
    let node = start_independent(NodeOptions { sensor, ..NodeOptions::new(config(1)) });
    let mut stream = std::os::unix::net::UnixStream::connect(&path).unwrap();
    let mut frame = corridor(0, 1).next().unwrap();
    frame.scan.stamp = flockmap::Stamp(0);
    stream.write_all(&SensorMessage::Scan(frame).emit()).unwrap();
    wait_until("the scan is mapped", || node.status().unwrap().robot.scans == 1);
    node.stop();
    node.join().unwrap();
    assert!(!path.exists(), "the socket is removed at the end");
}

#[test]
fn the_python_example_feeds_a_node() {
    let sensor = Sensor::Tcp(loopback(), MessageLimits::default());
    let node = start_independent(NodeOptions { sensor, ..NodeOptions::new(config(1)) });
    let address: SocketAddr = node.sensor_address().unwrap().parse().unwrap();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/feed_sensor.py");
    let port = address.port().to_string();
    let result = std::process::Command::new("python3").args([script, "127.0.0.1", &port, "3"]).status();
    let Ok(status) = result else { return println!("skipped: no python3 here") };
    assert!(status.success());
    wait_until("the scans are mapped", || node.status().unwrap().robot.scans == 3);
    let state = |point| node.with_robot(move |robot, _| robot.map().state_at(point)).unwrap();
    assert_eq!(state([3.1, 0.1, 0.1]), State::Occupied);
    assert_eq!(state([1.1, 0.1, 0.1]), State::Free);
    assert_eq!(node.status().unwrap().node.sensor_faults, 0);
}

#[test]
fn the_python_in_the_documentation_is_the_one_that_is_tested() {
    let document = include_str!("../../../docs/sensor-input.md");
    let (_, code) = document.split_once("```python\n").unwrap();
    let (code, _) = code.split_once("```").unwrap();
    assert!(include_str!("../examples/feed_sensor.py").contains(code));
}

#[test]
fn frames_from_a_channel_are_mapped_and_the_end_of_it_ends_the_sensor() {
    let (send, receive) = tokio::sync::mpsc::channel(1);
    let options = NodeOptions {
        sensor: Sensor::Channel(receive),
        end: EndOptions { when_quiet: Some(Duration::ZERO), ..EndOptions::default() },
        ..NodeOptions::new(config(1))
    };
    let node = start_independent(options);
    for mut frame in corridor(1, 8) {
        frame.scan.stamp = node.clock().now();
        send.blocking_send(frame).unwrap();
    }
    drop(send);
    let ended = node.join().unwrap();
    assert_eq!(ended.summary.counters["robot"]["scans"], 8);
    // What was pending at the end is packed.
    assert!(ended.summary.streams[0].voxels > 1_000);
}

#[test]
fn hostile_datagrams_are_counted_and_do_no_harm() {
    let sockets = UdpSockets::bind(&UdpOptions::new(loopback())).unwrap();
    let address = sockets.local_addr().unwrap();
    let node = Node::start(NodeOptions::new(config(1)), move || sockets.into_transport()).unwrap();
    let attacker = std::net::UdpSocket::bind(loopback()).unwrap();
    for length in [0, 1, 24, 100, 1_200, 1_201, 5_000] {
        attacker.send_to(&vec![0x46; length], address).unwrap();
    }
    wait_until("all are counted", || node.status().unwrap().node.datagrams_refused == 7);
    assert!(node.status().unwrap().peers.is_empty());
}

#[test]
fn log_lines_tell_of_peers() {
    let lines: Arc<Mutex<Vec<String>>> = Arc::default();
    let in_log = Arc::clone(&lines);
    let mut sockets = swarm(2).into_iter();
    let (first, second) = (sockets.next().unwrap(), sockets.next().unwrap());
    let log = Log::new(move |_, text| in_log.lock().unwrap().push(text.to_owned()));
    let options = NodeOptions { log, ..NodeOptions::new(config(1)) };
    let _one = Node::start(options, move || first.into_transport()).unwrap();
    let _two = Node::start(NodeOptions::new(config(2)), move || second.into_transport()).unwrap();
    wait_until("the peer is reported", || lines.lock().unwrap().iter().any(|l| l == "hears robot 2 epoch 1"));
}

/// Starts a robot that plays its corridor.
fn start_playing(
    id: u16,
    epoch: u64,
    sockets: UdpSockets,
    change: impl FnOnce(&mut NodeOptions),
) -> NodeHandle {
    let mut options = NodeOptions { sensor: play(id, 20), ..NodeOptions::new(config(id)) };
    options.robot.epoch = epoch;
    change(&mut options);
    Node::start(options, move || sockets.into_transport()).unwrap()
}

#[test]
fn a_robot_that_starts_again_gets_everything_back() {
    let mut sockets = swarm(3).into_iter();
    let mut next = || sockets.next().unwrap();
    let (one, two, three) = (next(), next(), next());
    let address = two.local_addr().unwrap();
    let peers = [&one, &three].map(|other| other.local_addr().unwrap().to_string()).to_vec();
    let one = start_playing(1, 1, one, |_| {});
    let three = start_playing(3, 1, three, |_| {});
    let two = start_playing(2, 1, two, |options| options.end.linger = Duration::ZERO);
    wait_until("the robot has sent something", || {
        one.status().unwrap().streams.iter().any(|s| s.stream.origin == RobotId(2) && s.received > 0)
    });
    drop(two);
    wait_until("its port is free", || std::net::UdpSocket::bind(address).is_ok());
    let again = UdpSockets::bind(&UdpOptions { peers, ..UdpOptions::new(address) }).unwrap();
    let again = start_playing(2, 2, again, |_| {});
    wait_until_equal(&[one, again, three], 4);
}

#[test]
fn robots_with_a_key_sync_and_believe_nobody_without_it() {
    let key: flockmap::sync::SwarmKey =
        "5f0c6b1e5d0b7c3a9e8f41d2c3b4a59687f0e1d2c3b4a5968778695a4b3c2d1e".parse().unwrap();
    let mut sockets = swarm(3).into_iter();
    let stranger = start_playing(3, 1, sockets.next().unwrap(), |_| {});
    let nodes: Vec<NodeHandle> = (1..=2)
        .zip(sockets)
        .map(|(id, sockets)| {
            start_playing(id, 1, sockets, |options| {
                options.robot.session.swarm_key = Some(key.clone());
                options.robot.session.salt = [id as u8; 16];
            })
        })
        .collect();
    wait_until_equal(&nodes, 2);
    wait_until("all have heard each other", || {
        stranger.status().unwrap().session.sealed_without_key > 0
            && nodes.iter().all(|node| node.status().unwrap().session.unsealed > 0)
    });
    assert!(stranger.status().unwrap().peers.is_empty());
    for node in &nodes {
        let status = node.status().unwrap();
        assert_eq!((status.peers.len(), status.session.forged), (1, 0));
        assert!(status.prometheus().contains("flockmap_session_unsealed_total{"));
    }
}

#[test]
fn one_broadcast_serves_all() {
    let free = UdpSockets::bind(&UdpOptions::new(loopback())).unwrap().local_addr().unwrap().port();
    let broadcast = Some(SocketAddr::from(([127, 255, 255, 255], free)));
    let start = |id: u16| {
        let sockets = UdpSockets::bind(&UdpOptions { broadcast, ..UdpOptions::new(loopback()) }).unwrap();
        start_playing(id, 1, sockets, |options| options.robot.session.cast = Cast::Broadcast)
    };
    let nodes: Vec<NodeHandle> = (1..=3).map(start).collect();
    wait_until_equal(&nodes, 3);
    let status = nodes[0].status().unwrap();
    // One copy of each package for two others, and again what is lost.
    assert!(status.session.sent < 2 * status.robot.packages, "{status:?}");
    assert!(status.session.own_heard > 0, "a broadcast comes back");
}
