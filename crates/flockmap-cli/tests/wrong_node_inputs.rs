//! What a user may get wrong about a node, and what the program says to it: each message names the file, the
//! line, the key, what was got and what would work.

mod common;

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream, UdpSocket};
use std::path::Path;
use std::process::{Command, Stdio};

/// A configuration that cannot work, and what of the message must be there. `USED` stands for a UDP port and
/// `TAKEN` for a TCP port of this machine that another program has.
struct Wrong {
    what: &'static str,
    config: &'static str,
    says: &'static [&'static str],
}

const fn wrong(what: &'static str, config: &'static str, says: &'static [&'static str]) -> Wrong {
    Wrong { what, config, says }
}

/// `[map]` comes first, so that a case may go on in it. What is right about them all stands in four lines.
const RIGHT: &str = "id = 1\n[map]\nresolution_m = 0.1\nrange_m = 7.0\n";

/// The file as it stands.
const FILES: &[Wrong] = &[
    wrong("empty", "", &["there is no id", "`id = 1`"]),
    wrong("no section [map]", "id = 1\n", &["no section [map]", "resolution_m and range_m"]),
    wrong("a key missing", "id = 1\n[map]\nresolution_m = 0.1\n", &["line 2: [map] has no range_m"]),
    wrong("another format", "id: 1\nmap:\n  range_m: 7\n", &["line 1: `id: 1`", "expected `=`"]),
    wrong("binary", "\u{0}\u{1}PNG", &["line 1"]),
    wrong("wrong type", "id = \"one\"\n", &["line 1: id is \"one\", expected a whole number, 0 to 65,535"]),
    wrong("too large", "id = 70000\n", &["line 1: id is 70000, expected a whole number, 0 to 65,535"]),
    wrong("no section", "id = 1\nmap = 0.1\n", &["line 2: map is 0.1, expected a section"]),
    wrong(
        "wrong unit",
        "id = 1\n[map]\nresolution_m = \"10 cm\"\nrange_m = 7\n",
        &["line 3: [map] resolution_m is \"10 cm\", expected a number"],
    ),
    wrong(
        "zero",
        "id = 1\n[map]\nresolution_m = 0\nrange_m = 7\n",
        &["line 3: [map] resolution_m is 0", "0.001 to 100"],
    ),
    wrong(
        "negative",
        "id = 1\n[map]\nresolution_m = 0.1\nrange_m = -7\n",
        &["line 4: [map] range_m is -7, expected more than 0 and at most 50"],
    ),
    wrong(
        "out of range",
        "id = 1\n[map]\nresolution_m = 0.1\nrange_m = 60\n",
        &["line 4: [map] range_m is 60, expected more than 0 and at most 50"],
    ),
];

/// What follows [`RIGHT`], from line 5 on.
const CONFIGS: &[Wrong] = &[
    wrong("truncated", "[network", &["line 5: `[network`", "expected `]`"]),
    wrong("a key twice", "range_m = 8.0\n", &["line 5: `range_m = 8.0`: duplicate key"]),
    wrong(
        "a typing error",
        "rnage_m = 7\n",
        &["line 5: `rnage_m` is no key of [map], did you mean `range_m`?"],
    ),
    wrong(
        "a key in the wrong section",
        "peers = []\n",
        &["line 5: `peers` is no key of [map], but of [network]"],
    ),
    wrong("a section with a typing error", "[sesion]\n", &["line 5: `sesion`", "did you mean `session`?"]),
    wrong(
        "an old name",
        "[batch]\nt_l_ms = 500\n",
        &["line 6: `t_l_ms`", "is called `publish_period_ms` now"],
    ),
    wrong(
        "no such mapper",
        "mapper = \"octmap\"\n",
        &["[map] mapper is \"octmap\"", "did you mean `octomap`?"],
    ),
    wrong(
        "not below the range",
        "range_min_m = 7.5\n",
        &["line 5: [map] range_min_m is 7.5", "less than range_m"],
    ),
    wrong(
        "percent",
        "p_hit = 90\n",
        &["line 5: [map] p_hit is 90, expected a probability of 0.001 to 0.999"],
    ),
    wrong("the wrong way round", "p_hit = 0.4\n", &["line 5: [map] p_hit is 0.4, expected more than 0.5"]),
    wrong(
        "too few numbers",
        "update_box_m = [1.0, 2.0]\n",
        &["line 5: [map] update_box_m", "a list of 3 numbers"],
    ),
    wrong(
        "no batch at all",
        "[batch]\nvoxels_max = 0\n",
        &["line 6: [batch] voxels_max is 0, expected at least 1"],
    ),
    wrong(
        "seconds",
        "[batch]\npublish_period_ms = 0.5\n",
        &["line 6: [batch] publish_period_ms is 0.5", "whole"],
    ),
    wrong(
        "too little",
        "[session]\nbudget_kb_s = 0.01\n",
        &["[session] budget_kb_s is 0.01", "or at least 0.02"],
    ),
    wrong("no such rule", "[session]\nrelay = \"all\"\n", &["[session] relay is \"all\"", "`ranked`"]),
    wrong("half a key", "[session]\nswarm_key = \"abc\"\n", &["line 6: [session] swarm_key", "3 characters"]),
    wrong(
        "a key that is no text",
        "[session]\nswarm_key = 12345\n",
        &["line 6: [session] swarm_key is no text"],
    ),
    wrong(
        "no key file",
        "[session]\nswarm_key_file = \"no.key\"\n",
        &["line 6: [session] swarm_key_file", "no.key", "expected a file that can be read"],
    ),
    wrong(
        "a name",
        "[network]\nbind = \"localhost\"\n",
        &["line 6: [network] bind is \"localhost\"", "ADDRESS:PORT"],
    ),
    wrong(
        "somebody else's address",
        "[network]\nbind = \"192.0.2.1:7700\"\n",
        &["line 6: ", "192.0.2.1:7700", "no interface of this machine has that address", "[network] bind"],
    ),
    wrong(
        "a port in use",
        "[network]\nbind = \"127.0.0.1:USED\"\n",
        &["line 6: ", "another program listens there", "another port in [network] bind"],
    ),
    wrong(
        "no port",
        "[network]\nbind = \"127.0.0.1:0\"\npeers = [\"10.0.0.2\"]\n",
        &["line 7: [network] peers has \"10.0.0.2\"", "NAME:PORT"],
    ),
    wrong(
        "itself",
        "[network]\nbind = \"0.0.0.0:FREE\"\npeers = [\"127.0.0.1:FREE\"]\n",
        &["line 7: [network] peers has 127.0.0.1:", "which is this robot itself"],
    ),
    wrong(
        "the same robot twice",
        "[network]\nbind = \"127.0.0.1:0\"\npeers = [\"10.0.0.2:7700\", \"10.0.0.2:7700\"]\n",
        &["line 7: [network] peers has 10.0.0.2:7700 twice"],
    ),
    wrong(
        "nobody's address",
        "[network]\nbind = \"127.0.0.1:0\"\npeers = [\"0.0.0.0:7700\"]\n",
        &["line 7: [network] peers has 0.0.0.0:7700, expected the address of another robot"],
    ),
    wrong(
        "a group that is none",
        "[network]\nbind = \"127.0.0.1:0\"\nmulticast = \"10.0.0.1:7700\"\n",
        &["line 7: [network] multicast is 10.0.0.1:7700, expected a group: 224.0.0.0"],
    ),
    wrong(
        "two ways to everybody",
        "[network]\nbroadcast = \"10.0.0.255:7700\"\nmulticast = \"239.77.0.1:7700\"\n",
        &["line 6: [network] broadcast is given, and [network] multicast too, expected one of them"],
    ),
    wrong(
        "not applicable",
        "[sensor]\nspeed = 2.0\n",
        &["line 6: [sensor] speed is given, expected [sensor] record beside it"],
    ),
    wrong(
        "no record",
        "[sensor]\nrecord = \"no.mcap\"\n",
        &["line 6: [sensor] record", "no.mcap", "No such file"],
    ),
    wrong(
        "an empty record",
        "[sensor]\nrecord = \"empty.mcap\"\n",
        &["[sensor] record", "expected an MCAP file"],
    ),
    wrong("a truncated record", "[sensor]\nrecord = \"cut.mcap\"\n", &["[sensor] record", "ends too early"]),
    wrong(
        "no record at all",
        "[sensor]\nrecord = \"robot.toml\"\n",
        &["[sensor] record", "an .mcap file, a rosbag2 folder"],
    ),
    wrong(
        "standing still",
        "[sensor]\nrecord = \"no.mcap\"\nspeed = 0\n",
        &["line 7: [sensor] speed is 0, expected more than 0"],
    ),
    wrong(
        "two sensors",
        "[sensor]\nrecord = \"no.mcap\"\nlisten_tcp = \"127.0.0.1:0\"\n",
        &["line 6: [sensor] record is given, and [sensor] listen_tcp too, expected one of them"],
    ),
    wrong(
        "no permissions",
        "[sensor]\nlisten_unix = \"s.sock\"\nunix_mode = \"rw\"\n",
        &["line 7: [sensor] unix_mode is \"rw\"", "\"0600\""],
    ),
    wrong(
        "no folder for the socket",
        "[network]\nbind = \"127.0.0.1:0\"\n[sensor]\nlisten_unix = \"no/s.sock\"\n",
        &["line 8: ", "there is no folder", "mkdir -p", "[sensor] listen_unix"],
    ),
    wrong(
        "no permissions for readers",
        "[map_output]\nlisten_unix = \"m.sock\"\nunix_mode = \"077\"\n",
        &["line 7: [map_output] unix_mode is \"077\"", "\"0600\""],
    ),
    wrong(
        "no readers",
        "[map_output]\nlisten_unix = \"m.sock\"\nreaders_max = 0\n",
        &["line 7: [map_output] readers_max is 0, expected 1 to 1,024"],
    ),
    wrong(
        "no period",
        "[map_output]\nlisten_tcp = \"127.0.0.1:0\"\nperiod_ms = 0\n",
        &["line 7: [map_output] period_ms is 0, expected 1 to 60,000"],
    ),
    wrong(
        "readers of nothing",
        "[map_output]\nreaders_max = 3\n",
        &[
            "line 6: [map_output] readers_max is given, expected [map_output] listen_unix or [map_output] listen_tcp",
        ],
    ),
    wrong(
        "no folder for the map's socket",
        "[network]\nbind = \"127.0.0.1:0\"\n[map_output]\nlisten_unix = \"no/m.sock\"\n",
        &["line 8: ", "there is no folder", "mkdir -p", "[map_output] listen_unix"],
    ),
    wrong(
        "a TCP port in use for the map",
        "[network]\nbind = \"127.0.0.1:0\"\n[map_output]\nlisten_tcp = \"127.0.0.1:TAKEN\"\n",
        &["line 8: ", "another program listens there", "[map_output] listen_tcp"],
    ),
    wrong(
        "a TCP port in use",
        "[network]\nbind = \"127.0.0.1:0\"\n[sensor]\nlisten_tcp = \"127.0.0.1:TAKEN\"\n",
        &["line 8: ", "another program listens there", "[sensor] listen_tcp"],
    ),
    wrong(
        "a port for counters in use",
        "[network]\nbind = \"127.0.0.1:0\"\n[metrics]\nprometheus = \"127.0.0.1:TAKEN\"\n",
        &["line 8: ", "another program listens there", "[metrics] prometheus"],
    ),
    wrong(
        "a file in place of the store",
        "[network]\nbind = \"127.0.0.1:0\"\n[store]\npath = \"robot.toml\"\n",
        &["line 8: [store] path is", "expected a folder that this user may make and write to"],
    ),
    wrong(
        "a store too small",
        "[store]\npath = \"store\"\nbytes_max = 100\n",
        &["line 7: [store] bytes_max is 100, expected at least 65536"],
    ),
    wrong(
        "a folder below a file",
        "[network]\nbind = \"127.0.0.1:0\"\n[state]\npath = \"robot.toml/state\"\n",
        &["line 8: [state] path is", "Not a directory", "expected a folder"],
    ),
    wrong(
        "no such map",
        "[output]\nsave_map_at_end = \"map.stl\"\n",
        &["line 6: [output] save_map_at_end is", ".ply"],
    ),
    wrong(
        "no folder for the map",
        "[output]\nsave_map_at_end = \"no/map.ply\"\n",
        &["line 6: [output] save_map_at_end is", "no/map.ply", "mkdir -p"],
    ),
    wrong(
        "a folder in place of the map",
        "[output]\nsave_map_at_end = \"folder.ply\"\n",
        &["line 6: [output] save_map_at_end is", "expected a file, and this is a folder"],
    ),
    wrong(
        "not writable",
        "[output]\nreport_json = \"/proc/report.json\"\n",
        &["line 6: [output] report_json is /proc/report.json", "a file that this user may write"],
    ),
    wrong(
        "one file for both",
        "[output]\nsave_map_at_end = \"a.ply\"\nreport_json = \"a.ply\"\n",
        &["line 7: [output] report_json is", "another file than save_map_at_end"],
    ),
    wrong(
        "in the past",
        "[output]\nend_after_s = -1\n",
        &["line 6: [output] end_after_s is -1, expected seconds, 0"],
    ),
    wrong(
        "never quiet",
        "[sensor]\nlisten_tcp = \"127.0.0.1:0\"\n[output]\nend_when_quiet_s = 1.0\n",
        &["line 8: [output] end_when_quiet_s is given", "scans may always come"],
    ),
    wrong(
        "no robot",
        "[alignment.two]\nyaw_deg = 1.0\n",
        &["line 5: [alignment.two] is for no robot", "its id"],
    ),
    wrong(
        "no rotation",
        "[alignment.2]\nquaternion_xyzw = [0.0, 0.0, 0.0, 0.0]\n",
        &["line 6: [alignment.2] quaternion_xyzw is [0.0, 0.0, 0.0, 0.0]", "not all 0"],
    ),
    wrong(
        "two rotations",
        "[alignment.2]\nyaw_deg = 1.0\nquaternion_xyzw = [0.0, 0.0, 0.0, 1.0]\n",
        &["line 6: [alignment.2] yaw_deg is given, and quaternion_xyzw too, expected one of them"],
    ),
    wrong(
        "no number",
        "[clock_offset_ms]\n2 = nan\n",
        &["line 6: [clock_offset_ms] 2 is NaN, expected a finite number"],
    ),
];

#[test]
fn whatever_is_wrong_with_a_configuration_is_said_with_its_place_and_what_would_work() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    fs::write(dir.join("empty.mcap"), "").unwrap();
    fs::write(dir.join("cut.mcap"), b"\x89MCAP0\r\n\x01\x05\x00\x00").unwrap();
    fs::create_dir(dir.join("folder.ply")).unwrap();
    let used = UdpSocket::bind("127.0.0.1:0").unwrap();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let ports = [
        ("USED", used.local_addr().unwrap().port()),
        ("TAKEN", taken.local_addr().unwrap().port()),
        ("FREE", UdpSocket::bind("0.0.0.0:0").unwrap().local_addr().unwrap().port()),
    ];
    let files = FILES.iter().map(|wrong| (wrong, wrong.config.to_owned()));
    let configs = CONFIGS.iter().map(|wrong| (wrong, format!("{RIGHT}{}", wrong.config)));
    let mut faults = Vec::new();
    for (Wrong { what, says, .. }, mut config) in files.chain(configs) {
        for (name, port) in &ports {
            config = config.replace(name, &port.to_string());
        }
        fs::write(dir.join("robot.toml"), config).unwrap();
        let message = refusal(dir);
        let mut parts = vec!["error: "];
        parts.extend(*says);
        for part in parts.iter().filter(|part| !message.contains(**part)) {
            faults.push(format!("{what}: no \"{part}\" in: {message}"));
        }
        if !message.contains("robot.toml: ") {
            faults.push(format!("{what}: which file? {message}"));
        }
        faults.extend(flaw(&message).map(|flaw| format!("{what}: {flaw}: {message}")));
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

/// What the program says where it does not start; without what it says of its own.
fn refusal(dir: &Path) -> String {
    let output = node(dir).output().unwrap();
    let text = String::from_utf8(output.stderr).unwrap();
    let lines = text.lines().filter(|line| !line.starts_with("robot1: "));
    let message = lines.collect::<Vec<_>>().join("\n");
    assert_eq!(output.status.code(), Some(2), "{message}");
    message
}

fn node(dir: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_flockmap"));
    command.args(["node", "--config"]).arg(dir.join("robot.toml")).env_remove("FLOCKMAP_SWARM_KEY");
    command.env("HOME", dir).env("TMPDIR", dir.join("temporary"));
    command
}

/// What no message for a user may have: names of Rust, a value as the debugger shows it, the same text twice.
fn flaw(message: &str) -> Option<String> {
    // The address that binds all of IPv6.
    let message = message.replace("[::]", "");
    for dump in ["::", "Some(", "None", "Err(", "{ ", "f64", "u16", "u32", "usize", "struct "] {
        if message.contains(dump) {
            return Some(format!("shows \"{dump}\""));
        }
    }
    let words: Vec<&str> = message.split_whitespace().collect();
    let said: Vec<String> = words.windows(4).map(|four| four.join(" ")).collect();
    let is_text = |text: &str| text.contains(char::is_alphabetic);
    let twice = said.iter().enumerate().find(|(at, text)| is_text(text) && said[at + 1..].contains(text));
    twice.map(|(_, text)| format!("says \"{text}\" twice"))
}

#[test]
fn the_check_of_messages_finds_what_it_looks_for() {
    let system = "No such file or directory (os error 2)";
    assert!(flaw(&format!("cannot read a.toml: {system}: {system}")).unwrap().contains("twice"));
    assert!(flaw("store is of Identity { swarm: 0 }").is_some() && flaw("flockmap::Robot refused").is_some());
    assert_eq!(flaw("robot.toml: line 4: [map] range_m is -7, expected more than 0"), None);
}

#[test]
fn a_configuration_that_is_not_there_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let message = refusal(folder.path());
    assert!(message.contains("robot.toml") && message.contains("No such file"), "{message}");
    assert_eq!(flaw(&message), None);
}

#[test]
fn a_store_in_use_or_of_another_robot_is_not_opened() {
    use flockmap::{Resolution, RobotId};
    use flockmap_node::store::{Identity, Store, StoreOptions};
    let folder = tempfile::tempdir().unwrap();
    let identity =
        Identity { swarm: 3, robot: RobotId(9), resolution: Resolution::from_metres(0.25).unwrap() };
    let open = || Store::open_folder(folder.path().join("store"), identity, StoreOptions::default());
    let mut store = open().unwrap().start(7).unwrap();
    store.sync();
    let config = format!("{RIGHT}[network]\nbind = \"127.0.0.1:0\"\n[store]\npath = \"store\"\n");
    fs::write(folder.path().join("robot.toml"), config).unwrap();
    let check = |parts: [&str; 2]| {
        let message = refusal(folder.path());
        assert!(message.contains("line 8: [store] path"), "{message}");
        assert!(parts.iter().all(|part| message.contains(part)), "{message}");
        assert_eq!(flaw(&message), None, "{message}");
    };
    check(["is in use by another node", "a folder of its own"]);
    drop(store);
    check(["is of robot 9 of swarm 3 with voxels of 0.25 m", "this is robot 1 of swarm 0"]);
}

/// What a sensor program may send that is none of a scan, and what the node says to it.
#[test]
fn what_a_sensor_program_sends_wrongly_is_said() {
    use flockmap::{Pose, Scan, Stamp};
    use flockmap_node::{Frame, SensorMessage};
    let scan = |stamp| {
        let scan = Scan { stamp, points: vec![[1.0, 2.0, 3.0]], no_returns: Vec::new() };
        SensorMessage::Scan(Frame { scan, t_map_sensor: Pose::IDENTITY, points_dropped: 0 }).emit()
    };
    let good = scan(Stamp(0));
    let changed = |at: usize, bytes: &[u8]| {
        let mut message = good.clone();
        message[at..at + bytes.len()].copy_from_slice(bytes);
        message
    };
    let cases: [(&str, Vec<u8>, &[&str]); 10] = [
        (
            "another program",
            b"GET / HTTP/1.1\r\n\r\n".to_vec(),
            &["closed: message 1: length", "expected 8 to"],
        ),
        ("no length", good[4..].to_vec(), &["closed: message 1: length"]),
        ("another magic", changed(4, b"BLAB"), &["starts with \"BLAB\", expected \"FLKS\""]),
        ("another version", changed(8, &[9]), &["version 9, expected 1"]),
        (
            "no such kind",
            changed(9, &[8]),
            &[
                "kind 8, expected 1 (scan), 2 (alignment), 3 (team-mate), 4 (voxels), 5 (box), 6 (a submap begins) or",
            ],
        ),
        (
            "more points than there are",
            changed(76, &5u32.to_le_bytes()),
            &["bytes, expected", "by its kind and counts"],
        ),
        ("truncated", good[..40].to_vec(), &["ended after 36 of"]),
        (
            "no rotation",
            changed(44, &[0; 32]),
            &["the pose [", "is none", "a quaternion x y z w that is not 0"],
        ),
        ("no position", changed(20, &f64::NAN.to_le_bytes()), &["the pose [NaN", "expected finite x y z"]),
        (
            "another clock",
            scan(Stamp(5_000_000)),
            &["dropped: its stamp is off the system clock", "or 0 for now"],
        ),
    ];
    let folder = tempfile::tempdir().unwrap();
    let config = format!(
        "{RIGHT}[network]\nbind = \"127.0.0.1:0\"\n[sensor]\nlisten_tcp = \"127.0.0.1:0\"\n\
         [output]\nlinger_ms = 0\n[metrics]\nstatus_period_s = 0\n"
    );
    fs::write(folder.path().join("robot.toml"), config).unwrap();
    for (what, bytes, says) in cases {
        let mut node = node(folder.path()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
        let mut lines = BufReader::new(node.stderr.take().unwrap()).lines().map(Result::unwrap);
        let address = lines.find_map(|line| Some(line.split_once("takes scans at ")?.1.to_owned())).unwrap();
        let mut program = TcpStream::connect(address).unwrap();
        program.write_all(&bytes).unwrap();
        drop(program);
        let message = lines.find(|line| line.contains("sensor connection 1"));
        node.kill().unwrap();
        node.wait().unwrap();
        let message = message.unwrap_or_else(|| panic!("{what}: nothing is said"));
        assert!(says.iter().all(|part| message.contains(part)), "{what}: {message}");
        assert_eq!(flaw(&message), None, "{what}: {message}");
    }
}

#[test]
fn a_map_whose_folder_is_gone_at_the_end_is_saved_elsewhere_and_the_report_too() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    let out = dir.join("out");
    for name in ["out", "temporary"] {
        fs::create_dir(dir.join(name)).unwrap();
    }
    let config = format!(
        "{RIGHT}[network]\nbind = \"127.0.0.1:0\"\n[sensor]\nlisten_tcp = \"127.0.0.1:0\"\n\
         [output]\nsave_map_at_end = \"out/map.ply\"\nreport_json = \"out/end.json\"\nlinger_ms = 0\n"
    );
    fs::write(dir.join("robot.toml"), config).unwrap();
    let mut node = node(dir).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(node.stderr.take().unwrap()).lines().map(Result::unwrap);
    assert!(lines.any(|line| line.contains("takes scans at")));
    fs::remove_dir(&out).unwrap();
    let id = node.id().to_string();
    assert!(Command::new("kill").args(["-TERM", &id]).status().unwrap().success());
    let message = lines.find(|line| line.starts_with("error: ")).unwrap();
    assert_eq!(node.wait().unwrap().code(), Some(2));
    assert!(
        message.contains("[output] save_map_at_end") && message.contains("[output] report_json"),
        "{message}"
    );
    let saved: Vec<_> =
        fs::read_dir(dir.join("temporary")).unwrap().map(|entry| entry.unwrap().path()).collect();
    assert_eq!(saved.len(), 2, "{saved:?}");
    for path in saved {
        assert!(message.contains(&path.display().to_string()), "{message}");
        assert!(fs::metadata(&path).unwrap().len() > 50, "{}", path.display());
    }
}
