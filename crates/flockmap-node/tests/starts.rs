//! Two starts of a robot whose clock shows the same second of 1970 each time, and whose disk has lost the
//! epoch: nothing of a run comes twice, and both maps arrive. All datagrams are recorded.
#![cfg(unix)]

mod common;

use std::collections::BTreeSet;
use std::net::{SocketAddr, UdpSocket};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use common::{PATIENCE, Shared, config, corridor, frames, loopback, new_dir, wait_until, write_record};
use flockmap::sync::SwarmKey;
use flockmap::{RobotId, Stream};
use flockmap_node::store::{EpochFile, Folder, Identity, Store, StoreOptions, next_epoch};
use flockmap_node::{Clock, Log, Node, NodeHandle, NodeOptions, Sensor, UdpOptions, UdpSockets};

const KEY: &str = "5f0c6b1e5d0b7c3a9e8f41d2c3b4a59687f0e1d2c3b4a5968778695a4b3c2d1e";

/// Not a test: a node for the tests below, which run this executable again.
#[test]
#[ignore = "a node for the other tests"]
fn one_node() {
    if let Some(path) = std::env::var_os("FLOCKMAP_NODE_CONFIG") {
        flockmap_node::run(path.as_ref()).unwrap();
    }
}

/// What a robot has beside its clock.
#[derive(Clone, Copy, Debug)]
struct Case {
    has_key: bool,
    has_store: bool,
}

const CASES: [Case; 4] = [
    Case { has_key: false, has_store: false },
    Case { has_key: false, has_store: true },
    Case { has_key: true, has_store: false },
    Case { has_key: true, has_store: true },
];

/// Passes datagrams on between a robot and its team-mate, and keeps all of them.
struct Recorder {
    /// Where the robot sends to.
    near: SocketAddr,
    datagrams: Shared<Vec<Vec<u8>>>,
}

impl Recorder {
    fn start(mate: SocketAddr) -> Self {
        let [near, far] = [(); 2].map(|()| Arc::new(UdpSocket::bind(loopback()).unwrap()));
        let address = near.local_addr().unwrap();
        let (datagrams, robot) = (Shared::default(), Arc::new(Mutex::new(None)));
        // A robot that starts again has another port.
        let (seen, to) = (Arc::clone(&robot), robot);
        let send = Arc::clone(&far);
        pass_on(Arc::clone(&near), Arc::clone(&datagrams), move |bytes, from| {
            *seen.lock().unwrap() = Some(from);
            send.send_to(bytes, mate)
        });
        pass_on(far, Arc::clone(&datagrams), move |bytes, _| {
            to.lock().unwrap().map_or(Ok(0), |robot: SocketAddr| near.send_to(bytes, robot))
        });
        Self { near: address, datagrams }
    }

    fn count(&self) -> usize {
        self.datagrams.lock().unwrap().len()
    }
}

/// On a thread that ends with the process.
fn pass_on(
    from: Arc<UdpSocket>,
    datagrams: Shared<Vec<Vec<u8>>>,
    send: impl Fn(&[u8], SocketAddr) -> std::io::Result<usize> + Send + 'static,
) {
    std::thread::spawn(move || {
        let mut buffer = [0; 2_048];
        loop {
            // An error means that a robot is off.
            let Ok((length, sender)) = from.recv_from(&mut buffer) else { continue };
            datagrams.lock().unwrap().push(buffer[..length].to_vec());
            let _ = send(&buffer[..length], sender);
        }
    });
}

/// A datagram as WIRE.md has it.
struct Seen {
    sender: u16,
    epoch: u64,
    is_sealed: bool,
    is_for_one: bool,
    counter: Vec<u8>,
    salt: Option<Vec<u8>>,
}

impl Seen {
    fn new(bytes: &[u8]) -> Self {
        let kind = bytes[3];
        let is_sealed = kind >= 128;
        Self {
            sender: u16::from_le_bytes([bytes[6], bytes[7]]),
            epoch: u64::from_le_bytes(bytes[8..16].try_into().unwrap()),
            is_sealed,
            is_for_one: kind & 64 != 0,
            counter: bytes[16..22].to_vec(),
            salt: (is_sealed && kind & 63 != 2).then(|| bytes[22..38].to_vec()),
        }
    }
}

/// No nonce, salt or epoch of the robot comes in both starts, and no nonce at all comes twice.
fn check_nothing_comes_twice(case: Case, datagrams: &[Vec<u8>], second_start: usize) {
    let seen: Vec<Seen> = datagrams.iter().map(|bytes| Seen::new(bytes)).collect();
    let starts = [&seen[..second_start], &seen[second_start..]];
    let epochs = starts.map(|start| -> BTreeSet<u64> {
        start.iter().filter(|seen| seen.sender == 1).map(|seen| seen.epoch).collect()
    });
    assert!(epochs.iter().all(|epochs| !epochs.is_empty()), "{case:?}");
    assert!(epochs[0].is_disjoint(&epochs[1]), "{case:?} {epochs:?}");
    assert!(
        epochs[0].iter().all(|epoch| epoch >> 32 == 10 || epoch >> 32 == 11),
        "the clock shows 1970: {epochs:?}"
    );
    assert!(seen.iter().all(|seen| seen.is_sealed == case.has_key), "{case:?}");
    if !case.has_key {
        return;
    }
    let salts = starts.map(|start| -> BTreeSet<Vec<u8>> {
        start.iter().filter(|seen| seen.sender == 1).filter_map(|seen| seen.salt.clone()).collect()
    });
    assert!(salts.iter().all(|salts| salts.len() == 1) && salts[0] != salts[1], "{case:?} {salts:?}");
    let mut nonces = BTreeSet::new();
    for of in &seen {
        let salt = seen
            .iter()
            .find(|other| other.sender == of.sender && other.epoch == of.epoch && other.salt.is_some());
        // There are two robots: who it is for follows from who sent it.
        let recipient = if of.is_for_one { 3 - of.sender } else { 0 };
        let nonce = (salt.unwrap().salt.clone(), recipient, of.counter.clone());
        assert!(nonces.insert(nonce.clone()), "{case:?}: {nonce:?} twice");
    }
}

fn team_mate(case: Case) -> (NodeHandle, SocketAddr) {
    let sockets = UdpSockets::bind(&UdpOptions::new(loopback())).unwrap();
    let address = sockets.local_addr().unwrap();
    let mut options = NodeOptions::new(config(2));
    if case.has_key {
        options.robot.session.swarm_key = Some(KEY.parse().unwrap());
        options.robot.session.salt = random();
    }
    (Node::start(options, move || sockets.into_transport()).unwrap(), address)
}

fn random<const N: usize>() -> [u8; N] {
    let mut bytes = [0; N];
    getrandom::fill(&mut bytes).unwrap();
    bytes
}

/// The digest of a layer, as summaries have it, and how many packages of it are missing.
fn layer(node: &NodeHandle, stream: Stream) -> Option<(String, usize)> {
    let read = move |robot: &mut flockmap::Robot| {
        let digest = robot.fusion().layer(stream)?.digest();
        Some((format!("{digest:016x}"), robot.session().store().missing(stream).count()))
    };
    node.with_robot(move |robot, _| read(robot)).unwrap()
}

/// Starts a robot twice; `start` runs it until its team-mate has its map, as far as it knows, and returns its
/// summary.
fn two_starts(case: Case, mut start: impl FnMut(u32, &Recorder, &NodeHandle) -> serde_json::Value) {
    let (mate, address) = team_mate(case);
    let recorder = Recorder::start(address);
    let mut runs = Vec::new();
    let mut second_start = 0;
    for number in 1..=2 {
        let summary = start(number, &recorder, &mate);
        let epoch = summary["epoch"].as_u64().unwrap();
        let own =
            summary["streams"].as_array().unwrap().iter().find(|s| s["epoch"] == epoch && s["origin"] == 1);
        let own = own.expect("the own stream");
        assert!(own["voxels"].as_u64().unwrap() > 1_000, "{case:?} {own}");
        runs.push((Stream { origin: RobotId(1), epoch }, own["digest"].as_str().unwrap().to_owned()));
        if number == 1 {
            second_start = recorder.count();
        }
    }
    assert_ne!(runs[0].0, runs[1].0, "{case:?}");
    for (stream, digest) in runs {
        wait_until("the map of each run has arrived", || layer(&mate, stream) == Some((digest.clone(), 0)));
    }
    mate.stop();
    drop(mate.join());
    let datagrams = recorder.datagrams.lock().unwrap();
    let counts = [second_start, datagrams.len() - second_start];
    assert!(counts.iter().all(|count| *count > 5), "{case:?} {counts:?}");
    check_nothing_comes_twice(case, &datagrams, second_start);
}

/// `lows`: the lower halves of the epochs that are drawn.
fn two_starts_in_this_process(case: Case, lows: [u32; 2]) {
    fn system() -> SystemTime {
        UNIX_EPOCH + Duration::from_secs(10)
    }
    let dir = new_dir(&format!("starts-{}-{}-{}", case.has_key, case.has_store, lows[1]));
    two_starts(case, |number, recorder, mate| {
        let lines: Shared<Vec<String>> = Arc::default();
        let in_log = Arc::clone(&lines);
        let mut options = NodeOptions::new(config(1));
        options.clock = Clock::with_system_time(system);
        let robot = &mut options.robot;
        let identity = Identity { swarm: 0, robot: robot.id, resolution: robot.mapper.resolution };
        let store = case
            .has_store
            .then(|| Store::open_folder(dir.join("store"), identity, StoreOptions::default()).unwrap());
        let seconds = options.clock.system_now().0.unsigned_abs() / 1_000_000;
        let last = store.as_ref().and_then(Store::last_epoch);
        robot.epoch = next_epoch(last, seconds, lows[number as usize - 1]).unwrap();
        let drawn = robot.epoch;
        if case.has_key {
            robot.session.swarm_key = Some(KEY.parse::<SwarmKey>().unwrap());
            robot.session.salt = random();
        }
        // What the robot knew of the last epoch is lost.
        let folder = Arc::new(Folder::shared(dir.join(format!("state{number}"))).unwrap());
        let epoch_file = || EpochFile::open(Arc::clone(&folder) as _, 0, RobotId(1)).0;
        let mut file = epoch_file();
        file.keep(drawn).unwrap();
        (options.store, options.epoch_file) = (store, Some(file));
        let seen = frames(corridor(number as u16, 20));
        options.sensor = Sensor::play(seen, 4.0);
        options.log = Log::new(move |_, text| in_log.lock().unwrap().push(text.to_owned()));
        let mut sockets = UdpSockets::bind(&UdpOptions::new(loopback())).unwrap();
        sockets.add_peer(recorder.near);
        let node = Node::start(options, move || sockets.into_transport()).unwrap();
        let is_there = || {
            let (own, digest) = node
                .with_robot(|robot, _| {
                    let own = robot.own_stream();
                    (own, robot.fusion().layer(own).map(flockmap::grid::Layer::digest))
                })
                .unwrap();
            digest.is_some_and(|digest| layer(mate, own) == Some((format!("{digest:016x}"), 0)))
        };
        wait_until("the sensor has ended", || node.status().unwrap().sensor_ended);
        wait_until("the map is with the team-mate", is_there);
        node.stop();
        let ended = node.join().unwrap();
        let begins_anew = number == 2 && !case.has_store && lows[1] < lows[0];
        assert_eq!(ended.status.robot.runs_begun, u64::from(begins_anew), "{case:?}");
        assert_eq!(ended.summary.epoch > drawn, begins_anew, "{case:?}");
        assert_eq!(epoch_file().last(), Some(ended.summary.epoch), "each epoch is on disk");
        let lines = lines.lock().unwrap();
        let reported =
            lines.iter().filter(|line| line.contains("a higher epoch than its own was heard of")).count();
        assert_eq!(reported, usize::from(begins_anew), "{lines:?}");
        serde_json::to_value(&ended.summary).unwrap()
    });
    std::fs::remove_dir_all(&dir).unwrap();
}

#[test]
fn two_starts_in_one_second_of_1970_share_nothing_and_both_maps_arrive() {
    for case in CASES {
        two_starts_in_this_process(case, [0x4000_0000, 0xc000_0000]);
    }
}

#[test]
fn a_second_start_with_a_lower_epoch_begins_anew_and_both_maps_arrive() {
    for case in CASES {
        two_starts_in_this_process(case, [0xc000_0000, 0x4000_0000]);
    }
}

/// Runs a node as a process of its own whose system clock begins at ten seconds after 1970.
fn node_in_1970(config: &Path, log: &Path) {
    let ended = Command::new("faketime")
        .args(["-f", "@1970-01-01 00:00:10"])
        .arg(std::env::current_exe().unwrap())
        .args(["--ignored", "--exact", "one_node", "--nocapture"])
        // The monotonic clock goes on as it does on a machine without a battery.
        .envs([("TZ", "UTC"), ("FAKETIME_DONT_FAKE_MONOTONIC", "1")])
        .env("FLOCKMAP_NODE_CONFIG", config)
        .env_remove(flockmap_node::KEY_VARIABLE)
        .stdout(Stdio::null())
        .stderr(std::fs::File::create(log).unwrap())
        .status()
        .expect("faketime is installed");
    assert!(ended.success(), "{}", std::fs::read_to_string(log).unwrap());
}

#[test]
#[ignore = "needs the program faketime (apt-get install faketime)"]
fn two_starts_of_a_program_in_1970_share_nothing_and_both_maps_arrive() {
    for case in CASES {
        let dir = new_dir(&format!("faketime-{}-{}", case.has_key, case.has_store));
        write_record(&dir, 2.0);
        two_starts(case, |number, recorder, _| {
            let mut text = format!(
                "id = 1\n[map]\nresolution_m = 0.2\nrange_m = 7.0\n[batch]\npublish_period_ms = 100\n[state]\npath = \"state{number}\"\n\
                 [network]\nbind = \"127.0.0.1:0\"\npeers = [\"{}\"]\n[sensor]\nrecord = \"robot1.mcap\"\n\
                 [metrics]\nstatus_period_s = 0.0\n[output]\nreport_json = \"end.json\"\nend_when_quiet_s = 3.0\nlinger_ms = {}\n",
                recorder.near,
                PATIENCE.as_millis()
            );
            if case.has_store {
                text += "[store]\npath = \"store\"\n";
            }
            if case.has_key {
                text += &format!("[session]\nswarm_key = \"{KEY}\"\n");
            }
            let (path, log) = (dir.join("robot.toml"), dir.join(format!("node{number}.log")));
            std::fs::write(&path, text).unwrap();
            node_in_1970(&path, &log);
            let log = std::fs::read_to_string(log).unwrap();
            let knows_no_run = number == 1 || !case.has_store;
            assert_eq!(log.contains("is years behind"), knows_no_run, "the clock is not faked? {log}");
            println!("{case:?}, start {number}: began anew: {}", log.contains("than its own was heard of"));
            let end = std::fs::read_to_string(dir.join("end.json")).unwrap();
            serde_json::from_str(&end).unwrap()
        });
        std::fs::remove_dir_all(&dir).unwrap();
    }
}
