//! Three `flockmap node` processes in three network namespaces (`tests/netns/three_nodes.sh`), one killed in
//! mid-flight.
#![cfg(target_os = "linux")]

use std::path::Path;
use std::process::Command;
use std::sync::Arc;

use flockmap_io::RecordWriter;
use flockmap_worlds::{Flight, Lidar, ScanOptions, Trajectory, TrajectoryOptions, World};

const SECONDS: f64 = 8.0;
const KILL_AFTER_S: f64 = 4.0;
const DOWN_S: f64 = 2.0;

/// Short flights through an office, thinned, as records.
fn write_records(dir: &Path, robots: usize, seconds: f64) {
    let world = Arc::new(World::indoor(1));
    let options = TrajectoryOptions { duration_s: seconds, ..TrajectoryOptions::default() };
    let scan = ScanOptions { range_m: 7.0, ..ScanOptions::default() };
    for (k, trajectory) in Trajectory::plan(&world, robots, 1, &options).unwrap().into_iter().enumerate() {
        let name = format!("robot{}", k + 1);
        let mut writer = RecordWriter::create(dir.join(format!("{name}.mcap")), &name).unwrap();
        for frame in Flight::new(Arc::clone(&world), Lidar::Mid360, scan, trajectory).step_by(2) {
            let mut scan = frame.scan;
            scan.points = scan.points.into_iter().step_by(10).collect();
            writer.write(&scan, &frame.t_map_sensor).unwrap();
        }
        writer.finish().unwrap();
    }
}

fn write_config(dir: &Path, run: &str, robot: u16, start_s: f64) {
    let peers: Vec<String> =
        (1..=3).filter(|n| *n != robot).map(|n| format!("\"10.77.0.{n}:7700\"")).collect();
    let text = format!(
        "id = {robot}\nname = \"robot{robot}\"\n[map]\nresolution_m = 0.2\nrange_m = 7.0\n\
         [state]\npath = \"state\"\n[network]\nbind = \"10.77.0.{robot}:7700\"\npeers = [{}]\n\
         [sensor]\nrecord = \"robot{robot}.mcap\"\nstart_s = {start_s:.1}\n\
         [output]\nreport_json = \"{run}.json\"\nsave_map_at_end = \"{run}.ply\"\nend_when_quiet_s = 6.0\n",
        peers.join(", ")
    );
    std::fs::write(dir.join(format!("{run}.toml")), text).unwrap();
}

#[test]
fn three_nodes_end_with_equal_maps_although_one_was_killed() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    write_records(dir, 3, SECONDS);
    for robot in 1..=3 {
        write_config(dir, &robot.to_string(), robot, 0.0);
    }
    write_config(dir, "2-again", 2, KILL_AFTER_S + DOWN_S - 1.0);

    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/netns/three_nodes.sh");
    let output = Command::new("sh")
        .arg(script)
        .arg(dir)
        .arg(format!("exec '{}' node --config \"$FLOCKMAP_NODE_CONFIG\"", env!("CARGO_BIN_EXE_flockmap")))
        .env("KILL_AFTER_S", KILL_AFTER_S.to_string())
        .env("DOWN_S", DOWN_S.to_string())
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    println!("{text}{}", String::from_utf8_lossy(&output.stderr));
    if output.status.code() == Some(77) {
        return;
    }
    assert!(output.status.success());
    let maps: Vec<Vec<u8>> =
        ["1", "2-again", "3"].map(|run| std::fs::read(dir.join(format!("{run}.ply"))).unwrap()).into();
    assert!(maps.iter().all(|map| map.len() > 10_000), "the maps are saved");
}
