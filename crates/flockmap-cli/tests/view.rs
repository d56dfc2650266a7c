//! What `flockmap view`, and `--view` of others, serve, as a browser sees it.
#![cfg(unix)]

mod common;

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::process::{Child, ChildStderr, Command, Stdio};
use std::time::{Duration, Instant};

use common::{fails, good};
use flockmap::{Resolution, State, Voxel};
use flockmap_feed::{Mirror, MirrorOptions};
use tokio_tungstenite::tungstenite::{self, Message};

/// Far more than anything here takes.
const PATIENCE: Duration = Duration::from_secs(120);

/// A program that serves a page.
struct Page {
    program: Child,
    said: BufReader<ChildStderr>,
    address: SocketAddr,
}

impl Page {
    fn of(words: &str) -> Self {
        let mut program = Command::new(env!("CARGO_BIN_EXE_flockmap"))
            .args(words.split_whitespace())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut said = BufReader::new(program.stderr.take().unwrap());
        let mut line = String::new();
        let address = loop {
            line.clear();
            assert!(said.read_line(&mut line).unwrap() > 0, "{words} ended before it served anything");
            let url = line.strip_prefix("open http://").and_then(|rest| rest.split_once('/'));
            if let Some((address, _)) = url {
                break address.parse().unwrap();
            }
        };
        Self { program, said, address }
    }

    fn get(&self, path: &str) -> String {
        let mut stream = TcpStream::connect(self.address).unwrap();
        stream
            .write_all(format!("GET {path} HTTP/1.1\r\nHost: {}\r\n\r\n", self.address).as_bytes())
            .unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        answer
    }

    /// Follows a robot until something is so; `first` is said after the hello.
    fn follow(&self, robot: u16, first: &str, is: impl Fn(&Mirror) -> bool) -> Mirror {
        let stream = TcpStream::connect(self.address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let request = format!("ws://{}/feed/{robot}", self.address);
        let (mut socket, _) = tungstenite::client(request, stream).unwrap();
        let mut mirror = Mirror::new(MirrorOptions { links: true, ..MirrorOptions::default() });
        socket.send(Message::Binary(mirror.connect().into())).unwrap();
        if !first.is_empty() {
            socket.send(Message::Text(first.into())).unwrap();
        }
        let began = Instant::now();
        while !is(&mirror) {
            assert!(began.elapsed() < PATIENCE, "{:?}", mirror.playback());
            let Message::Binary(bytes) = socket.read().unwrap() else { continue };
            let mut bytes = &bytes[..];
            while mirror.push(&mut bytes).unwrap().is_some() {}
        }
        mirror
    }

    /// The map at the end of what is played, once all of it is there.
    fn end_of(&self, robot: u16) -> Mirror {
        let is_over = |mirror: &Mirror| {
            mirror.playback().is_some_and(|play| !play.plays && !play.grows && play.at == play.end)
                && mirror.is_complete()
        };
        self.follow(robot, r#"{"speed": 100}"#, is_over)
    }

    /// Waits until the program says that all is done, and then ends it as a user does.
    fn end(mut self) {
        let mut line = String::new();
        while !line.contains("until Ctrl-C") {
            line.clear();
            assert!(self.said.read_line(&mut line).unwrap() > 0);
        }
        let killed = Command::new("kill").args(["-INT", &self.program.id().to_string()]).status().unwrap();
        assert!(killed.success());
        assert_eq!(self.program.wait().unwrap().code(), Some(0));
    }
}

fn fly(folder: &Path) {
    good(&format!(
        "sim fly --scene indoor --robots 2 --seconds 3 --resolution 0.25 --range 6 --no-view --out {}",
        folder.display()
    ));
}

fn voxels(mirror: &Mirror) -> Vec<(Voxel, State)> {
    let mut voxels: Vec<_> = mirror.map().unwrap().voxels().collect();
    voxels.sort_unstable_by_key(|(voxel, _)| *voxel);
    voxels
}

/// The voxels of a map file.
fn read(path: &Path) -> Vec<(Voxel, State)> {
    let map = flockmap_io::read_map(path, Resolution::from_metres(0.25).unwrap()).unwrap();
    let mut voxels: Vec<_> = map.voxels.collect();
    voxels.sort_unstable_by_key(|(voxel, _)| *voxel);
    voxels
}

#[test]
fn a_file_and_a_record_are_seen_as_they_are_exported() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path().display();
    fly(folder.path());
    good(&format!("export {at}/robot1.mcap --to {at}/map.bt --resolution 0.25 --range 6"));
    let expected = read(&folder.path().join("map.bt"));
    assert!(expected.len() > 1_000);

    let page = Page::of(&format!("view {at}/map.bt --listen 127.0.0.1:0"));
    assert!(page.get("/").contains("<!doctype html>") || page.get("/").contains("<!DOCTYPE html>"));
    assert!(page.get("/robots").contains(r#""kind":"playback""#) && page.get("/robots").contains("map.bt"));
    assert_eq!(voxels(&page.end_of(0)), expected);
    page.end();

    let page = Page::of(&format!("view {at}/robot1.mcap --resolution 0.25 --range 6 --listen 127.0.0.1:0"));
    let end = page.end_of(1);
    assert_eq!(voxels(&end), expected);
    assert_eq!(end.robots().len(), 1);
    // Before there was a second scan, little was known.
    let begin =
        page.follow(1, r#"{"play": false}"#, |mirror| mirror.playback().is_some() && mirror.is_complete());
    assert!(voxels(&begin).len() < expected.len());
    page.end();
}

#[test]
fn a_replay_is_seen_with_links_and_what_rivals_would_send() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path().display();
    fly(folder.path());
    let page = Page::of(&format!(
        "replay {at}/robot1.mcap {at}/robot2.mcap --resolution 0.25 --range 6 --loss 0.3 --view=127.0.0.1:0"
    ));
    let [first, second] = [1, 2].map(|robot| page.end_of(robot));
    assert_eq!(first.links()[0].stream.origin.0, 2);
    assert!(first.links()[0].loss > 0 && first.links()[0].missing == 0, "{:?}", first.links());
    assert_eq!((first.robots().len(), second.robots().len()), (2, 2));
    let series = page.get("/series/1");
    assert!(series.contains(r#""names":["sent","paper","racer"]"#), "{series}");
    page.end();
}

#[test]
fn a_node_elsewhere_and_the_record_of_its_flight_are_seen() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path().display();
    fly(folder.path());
    let text = "id = 5\nname = \"alpha\"\n[map]\nresolution_m = 0.25\nrange_m = 6.0\n[state]\npath = \"state\"\n\
                [network]\nbind = \"127.0.0.1:0\"\n[sensor]\nrecord = \"robot1.mcap\"\n[map_output]\n\
                listen_unix = \"map.sock\"\n[record]\npath = \"flight.mcap\"\n[output]\n\
                save_map_at_end = \"node.bt\"\nreport_json = \"end.json\"\n";
    std::fs::write(folder.path().join("robot.toml"), text).unwrap();
    let mut node = Command::new(env!("CARGO_BIN_EXE_flockmap"))
        .args(["node", "--config", &format!("{at}/robot.toml")])
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(node.stderr.take().unwrap()).lines().map(Result::unwrap);
    assert!(lines.any(|line| line.contains("sensor ended")), "the node maps all");
    let page = Page::of(&format!("view unix:{at}/map.sock --listen 127.0.0.1:0"));
    assert!(page.get("/robots").contains(r#""kind":"live""#) && page.get("/robots").contains("alpha"));
    let live = voxels(&page.follow(5, "", Mirror::is_complete));
    page.end();
    let killed = Command::new("kill").args(["-INT", &node.id().to_string()]).status().unwrap();
    assert!(killed.success() && lines.last().is_some() && node.wait().unwrap().success());
    assert_eq!(live, read(&folder.path().join("node.bt")));

    let page = Page::of(&format!("view {at}/flight.mcap --listen 127.0.0.1:0"));
    assert!(page.get("/robots").contains("alpha"));
    assert_eq!(voxels(&page.end_of(5)), live);
    page.end();
}

#[test]
fn what_cannot_be_seen_is_said() {
    assert!(fails("view nothing.bt").contains("nothing.bt"));
    let text = fails("view 127.0.0.1:9 --listen 127.0.0.1:0");
    assert!(text.contains("127.0.0.1:9") && text.contains("[map_output]"), "{text}");
    let text = fails("view 127.0.0.1:9 --range 3");
    assert!(text.contains("--range") && text.contains("is a node"), "{text}");
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let text = fails(&format!("replay forest --seconds 1 --view={}", taken.local_addr().unwrap()));
    assert!(text.contains("another program listens there"), "{text}");
}
