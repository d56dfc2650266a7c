//! Nodes from configuration files: in this process, and as processes of their own.
#![cfg(target_os = "linux")]

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;

use flockmap_io::RecordWriter;
use flockmap_sim::{Flight, Lidar, Patrol, PatrolOptions, ScanOptions, World};

/// Not a test: a node for the tests below, which run this executable again.
#[test]
#[ignore = "a node for the other tests"]
fn one_node() {
    if let Some(path) = std::env::var_os("FLOCKMAP_NODE_CONFIG") {
        flockmap_node::run(path.as_ref()).unwrap();
    }
}

fn new_dir(name: &str) -> PathBuf {
    let dir = std::env::temp_dir().join(format!("flockmap-{name}-{}", std::process::id()));
    std::fs::create_dir_all(&dir).unwrap();
    dir
}

/// A short flight through an office, thinned, as a record.
fn write_record(dir: &Path, seconds: f64) {
    let world = Arc::new(World::indoor(1));
    let options = PatrolOptions { duration_s: seconds, ..PatrolOptions::default() };
    let scan = ScanOptions { range_m: 7.0, ..ScanOptions::default() };
    let patrol = Patrol::plan(&world, 1, 1, &options).unwrap().remove(0);
    let mut writer = RecordWriter::create(dir.join("robot1.mcap"), "robot1").unwrap();
    for frame in Flight::new(world, Lidar::Mid360, scan, patrol).step_by(2) {
        writer.write(&frame.scan, &frame.t_map_sensor).unwrap();
    }
    writer.finish().unwrap();
}

#[test]
fn a_robot_plays_its_record_and_leaves_a_map_and_a_summary() {
    let dir = new_dir("one-node");
    write_record(&dir, 1.0);
    let text = "id = 7\n[map]\nresolution_m = 0.2\nrange_m = 7.0\n[network]\nbind = \"127.0.0.1:0\"\n\
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
    assert_eq!(summary["streams"][0]["held"], serde_json::json!([[1, packages]]));
    let map = flockmap_io::read_cloud(dir.join("map.ply")).unwrap();
    assert_eq!(map.points.len() as u64, summary["map_occupied"].as_u64().unwrap());
    std::fs::remove_dir_all(&dir).unwrap();
}

#[test]
fn a_terminated_node_ends_cleanly() {
    let dir = new_dir("terminated-node");
    let path = dir.join("robot.toml");
    let text = "id = 1\n[map]\nresolution_m = 0.2\nrange_m = 7.0\n[network]\nbind = \"127.0.0.1:0\"\n\
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
    assert!(lines.any(|line| line.contains("SIGTERM")), "the signal is told");
    assert!(lines.any(|line| line.contains("summary in")));
    assert!(node.wait().unwrap().success());
    assert!(std::fs::read_to_string(dir.join("end.json")).unwrap().contains("\"digest\""));
    std::fs::remove_dir_all(&dir).unwrap();
}

#[test]
fn a_node_that_cannot_run_says_why() {
    let dir = new_dir("no-node");
    let path = dir.join("robot.toml");
    let run = |rest: &str| {
        let text = format!("id = 1\nepoch = 1\n[map]\nresolution_m = 0.2\nrange_m = 7.0\n{rest}");
        std::fs::write(&path, text).unwrap();
        flockmap_node::run(&path).unwrap_err().to_string()
    };
    let error = run("[sensor]\nrecod = \"x.mcap\"\n");
    assert!(error.contains("robot.toml") && error.ends_with("did you mean `record`?"), "{error}");
    let error = run("[sensor]\nrecord = \"x.mcap\"\n");
    assert!(error.contains("x.mcap"), "{error}");
    let error = run("[sensor]\nrecord = \"x.mcap\"\nlisten_tcp = \"127.0.0.1:0\"\n");
    assert!(error.contains("more than one"), "{error}");
    let error = run("[output]\nsave_map_at_end = \"map.obj\"\n");
    assert!(error.contains(".ply, .pcd or .bt"), "{error}");
    let error = run("[session]\nswarm_key_file = \"no.key\"\n");
    assert!(error.contains(&format!("{}", dir.join("no.key").display())), "{error}");
    let error = run("[session]\nswarm_key = \"too short\"\n");
    assert!(error.contains("[session] swarm_key") && error.contains("9 characters"), "{error}");
    let error = run("[network]\nbind = \"192.0.2.1:7700\"\n");
    assert!(error.contains("192.0.2.1:7700"), "{error}");
    std::fs::remove_dir_all(&dir).unwrap();
}
