//! Nodes from configuration files: in this process, and as processes of their own.
#![cfg(target_os = "linux")]

mod common;

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;

use common::{config, loopback, new_dir, wait_until, write_record};
use flockmap::{RobotId, Stream};
use flockmap_node::store::{EpochFile, Folder};
use flockmap_node::{Node, NodeOptions, UdpOptions, UdpSockets};

/// Not a test: a node for the tests below, which run this executable again.
#[test]
#[ignore = "a node for the other tests"]
fn one_node() {
    if let Some(path) = std::env::var_os("FLOCKMAP_NODE_CONFIG") {
        flockmap_node::run(path.as_ref()).unwrap();
    }
}

#[test]
fn a_robot_plays_its_record_and_leaves_a_map_and_a_summary() {
    let dir = new_dir("one-node");
    write_record(&dir, 1.0);
    let text = "id = 7\n[map]\nresolution_m = 0.2\nrange_m = 7.0\n[state]\npath = \"state\"\n[network]\nbind = \"127.0.0.1:0\"\n\
        [sensor]\nrecord = \"robot1.mcap\"\nspeed = 4.0\n[metrics]\nstatus_period_s = 0.2\n\
        [output]\nreport_json = \"end.json\"\nsave_map_at_end = \"map.ply\"\nend_when_quiet_s = 0.1\n";
    let path = dir.join("robot.toml");
    std::fs::write(&path, text).unwrap();
    flockmap_node::run(&path).unwrap();

    let summary: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(dir.join("end.json")).unwrap()).unwrap();
    assert_eq!((&summary["id"], &summary["counters"]["robot"]["scans"]), (&7.into(), &5.into()));
    assert_eq!(summary["streams"][0]["origin"], 7);
    let packages = summary["counters"]["robot"]["packages"].as_u64().unwrap();
    assert!(packages > 0);
    assert_eq!(summary["streams"][0]["received"], serde_json::json!([[1, packages]]));
    let map = flockmap_io::read_cloud(dir.join("map.ply")).unwrap();
    assert_eq!(map.points.len() as u64, summary["map_occupied"].as_u64().unwrap());
    std::fs::remove_dir_all(&dir).unwrap();
}

#[test]
fn a_terminated_node_ends_cleanly() {
    let dir = new_dir("terminated-node");
    let path = dir.join("robot.toml");
    let text = "id = 1\n[map]\nresolution_m = 0.2\nrange_m = 7.0\n[state]\npath = \"state\"\n[network]\nbind = \"127.0.0.1:0\"\n\
        [sensor]\nlisten_tcp = \"127.0.0.1:0\"\n[output]\nreport_json = \"end.json\"\n";
    std::fs::write(&path, text).unwrap();
    let mut node = Command::new(std::env::current_exe().unwrap())
        .args(["--ignored", "--exact", "one_node", "--nocapture"])
        .env("FLOCKMAP_NODE_CONFIG", &path)
        .env_remove(flockmap_node::KEY_VARIABLE)
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(node.stderr.take().unwrap()).lines().map(Result::unwrap);
    assert!(lines.any(|line| line.contains("no swarm key")), "it says what that means");
    assert!(lines.any(|line| line.contains("takes scans at 127.0.0.1:")), "the node runs");
    let killed = Command::new("kill").args(["-TERM", &node.id().to_string()]).status().unwrap();
    assert!(killed.success());
    assert!(lines.any(|line| line.contains("SIGTERM")), "the signal is reported");
    assert!(lines.any(|line| line.contains("summary in")));
    assert!(node.wait().unwrap().success());
    assert!(std::fs::read_to_string(dir.join("end.json")).unwrap().contains("\"digest\""));
    std::fs::remove_dir_all(&dir).unwrap();
}

fn node_process(config: &Path, log: &Path) -> Child {
    Command::new(std::env::current_exe().unwrap())
        .args(["--ignored", "--exact", "one_node", "--nocapture"])
        .env("FLOCKMAP_NODE_CONFIG", config)
        .stdout(Stdio::null())
        .stderr(std::fs::File::create(log).unwrap())
        .spawn()
        .unwrap()
}

/// A node that takes scans at `sensor.sock` in the folder. With `umask`, as a shell starts it that has this one.
struct SocketNode {
    process: Child,
    lines: Box<dyn Iterator<Item = String>>,
}

impl SocketNode {
    fn start(dir: &Path, id: u16, sensor: &str, umask: &str) -> Self {
        let path = dir.join(format!("robot{id}.toml"));
        let text = format!(
            "id = {id}\nepoch = 1\n[map]\nresolution_m = 0.2\nrange_m = 7.0\n[network]\nbind = \"127.0.0.1:0\"\n\
             [sensor]\nlisten_unix = \"sensor.sock\"\n{sensor}[metrics]\nstatus_period_s = 0.0\n\
             [output]\nreport_json = \"end{id}.json\"\nlinger_ms = 0\n"
        );
        std::fs::write(&path, text).unwrap();
        let mut process = Command::new("sh")
            .args(["-c", "umask \"$1\"; exec \"$0\" --ignored --exact one_node --nocapture"])
            .arg(std::env::current_exe().unwrap())
            .arg(umask)
            .env("FLOCKMAP_NODE_CONFIG", &path)
            .env_remove(flockmap_node::KEY_VARIABLE)
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let lines = Box::new(BufReader::new(process.stderr.take().unwrap()).lines().map(Result::unwrap));
        Self { process, lines }
    }

    /// Reads on until a line with this text; `false` if the node ended before.
    fn says(&mut self, words: &str) -> bool {
        self.lines.any(|line| line.contains(words))
    }

    fn terminate(mut self) {
        let killed = Command::new("kill").args(["-TERM", &self.process.id().to_string()]).status().unwrap();
        assert!(killed.success() && self.process.wait().unwrap().success());
    }
}

impl Drop for SocketNode {
    fn drop(&mut self) {
        // Also after a test that failed nothing is left running.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

#[test]
fn a_second_node_leaves_the_sensor_socket_to_the_live_first() {
    let dir = new_dir("stolen-socket");
    let socket = dir.join("sensor.sock");
    let mut first = SocketNode::start(&dir, 1, "", "022");
    assert!(first.says("takes scans at"));
    let mut second = SocketNode::start(&dir, 2, "", "022");
    // It ends by itself, or says that it has taken the path.
    let words = format!("process {} (", first.process.id());
    let line = second.lines.find(|line| line.contains("takes scans at") || line.contains("listens there"));
    let line = line.unwrap();
    assert!(line.contains(&words) && line.contains("stop it") && line.contains("sensor.sock"), "{line}");
    assert!(!second.process.wait().unwrap().success());
    // The first has lost nothing.
    drop(std::os::unix::net::UnixStream::connect(&socket).unwrap());
    assert!(first.says("sensor connection 2 ended after 0 messages"), "the second node only looked");
    first.terminate();
    assert!(!socket.exists(), "removed by the one it belongs to");
    std::fs::remove_dir_all(&dir).unwrap();
}

#[test]
fn a_node_that_ends_leaves_the_socket_that_is_another_s_by_now() {
    let dir = new_dir("another-socket");
    let socket = dir.join("sensor.sock");
    let mut first = SocketNode::start(&dir, 1, "", "022");
    assert!(first.says("takes scans at"));
    std::fs::remove_file(&socket).unwrap();
    let mut second = SocketNode::start(&dir, 2, "", "022");
    assert!(second.says("takes scans at"));
    first.terminate();
    drop(std::os::unix::net::UnixStream::connect(&socket).expect("the second's"));
    assert!(second.says("sensor connection 1 ended"));
    // Killed, it can remove nothing; the next one takes the path over.
    second.process.kill().unwrap();
    second.process.wait().unwrap();
    assert!(socket.exists());
    let mut third = SocketNode::start(&dir, 3, "", "022");
    assert!(third.says("takes scans at"));
    third.terminate();
    std::fs::remove_dir_all(&dir).unwrap();
}

#[test]
fn the_sensor_socket_has_the_configured_mode_under_any_umask() {
    use std::os::unix::fs::PermissionsExt;
    let dir = new_dir("socket-mode");
    for (umask, option, mode) in [
        ("000", "", 0o600),
        ("022", "", 0o600),
        ("077", "unix_mode = \"0660\"\n", 0o660),
        ("177", "unix_mode = \"0660\"\n", 0o660),
        ("000", "unix_mode = \"0660\"\n", 0o660),
    ] {
        let mut node = SocketNode::start(&dir, 1, option, umask);
        assert!(node.says("takes scans at"));
        let file = std::fs::symlink_metadata(dir.join("sensor.sock")).unwrap();
        assert_eq!(file.permissions().mode() & 0o777, mode, "umask {umask} {option}");
        node.terminate();
    }
    std::fs::remove_dir_all(&dir).unwrap();
}

#[test]
fn a_killed_node_has_its_map_again_and_asks_only_for_what_it_misses() {
    let dir = new_dir("killed-node");
    write_record(&dir, 4.0);
    // A team-mate in this process, that hears all and sees nothing.
    let sockets = UdpSockets::bind(&UdpOptions::new(loopback())).unwrap();
    let address = sockets.local_addr().unwrap();
    let mate = Node::start(NodeOptions::new(config(2)), move || sockets.into_transport()).unwrap();
    // Stream, digest of its layer, packages received.
    let own_streams = || -> Vec<(Stream, u64, u64)> {
        let read = |robot: &mut flockmap::Robot| {
            let of_one = robot.fusion().layers().filter(|(stream, _)| stream.origin == RobotId(1));
            let received = |stream| robot.session().received(stream).map_or(0, |received| received.count());
            of_one.map(|(stream, layer)| (stream, layer.digest(), received(stream))).collect()
        };
        mate.with_robot(move |robot, _| read(robot)).unwrap()
    };
    let path = dir.join("robot.toml");
    let write_config = |sensor: &str| {
        let text = format!(
            "id = 1\n[map]\nresolution_m = 0.2\nrange_m = 7.0\n[batch]\npublish_period_ms = 100\n[state]\npath = \"state\"\n[network]\nbind = \"127.0.0.1:0\"\n\
             peers = [\"{address}\"]\n[store]\npath = \"store\"\nsync_ms = 100\n[metrics]\nstatus_period_s = 0.0\n\
             [output]\nreport_json = \"end.json\"\n{sensor}"
        );
        std::fs::write(&path, text).unwrap();
    };

    write_config("[sensor]\nrecord = \"robot1.mcap\"\n");
    let mut first = node_process(&path, &dir.join("first.log"));
    wait_until("some batches of the flight are with the team-mate", || {
        own_streams().first().is_some_and(|(_, _, received)| *received >= 15)
    });
    // SIGKILL: it can do nothing more.
    first.kill().unwrap();
    assert!(!first.wait().unwrap().success());
    std::thread::sleep(std::time::Duration::from_millis(300));
    let (before, came_first) = (own_streams(), mate.status().unwrap().node.bytes_in);
    assert_eq!(before.len(), 1);

    write_config("end_after_s = 4.0\n");
    let mut second = node_process(&path, &dir.join("second.log"));
    assert!(second.wait().unwrap().success());
    let log = std::fs::read_to_string(dir.join("second.log")).unwrap();
    assert!(log.contains("packages of former runs read"), "{log}");
    let end: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(dir.join("end.json")).unwrap()).unwrap();
    let (stream, _, received) = before[0];
    assert!(end["epoch"].as_u64().unwrap() > stream.epoch);
    let streams = end["streams"].as_array().unwrap();
    let former = streams.iter().find(|s| s["epoch"] == stream.epoch).unwrap();
    // The team-mate may have got the end of the last batch from the restarted robot, or the reverse.
    let now = own_streams().into_iter().find(|(of, _, _)| *of == stream).unwrap();
    assert_eq!(former["digest"], format!("{:016x}", now.1), "equal at both");
    assert!(now.2 >= received, "{now:?}, {received} before");
    assert_eq!(former["missing"], 0);
    let map = end["map_free"].as_u64().unwrap() + end["map_occupied"].as_u64().unwrap();
    assert_eq!(map, former["voxels"].as_u64().unwrap(), "its map is what it saw before");
    let counters = &end["counters"];
    let restored = counters["store"]["restored"].as_u64().unwrap();
    let came = counters["node"]["bytes_in"].as_u64().unwrap();
    println!("{came_first} B flew before; {restored} packages restored, {came} B came after the restart");
    assert!(restored >= 10, "{counters}");
    assert!(came * 4 < came_first, "{came} of {came_first} B");
    mate.stop();
    drop(mate.join());
    std::fs::remove_dir_all(&dir).unwrap();
}

/// Runs a robot for a moment; returns its summary and what it said.
fn moment(dir: &Path, rest: &str) -> (serde_json::Value, String) {
    let text = format!(
        "id = 1\n{rest}[map]\nresolution_m = 0.2\nrange_m = 7.0\n[network]\nbind = \"127.0.0.1:0\"\n[metrics]\nstatus_period_s = 0.0\n\
         [output]\nreport_json = \"end.json\"\nend_after_s = 0.05\nlinger_ms = 0\n"
    );
    let (path, log) = (dir.join("robot.toml"), dir.join("node.log"));
    std::fs::write(&path, text).unwrap();
    let ended = node_process(&path, &log).wait().unwrap();
    let log = std::fs::read_to_string(log).unwrap();
    assert!(ended.success(), "{log}");
    (serde_json::from_str(&std::fs::read_to_string(dir.join("end.json")).unwrap()).unwrap(), log)
}

#[test]
fn each_start_has_an_epoch_above_the_last_whatever_the_clock_shows() {
    let dir = new_dir("epochs");
    let file = dir.join("state/epoch-0-1");
    // In place of the clock, so that it can fall back.
    let boot = |clock: &str, parts: &str| {
        let (end, log) = moment(&dir, &format!("{clock}{parts}"));
        (end["epoch"].as_u64().unwrap(), log)
    };
    let state = "[state]\npath = \"state\"\n";
    let store = "[state]\npath = \"state\"\n[store]\npath = \"store\"\n";
    let mut last = 0;
    for (clock, parts, high) in [
        ("epoch = 70\n", state, 70),
        ("epoch = 70\n", state, 71),
        ("epoch = 5\n", state, 72),
        ("epoch = 90\n", store, 90),
        ("epoch = 90\n", store, 91),
    ] {
        let (epoch, log) = boot(clock, parts);
        assert_eq!(epoch >> 32, high, "{log}");
        assert!(epoch > last && !log.contains("warning: store"), "{log}");
        last = epoch;
    }
    // Each of file and store knows it.
    std::fs::remove_file(&file).unwrap();
    assert_eq!(boot("epoch = 5\n", store).0 >> 32, 92);
    std::fs::remove_dir_all(dir.join("store")).unwrap();
    assert_eq!(boot("epoch = 5\n", store).0 >> 32, 93);
    // A damaged file is said and replaced.
    std::fs::write(&file, "nonsense").unwrap();
    let (epoch, log) = boot("epoch = 80\n", state);
    assert!(epoch >> 32 == 80 && log.contains("epoch-0-1 has another length than an epoch file"), "{log}");
    assert_eq!(boot("epoch = 5\n", state).0 >> 32, 81);
    // And by the clock.
    let now = || std::time::SystemTime::UNIX_EPOCH.elapsed().unwrap().as_secs();
    let began = now();
    let epoch = boot("", state).0;
    assert!((began..=now()).contains(&(epoch >> 32)), "{epoch}");

    // Where there is no higher one, it says what to remove.
    let folder = Arc::new(Folder::open(dir.join("state")).unwrap());
    EpochFile::open(folder, 0, RobotId(1)).0.keep(u64::MAX).unwrap();
    let error = format!("{:#}", flockmap_node::run(&dir.join("robot.toml")).unwrap_err());
    assert!(error.contains("remove") && error.contains("state/epoch-0-1"), "{error}");
    std::fs::remove_dir_all(&dir).unwrap();
}

#[test]
fn folders_on_a_disk_that_fails_are_said_and_the_robot_flies() {
    let dir = new_dir("no-folders");
    // Where nobody can make a folder.
    let (end, log) = moment(&dir, "[state]\npath = \"/proc/state\"\n[store]\npath = \"/proc/store\"\n");
    assert!(
        log.contains("cannot make the folder") && log.contains("[state] path names another folder"),
        "{log}"
    );
    assert!(log.contains("cannot open the folder") && log.contains("flies on in memory"), "{log}");
    assert_eq!(end["counters"]["store"]["failures"], 1);
    std::fs::remove_dir_all(&dir).unwrap();
}

#[test]
fn a_path_at_which_there_can_be_no_folder_is_refused_before_an_epoch_is_used_up() {
    let dir = new_dir("mistaken-folders");
    std::fs::write(dir.join("file"), "no folder").unwrap();
    let path = dir.join("robot.toml");
    for (parts, key) in [
        ("[state]\npath = \"file\"\n", "line 8: [state] path is"),
        ("[state]\npath = \"file/state\"\n", "line 8: [state] path is"),
        ("[state]\npath = \"state\"\n[store]\npath = \"file/store\"\n", "line 10: [store] path is"),
    ] {
        let text = format!(
            "id = 1\n[map]\nresolution_m = 0.2\nrange_m = 7.0\n[network]\nbind = \"127.0.0.1:0\"\n{parts}"
        );
        std::fs::write(&path, text).unwrap();
        let error = format!("{:#}", flockmap_node::run(&path).unwrap_err());
        assert!(error.contains(key) && error.contains("expected a folder"), "{error}");
        assert!(!dir.join("state/epoch-0-1").exists());
    }
    std::fs::remove_dir_all(&dir).unwrap();
}

#[test]
fn a_node_that_cannot_run_says_why() {
    let dir = new_dir("no-node");
    let path = dir.join("robot.toml");
    let run = |rest: &str| {
        let text =
            format!("id = 1\n[map]\nresolution_m = 0.2\nrange_m = 7.0\n[state]\npath = \"state\"\n{rest}");
        std::fs::write(&path, text).unwrap();
        flockmap_node::run(&path).unwrap_err().to_string()
    };
    let error = run("[sensor]\nrecod = \"x.mcap\"\n");
    assert!(error.contains("robot.toml") && error.ends_with("did you mean `record`?"), "{error}");
    let error = run("[sensor]\nrecord = \"x.mcap\"\n");
    assert!(error.contains("x.mcap"), "{error}");
    let error = run("[sensor]\nrecord = \"x.mcap\"\nlisten_tcp = \"127.0.0.1:0\"\n");
    assert!(error.contains("expected one of them"), "{error}");
    let error = run("[output]\nsave_map_at_end = \"map.obj\"\n");
    assert!(error.contains(".ply, .pcd or .bt"), "{error}");
    let error = run("[output]\nend_after_s = 0.0\nreport_json = \"missing/end.json\"\n");
    assert!(error.contains("[output] report_json") && error.contains("mkdir -p"), "{error}");
    std::fs::create_dir_all(dir.join("folder.ply")).unwrap();
    let error = run("[output]\nend_after_s = 0.0\nsave_map_at_end = \"folder.ply\"\n");
    assert!(error.contains("this is a folder"), "{error}");
    let error = run("[sensor]\nlisten_unix = \"missing/sensor.sock\"\n[network]\nbind = \"127.0.0.1:0\"\n");
    assert!(error.contains("missing/sensor.sock") && error.contains("mkdir -p"), "{error}");
    let error = run("[sensor]\nlisten_unix = \"sensor.sock\"\nunix_mode = \"660 \"\n");
    assert!(error.contains("[sensor] unix_mode"), "{error}");
    let error = run("[session]\nswarm_key_file = \"no.key\"\n");
    assert!(error.contains(&format!("{}", dir.join("no.key").display())), "{error}");
    let error = run("[session]\nswarm_key = \"too short\"\n");
    assert!(error.contains("[session] swarm_key") && error.contains("9 characters"), "{error}");
    let error = run("[network]\nbind = \"192.0.2.1:7700\"\n");
    assert!(error.contains("192.0.2.1:7700"), "{error}");
    std::fs::remove_dir_all(&dir).unwrap();
}
