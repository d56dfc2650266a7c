//! The map of a node in browsers, over real sockets.

mod common;

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use common::{PATIENCE, config, corridor, frames, loopback, swarm, wait_until};
use flockmap::{State, Voxel};
use flockmap_feed::{Event, Mirror, MirrorOptions, ReaderHello};
use flockmap_node::{MapOutput, Node, NodeHandle, NodeOptions, Sensor, ViewOptions};
use flockmap_view::Access;
use tokio_tungstenite::tungstenite::{self, Message, client::IntoClientRequest};

/// Two robots of which the first is seen.
fn start(readers_max: usize) -> (Vec<NodeHandle>, SocketAddr) {
    let mut view = Some(ViewOptions { address: loopback(), access: Access::Loopback });
    let mut nodes = Vec::new();
    for (id, sockets) in (1..).zip(swarm(2)) {
        let sensor = Sensor::play(frames(corridor(id, 30)), 4.0);
        let map_output = Some(MapOutput { readers_max, ..MapOutput::default() });
        let options = NodeOptions { sensor, map_output, view: view.take(), ..NodeOptions::new(config(id)) };
        nodes.push(Node::start(options, move || sockets.into_transport()).unwrap());
    }
    let url = nodes[0].view_url().unwrap();
    let address = url.strip_prefix("http://").and_then(|url| url.strip_suffix('/')).unwrap();
    let address = address.parse().unwrap();
    (nodes, address)
}

type Socket = tungstenite::WebSocket<TcpStream>;

fn open(address: SocketAddr, origin: &str) -> Result<Socket, String> {
    let mut request = format!("ws://{address}/feed/1").into_client_request().unwrap();
    request.headers_mut().insert("origin", origin.parse().unwrap());
    let stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    tungstenite::client(request, stream).map(|(socket, _)| socket).map_err(|error| error.to_string())
}

/// A page of the server itself.
fn browser(address: SocketAddr, mirror: &mut Mirror) -> Socket {
    let mut socket = open(address, &format!("http://{address}")).unwrap();
    socket.send(Message::Binary(mirror.connect().into())).unwrap();
    socket
}

fn read_until(socket: &mut Socket, mirror: &mut Mirror, mut is: impl FnMut(&Mirror, &[Event]) -> bool) {
    let (began, mut events) = (Instant::now(), Vec::new());
    while !is(mirror, &events) {
        assert!(began.elapsed() < PATIENCE, "{events:?}");
        let Message::Binary(bytes) = socket.read().unwrap() else { continue };
        let mut bytes = &bytes[..];
        while let Some(event) = mirror.push(&mut bytes).unwrap() {
            events.push(event);
        }
    }
}

/// Waits until nothing is left to map or to hear.
fn final_map(nodes: &[NodeHandle]) -> BTreeMap<Voxel, State> {
    wait_until("all has been seen and heard", || {
        nodes.iter().all(|node| {
            let status = node.status().unwrap();
            status.sensor_ended && status.packages().1 == 0 && status.quiet_for > Duration::from_millis(500)
        })
    });
    nodes[0].with_robot(|robot, _| robot.view()).unwrap().voxels().collect()
}

fn get(address: SocketAddr, path: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream.write_all(format!("GET {path} HTTP/1.1\r\nHost: {address}\r\n\r\n").as_bytes()).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
}

#[test]
fn a_browser_has_the_nodes_map_also_after_its_connection_broke_beside_others_that_do_harm() {
    let (nodes, address) = start(16);
    let options = MirrorOptions { links: true, scans: true, ..MirrorOptions::default() };
    let (mut mirror, mut stuck) = (Mirror::new(options), Mirror::default());
    let mut socket = browser(address, &mut mirror);
    // One that never reads, and a thousand that come and say nothing.
    let _stuck = browser(address, &mut stuck);
    let _silent: Vec<TcpStream> = (0..1_000).map(|_| TcpStream::connect(address).unwrap()).collect();
    assert!(open(address, "http://evil.example").unwrap_err().contains("403"));

    let (mut links, mut scans) = (false, false);
    read_until(&mut socket, &mut mirror, |mirror, events| {
        links |= events.contains(&Event::Links) && !mirror.links().is_empty();
        scans |= events.contains(&Event::Scan);
        links && scans && mirror.map().is_some_and(|map| map.block_count() > 20)
    });
    assert_eq!(mirror.links()[0].stream.origin.0, 2);
    assert!(!mirror.scan().unwrap().points.is_empty());
    drop(socket);
    let expected = final_map(&nodes);
    let mut socket = browser(address, &mut mirror);
    // A hello alone does not say how far the node has come; the first blocks do.
    read_until(&mut socket, &mut mirror, |mirror, events| {
        events.iter().any(|event| matches!(event, Event::Blocks(_))) && mirror.is_complete()
    });
    assert!(mirror.node().unwrap().goes_on);
    let mirrored: BTreeMap<_, _> = mirror.map().unwrap().voxels().collect();
    assert_eq!(mirrored, expected);

    let metrics = get(address, "/metrics");
    assert!(
        metrics.starts_with("HTTP/1.1 200") && metrics.contains("flockmap_map_readers{robot=\"robot1\"} 2")
    );
    assert!(get(address, "/robots").contains(r#""robots":[{"id":1,"name":"robot1"}]"#));
    wait_until("a second is over", || !get(address, "/series/1").contains(r#""bytes":[[],[]]"#));
}

#[test]
fn readers_that_want_no_map_are_sent_none() {
    let (nodes, address) = start(16);
    final_map(&nodes);
    let mut socket = open(address, &format!("http://{address}")).unwrap();
    let hello = ReaderHello { no_map: true, links: true, ..ReaderHello::default() };
    let mut mirror = Mirror::default();
    mirror.connect();
    socket.send(Message::Binary(hello.emit().into())).unwrap();
    read_until(&mut socket, &mut mirror, |_, events| {
        assert!(!events.iter().any(|event| matches!(event, Event::Anew | Event::Blocks(_))));
        [Event::Hello, Event::Poses, Event::Counters, Event::Links].iter().all(|event| events.contains(event))
    });
    assert_eq!(mirror.map().unwrap().block_count(), 0);
}

#[test]
fn a_browser_beyond_readers_max_is_told_and_at_the_end_all_are() {
    let (mut nodes, address) = start(1);
    let (mut first, mut second) = (Mirror::default(), Mirror::default());
    let mut follows = browser(address, &mut first);
    read_until(&mut follows, &mut first, |mirror, _| mirror.node().is_some());
    let mut refused = browser(address, &mut second);
    read_until(&mut refused, &mut second, |mirror, _| mirror.end().is_some());
    assert!(second.end().unwrap().contains("readers_max"), "{:?}", second.end());

    nodes[0].stop();
    read_until(&mut follows, &mut first, |mirror, _| mirror.end().is_some());
    assert_eq!(first.end(), Some("the node ends"));
    nodes.remove(0).join().unwrap();
    assert!(TcpStream::connect(address).is_err());
}
