//! The server as browsers, and others, see it.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::time::{Duration, Instant};

use flockmap_feed::{Block, Event, Mirror, MirrorOptions, Playback};
use flockmap_grid::{BlockIndex, Resolution, RobotId, Stamp, State, StateBlock};
use flockmap_view::{Access, Content, Control, Kind, Recording, Series, Source, Step, Token, ViewServer};
use tokio::io::DuplexStream;
use tokio::sync::mpsc;
use tokio_tungstenite::tungstenite::{self, Message, client::IntoClientRequest};

/// Far more than anything here takes.
const PATIENCE: Duration = Duration::from_secs(40);

fn loopback() -> SocketAddr {
    "127.0.0.1:0".parse().unwrap()
}

fn recording() -> Arc<dyn Source> {
    let series = Arc::new(Series::new(vec!["sent".into()]));
    (0..3).for_each(|second| series.push(Stamp(second * 1_000_000), &[second as u64 * 100]));
    let resolution = Resolution::from_metres(0.1).unwrap();
    let recording = Recording::new(RobotId(7), "<seven>", resolution, "map").unwrap().with_series(series);
    let mut states = StateBlock::default();
    states.set(3, State::Occupied);
    for second in 0..10 {
        let block = Block { index: BlockIndex::new(second, 0, 0), states, origins: Vec::new() };
        let stamp = Stamp(i64::from(second) * 1_000_000);
        recording.push(Step { stamp, blocks: vec![block], ..Step::default() });
    }
    recording.finish();
    Arc::new(Arc::new(recording))
}

fn server(access: Access, source: Arc<dyn Source>) -> ViewServer {
    let content =
        Content { title: "a test".into(), kind: Kind::Playback, sources: vec![source], metrics: None };
    ViewServer::start(loopback(), access, content).unwrap()
}

fn ask(address: SocketAddr, request: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream.write_all(request.as_bytes()).unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    String::from_utf8_lossy(&answer).into_owned()
}

fn get(address: SocketAddr, path: &str) -> String {
    ask(address, &format!("GET {path} HTTP/1.1\r\nHost: {address}\r\n\r\n"))
}

type Socket = tungstenite::WebSocket<TcpStream>;

fn open(
    address: SocketAddr,
    path: &str,
    headers: &[(&'static str, &str)],
) -> Result<Socket, Box<tungstenite::Error>> {
    let mut request = format!("ws://{address}{path}").into_client_request().unwrap();
    for (name, value) in headers {
        request.headers_mut().insert(*name, value.parse().unwrap());
    }
    let stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    match tungstenite::client(request, stream) {
        Ok((socket, _)) => Ok(socket),
        Err(tungstenite::HandshakeError::Failure(error)) => Err(Box::new(error)),
        Err(tungstenite::HandshakeError::Interrupted(_)) => panic!("the handshake took too long"),
    }
}

fn status(result: Result<Socket, Box<tungstenite::Error>>) -> u16 {
    match result.map(drop).map_err(|error| *error) {
        Err(tungstenite::Error::Http(response)) => response.status().as_u16(),
        other => panic!("{other:?}"),
    }
}

/// Reads the feed until something is so.
fn read_until(socket: &mut Socket, mirror: &mut Mirror, is: impl Fn(&Mirror) -> bool) {
    let began = Instant::now();
    while !is(mirror) {
        assert!(began.elapsed() < PATIENCE);
        let Message::Binary(bytes) = socket.read().unwrap() else { continue };
        assert!(bytes.len() <= 1 << 16);
        let mut bytes = &bytes[..];
        while let Some(event) = mirror.push(&mut bytes).unwrap() {
            assert_ne!(event, Event::End);
        }
    }
}

#[test]
fn the_page_its_parts_and_what_it_asks_for_are_served() {
    let server = server(Access::Loopback, recording());
    let address = server.address();
    assert_eq!(server.url(), format!("http://{address}/"));
    for (path, mime) in [
        ("/", "text/html"),
        ("/view.js", "text/javascript"),
        ("/worker.js", "text/javascript"),
        ("/view.css", "text/css"),
    ] {
        let answer = get(address, path);
        let (head, body) = answer.split_once("\r\n\r\n").unwrap();
        assert!(
            head.starts_with("HTTP/1.1 200") && head.contains(&format!("content-type: {mime}")),
            "{head}"
        );
        assert!(head.contains("frame-ancestors 'none'") && head.contains("nosniff"), "{head}");
        assert!(body.len() > 1_000);
        let packed = ask(
            address,
            &format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nAccept-Encoding: br, gzip;q=0.9\r\n\r\n"),
        );
        assert!(packed.contains("content-encoding: gzip") && packed.len() < answer.len());
    }
    let robots = get(address, "/robots");
    assert!(
        robots.ends_with(r#"{"kind":"playback","robots":[{"id":7,"name":"<seven>"}],"title":"a test"}"#),
        "{robots}"
    );
    let series = get(address, "/series/7");
    assert!(series.contains(r#""bytes":[[100,100]]"#) && series.contains(r#""names":["sent"]"#), "{series}");
    for (path, status) in [
        ("/series/8", 404),
        ("/series/x", 404),
        ("/x", 404),
        ("/metrics", 404),
        ("/feed/7", 426),
        ("/../x", 404),
    ] {
        assert!(get(address, path).starts_with(&format!("HTTP/1.1 {status}")), "{path}");
    }
    let head = ask(address, &format!("HEAD /robots HTTP/1.1\r\nHost: {address}\r\n\r\n"));
    assert!(head.starts_with("HTTP/1.1 200") && head.ends_with("\r\n\r\n"));
    let post =
        ask(address, &format!("POST /robots HTTP/1.1\r\nHost: {address}\r\nContent-Length: 0\r\n\r\n"));
    assert!(post.starts_with("HTTP/1.1 405") && post.contains("allow: GET, HEAD"));
}

#[test]
fn a_browser_follows_a_recording_and_seeks_in_it() {
    let server = server(Access::Loopback, recording());
    let mut socket = open(server.address(), "/feed/7", &[]).unwrap();
    let mut mirror = Mirror::new(MirrorOptions { links: true, ..MirrorOptions::default() });
    socket.send(Message::Binary(mirror.connect().into())).unwrap();
    read_until(&mut socket, &mut mirror, Mirror::is_complete);
    assert_eq!(mirror.node().unwrap().name, "<seven>");
    for words in [r#"{"play": false}"#, r#"{"speed": 4}"#, r#"{"seek_us": 8500000}"#] {
        socket.send(Message::Text(words.into())).unwrap();
    }
    let is_there =
        |playback: &Playback| playback.at == Stamp(8_500_000) && !playback.plays && playback.speed == 4.0;
    read_until(&mut socket, &mut mirror, |mirror| {
        mirror.playback().is_some_and(is_there)
            && mirror.is_complete()
            && mirror.map().is_some_and(|map| map.block_count() == 9)
    });
    // What is no wish ends the connection.
    socket.send(Message::Text("{\"seek\": 1}".into())).unwrap();
    while let Ok(message) = socket.read() {
        if message.is_close() {
            break;
        }
    }
}

#[test]
fn pages_of_other_origins_and_other_names_reach_nothing() {
    let server = server(Access::Loopback, recording());
    let address = server.address();
    let own = format!("http://{address}");
    assert!(open(address, "/feed/7", &[("origin", &own)]).is_ok());
    for origin in ["http://evil.example", "null", "http://127.0.0.1:1", "https://evil.example:443"] {
        assert_eq!(status(open(address, "/feed/7", &[("origin", origin)])), 403, "{origin}");
        for path in ["/robots", "/series/7", "/"] {
            let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nOrigin: {origin}\r\n\r\n");
            assert!(ask(address, &request).starts_with("HTTP/1.1 403"), "{path} {origin}");
        }
    }
    // A name that somebody else lets mean 127.0.0.1, with an origin that fits.
    let rebound = [("host", "evil.example:7781"), ("origin", "http://evil.example:7781")];
    assert_eq!(status(open(address, "/feed/7", &rebound)), 403);
    assert!(ask(address, "GET /robots HTTP/1.1\r\nHost: evil.example\r\n\r\n").starts_with("HTTP/1.1 403"));
    assert!(ask(address, "GET /robots HTTP/1.0\r\n\r\n").starts_with("HTTP/1.0 403"));
}

#[test]
fn beyond_the_loopback_a_token_is_needed() {
    let anywhere: SocketAddr = "0.0.0.0:0".parse().unwrap();
    let content =
        || Content { title: String::new(), kind: Kind::Playback, sources: vec![recording()], metrics: None };
    let text = ViewServer::start(anywhere, Access::Loopback, content()).unwrap_err().to_string();
    assert!(text.contains("0.0.0.0") && text.contains("token"), "{text}");
    let token = Token::draw().unwrap();
    let server = ViewServer::start(anywhere, Access::Token(token.clone()), content()).unwrap();
    let (port, token) = (server.address().port(), token.as_str());
    assert_eq!(server.url(), format!("http://HOST:{port}/#token={token}"));
    let address = SocketAddr::from(([127, 0, 0, 1], port));
    assert!(get(address, "/").starts_with("HTTP/1.1 200"), "the page holds no map");
    assert!(get(address, "/robots").starts_with("HTTP/1.1 401"));
    assert_eq!(status(open(address, "/feed/7", &[])), 401);
    assert_eq!(status(open(address, "/feed/7?token=aaaaaaaaaaaaaaaaaaaaaaaa", &[])), 401);
    let with = format!("/feed/7?token={token}");
    assert!(open(address, &with, &[]).is_ok());
    assert_eq!(status(open(address, &with, &[("origin", "http://evil.example")])), 403);
    assert!(get(address, &format!("/robots?token={token}")).starts_with("HTTP/1.1 200"));
}

#[test]
fn a_thousand_connections_that_say_nothing_keep_nobody_out() {
    let server = server(Access::Loopback, recording());
    let address = server.address();
    let mut silent = Vec::new();
    for number in 0..1_000 {
        let mut stream = TcpStream::connect(address).unwrap();
        if number % 2 == 0 {
            // It may have been closed for another one.
            let _ = stream.write_all(b"GET /robots HTTP/1.1\r\nHo");
        }
        silent.push(stream);
    }
    assert!(get(address, "/robots").starts_with("HTTP/1.1 200"));
    let mut socket = open(address, "/feed/7", &[]).unwrap();
    let mut mirror = Mirror::default();
    socket.send(Message::Binary(mirror.connect().into())).unwrap();
    read_until(&mut socket, &mut mirror, Mirror::is_complete);
}

#[test]
fn browsers_beyond_the_limit_are_told() {
    let server = server(Access::Loopback, recording());
    let mut sockets: Vec<Socket> = (0..64).map(|_| open(server.address(), "/feed/7", &[]).unwrap()).collect();
    assert_eq!(status(open(server.address(), "/feed/7", &[])), 503);
    sockets.pop();
    let began = Instant::now();
    while open(server.address(), "/feed/7", &[]).is_err() {
        assert!(began.elapsed() < PATIENCE, "a place that was given back stays taken");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// A source that takes no wishes, and sends what it hears back.
struct Echo;

impl Source for Echo {
    fn id(&self) -> u16 {
        1
    }

    fn name(&self) -> String {
        String::new()
    }

    fn connect(&self, stream: DuplexStream, _: mpsc::Receiver<Control>) {
        tokio::spawn(async move {
            let (mut from, mut to) = tokio::io::split(stream);
            let _ = tokio::io::copy(&mut from, &mut to).await;
        });
    }

    fn series(&self) -> Option<Arc<Series>> {
        None
    }
}

#[test]
fn what_a_live_source_does_not_take_ends_the_connection() {
    let server = server(Access::Loopback, Arc::new(Echo));
    let ends = |message: Message| {
        let mut socket = open(server.address(), "/feed/1", &[]).unwrap();
        socket.send(Message::Binary(vec![1, 2, 3].into())).unwrap();
        assert_eq!(socket.read().unwrap(), Message::Binary(vec![1, 2, 3].into()));
        socket.send(message).unwrap();
        loop {
            match socket.read() {
                Ok(Message::Close(_)) | Err(_) => return,
                Ok(other) => assert!(other.len() <= 4_096, "{} bytes came back", other.len()),
            }
        }
    };
    ends(Message::Text(r#"{"play": true}"#.into()));
    ends(Message::Text("garbage".into()));
    ends(Message::Binary(vec![0; 5_000].into()));
    assert!(get(server.address(), "/series/1").contains(r#""names":[]"#));
}

#[test]
fn the_end_of_the_server_ends_its_browsers() {
    let server = server(Access::Loopback, Arc::new(Echo));
    let mut socket = open(server.address(), "/feed/1", &[]).unwrap();
    let address = server.address();
    drop(server);
    while socket.read().is_ok() {}
    assert!(TcpStream::connect(address).is_err());
}
