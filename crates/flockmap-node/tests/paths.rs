//! Where robots are reached: an address is used once an answer has come back from it, follows the robot, and
//! is not taken by who copies datagrams.

mod common;

use std::net::{SocketAddr, UdpSocket};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use common::{Shared, config, corridor, loopback, wait_until};
use flockmap::sync::{Session, SessionConfig, SwarmKey};
use flockmap::{Path, RobotId, Stamp, Stream, Transmit};
use flockmap_node::{
    Node, NodeHandle, NodeOptions, SendResult, Sensor, Transport, UdpOptions, UdpSockets, UdpTransport,
};

fn key() -> SwarmKey {
    SwarmKey::from_bytes([7; 32])
}

/// A node whose scans come from a channel.
fn start<T: Transport>(
    id: u16,
    has_key: bool,
    make: impl FnOnce() -> std::io::Result<T> + Send + 'static,
) -> (NodeHandle, tokio::sync::mpsc::Sender<flockmap_node::Frame>) {
    let (send, receive) = tokio::sync::mpsc::channel(100);
    let mut options = NodeOptions { sensor: Sensor::Channel(receive), ..NodeOptions::new(config(id)) };
    if has_key {
        options.robot.session.swarm_key = Some(key());
        options.robot.session.salt = [id as u8; 16];
    }
    (Node::start(options, make).unwrap(), send)
}

/// The robot sees something; waits until the other one knows it.
fn see_and_send(
    (node, sensor): &(NodeHandle, tokio::sync::mpsc::Sender<flockmap_node::Frame>),
    other: &NodeHandle,
    place: u16,
) {
    let scans = node.status().unwrap().robot.scans;
    for mut frame in corridor(place, 3) {
        frame.scan.stamp = node.clock().now();
        sensor.blocking_send(frame).unwrap();
    }
    wait_until("the scans are mapped", || node.status().unwrap().robot.scans == scans + 3);
    node.with_robot(|robot, now| robot.flush(now)).unwrap();
    let own = node.status().unwrap().own;
    let digest = |node: &NodeHandle| {
        node.with_robot(move |robot, _| robot.fusion().layer(own).map(flockmap::grid::Layer::digest)).unwrap()
    };
    let own = digest(node);
    assert!(own.is_some());
    wait_until("the other one knows it", || digest(other) == own);
}

fn bound() -> UdpSockets {
    UdpSockets::bind(&UdpOptions::new(loopback())).unwrap()
}

#[test]
fn two_nodes_of_which_one_knows_the_other_meet() {
    for has_key in [false, true] {
        let (mut one, two) = (bound(), bound());
        one.add_peer(two.local_addr().unwrap());
        let one = start(1, has_key, move || one.into_transport());
        let two = start(2, has_key, move || two.into_transport());
        see_and_send(&one, &two.0, 1);
        see_and_send(&two, &one.0, 2);
        for node in [&one.0, &two.0] {
            let status = node.status().unwrap();
            assert_eq!((status.session.paths_validated, status.node.send_failed), (1, 0));
            assert!(status.prometheus().contains("flockmap_session_paths_validated_total{robot="));
        }
    }
}

/// Stands between a robot and the rest, as a router that translates addresses.
struct Router {
    inside: SocketAddr,
    /// What others see; another one at will.
    outside: Shared<Arc<UdpSocket>>,
    robot: Shared<Option<SocketAddr>>,
    inner: Arc<UdpSocket>,
}

impl Router {
    fn start(other: SocketAddr) -> Self {
        let inner = Arc::new(UdpSocket::bind(loopback()).unwrap());
        let outer = Arc::new(UdpSocket::bind(loopback()).unwrap());
        let router = Self {
            inside: inner.local_addr().unwrap(),
            outside: Arc::new(Mutex::new(outer)),
            robot: Arc::default(),
            inner,
        };
        let (inner, outside, robot) =
            (Arc::clone(&router.inner), Arc::clone(&router.outside), Arc::clone(&router.robot));
        std::thread::spawn(move || {
            let mut buffer = [0; 2_048];
            loop {
                let Ok((length, from)) = inner.recv_from(&mut buffer) else { continue };
                *robot.lock().unwrap() = Some(from);
                let outside = Arc::clone(&outside.lock().unwrap());
                let _ = outside.send_to(&buffer[..length], other);
            }
        });
        router.listen_outside();
        router
    }

    fn listen_outside(&self) {
        let outer = Arc::clone(&self.outside.lock().unwrap());
        let (inner, outside, robot) =
            (Arc::clone(&self.inner), Arc::clone(&self.outside), Arc::clone(&self.robot));
        outer.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
        std::thread::spawn(move || {
            let mut buffer = [0; 2_048];
            // Until another one has taken its place: what comes to the old port is lost.
            while Arc::ptr_eq(&outer, &outside.lock().unwrap()) {
                if let Ok((length, _)) = outer.recv_from(&mut buffer)
                    && let Some(robot) = *robot.lock().unwrap()
                {
                    let _ = inner.send_to(&buffer[..length], robot);
                }
            }
        });
    }

    fn change_port(&self) {
        *self.outside.lock().unwrap() = Arc::new(UdpSocket::bind(loopback()).unwrap());
        self.listen_outside();
    }
}

#[test]
fn a_robot_whose_address_changes_is_followed() {
    for has_key in [false, true] {
        let (mut one, two) = (bound(), bound());
        let router = Router::start(two.local_addr().unwrap());
        one.add_peer(router.inside);
        let one = start(1, has_key, move || one.into_transport());
        let two = start(2, has_key, move || two.into_transport());
        see_and_send(&two, &one.0, 2);
        for changes in 1..=3 {
            router.change_port();
            see_and_send(&one, &two.0, 2 * changes as u16 + 1);
            see_and_send(&two, &one.0, 2 * changes as u16 + 2);
            // One challenge that was answered for each port.
            assert_eq!(two.0.status().unwrap().session.paths_validated, 1 + changes);
        }
        assert_eq!(one.0.status().unwrap().session.paths_validated, 1);
    }
}

/// Somebody in reach of the robot's radio sends all that it sends again, from an address of its own.
struct Copied {
    inner: UdpTransport,
    copier: Arc<UdpSocket>,
    to: SocketAddr,
    counts: Shared<Copies>,
}

#[derive(Default)]
struct Copies {
    datagrams: u64,
    bytes: usize,
}

impl Copied {
    fn copy(&self, transmit: &Transmit) {
        let mut counts = self.counts.lock().unwrap();
        counts.datagrams += 1;
        counts.bytes += transmit.bytes.len();
        self.copier.send_to(&transmit.bytes, self.to).unwrap();
    }
}

impl Transport for Copied {
    async fn receive(&mut self, buffer: &mut [u8]) -> std::io::Result<(usize, Path)> {
        self.inner.receive(buffer).await
    }

    fn set_paths(&mut self, paths: &[Path]) {
        self.inner.set_paths(paths);
    }

    async fn send(&mut self, transmit: &Transmit) -> SendResult {
        // Every other time the copy is faster.
        let is_faster = self.counts.lock().unwrap().datagrams % 2 == 1;
        if is_faster {
            self.copy(transmit);
        }
        let sent = self.inner.send(transmit).await;
        if !is_faster {
            self.copy(transmit);
        }
        sent
    }
}

/// Kind of a datagram, as WIRE.md has it.
fn kind(bytes: &[u8]) -> u8 {
    bytes[3] & 63
}

#[test]
fn who_copies_a_robot_s_datagrams_draws_challenges_and_nothing_else() {
    for has_key in [false, true] {
        let (mut one, two) = (bound(), bound());
        let to = two.local_addr().unwrap();
        one.add_peer(to);
        let copier = Arc::new(UdpSocket::bind(loopback()).unwrap());
        let counts: Shared<Copies> = Arc::default();
        let (with, counted) = (Arc::clone(&copier), Arc::clone(&counts));
        let one = start(1, has_key, move || {
            Ok(Copied { inner: one.into_transport()?, copier: with, to, counts: counted })
        });
        let two = start(2, has_key, move || two.into_transport());
        for place in 1..=8 {
            see_and_send(&one, &two.0, 2 * place);
            see_and_send(&two, &one.0, 2 * place + 1);
        }
        let sent = two.0.status().unwrap().session.packages_out.bytes as usize;
        assert_eq!(two.0.with_robot(|robot, _| robot.session().paths().count()), Some(1));
        two.0.stop();
        one.0.stop();
        drop((one.0.join(), two.0.join()));
        let (mut drawn, mut buffer) = (0, [0; 2_048]);
        copier.set_nonblocking(true).unwrap();
        while let Ok(length) = copier.recv(&mut buffer) {
            assert_eq!(kind(&buffer), 3, "only challenges");
            drawn += length;
        }
        let counts = counts.lock().unwrap();
        println!(
            "key {has_key}: {} B copied drew {drawn} B; {sent} B of packages went to the robot",
            counts.bytes
        );
        assert!(counts.datagrams > 5 && sent > 500);
        assert!(drawn <= counts.bytes, "{drawn} B for {} B", counts.bytes);
    }
}

#[test]
fn who_never_answers_gets_challenges_and_nothing_else() {
    for has_key in [false, true] {
        let two = bound();
        let to = two.local_addr().unwrap();
        let two = start(2, has_key, move || two.into_transport());
        // There is much to send.
        for mut frame in corridor(1, 5) {
            frame.scan.stamp = two.0.clock().now();
            two.1.blocking_send(frame).unwrap();
        }
        let swarm_key = has_key.then(key);
        let session = SessionConfig { swarm_key, salt: [9; 16], ..SessionConfig::default() };
        let mut silent = Session::new(Stream { origin: RobotId(9), epoch: 1 }, session, 1).unwrap();
        let socket = UdpSocket::bind(loopback()).unwrap();
        let (mut sent, mut now) = (0, Stamp(0));
        while sent < 20 {
            if let Some(transmit) = silent.poll_transmit(now) {
                socket.send_to(&transmit.bytes, to).unwrap();
                sent += 1;
                wait_until("it is heard", || two.0.status().unwrap().session.requests_in.datagrams == sent);
            } else {
                now = silent.poll_timeout().unwrap();
                silent.handle_timeout(now);
            }
        }
        let status = two.0.status().unwrap();
        assert_eq!((status.peers.len(), status.session.paths_validated), (1, 0));
        assert_eq!(status.node.datagrams_out, status.session.paths_out.datagrams);
        two.0.stop();
        drop(two.0.join());
        socket.set_nonblocking(true).unwrap();
        let (mut challenges, mut buffer) = (0, [0; 2_048]);
        while socket.recv(&mut buffer).is_ok() {
            assert_eq!(kind(&buffer), 3);
            challenges += 1;
        }
        assert!((1..=20).contains(&challenges), "{challenges}");
    }
}
