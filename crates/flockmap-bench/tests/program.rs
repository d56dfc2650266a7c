//! The program as a user runs it, on small generated flights.

mod common;

use common::{good, json};

#[test]
fn codecs_puts_the_methods_in_their_order() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("codecs.json");
    good(&format!(
        "codecs forest --lidar mid360 --robots 1 --resolution 0.2 --range 7 --seconds 2 --json {}",
        path.display()
    ));
    let output = json(&path);
    let mut keys: Vec<&String> = output.as_object().unwrap().keys().collect();
    keys.sort();
    assert_eq!(
        keys,
        [
            "batch_limit",
            "changed_voxels",
            "methods",
            "publish_period_s",
            "range_m",
            "records",
            "resolution_m",
            "snapshots",
        ]
    );
    let methods = output["methods"].as_array().unwrap();
    let mut keys: Vec<&String> = methods[0].as_object().unwrap().keys().collect();
    keys.sort();
    assert_eq!(
        keys,
        [
            "agreement",
            "avg_kb_s",
            "decode_ms_mean",
            "encode_ms_mean",
            "encode_ms_p99",
            "max_kb_s",
            "name",
            "packages",
            "total_bytes"
        ]
    );
    assert!(methods.iter().all(|m| m["agreement"] == 1.0), "{methods:?}");
    let bytes =
        |name: &str| methods.iter().find(|m| m["name"] == name).expect(name)["total_bytes"].as_u64().unwrap();
    assert!(bytes("paper") < bytes("nested-zlib"));
    assert!(bytes("nested-zlib") < bytes("racer") && bytes("nested-zlib") < bytes("raw"));
    assert!(bytes("paper") < bytes("paper-datagrams"));
    assert!(2 * bytes("flock") < bytes("paper"));
    let states = output["snapshots"].as_array().unwrap();
    let state =
        |name: &str| states.iter().find(|m| m["name"] == name).expect(name)["total_bytes"].as_u64().unwrap();
    assert!(2 * state("flock") < state("paper"));
}

#[test]
fn codecs_runs_every_method_and_says_which_are_lossy() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("all.json");
    let text = good(&format!(
        "codecs indoor --lidar mid360 --robots 1 --resolution 0.25 --range 4 --seconds 4 --codec all --json {}",
        path.display()
    ));
    let output = json(&path);
    let methods = output["methods"].as_array().unwrap();
    assert!(methods.len() >= 16);
    for method in methods {
        let name = method["name"].as_str().unwrap();
        let lossy = ["gvp", "octomap-diff-10s", "scan-relay-1cm"].contains(&name);
        assert_eq!(method["agreement"] != 1.0, lossy, "{method}");
        assert_eq!(text.contains(&format!("* {name}: ")), lossy, "{text}");
    }
}

#[test]
fn the_mapper_makes_the_same_map_as_octomap() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mapping.json");
    let text = good(&format!(
        "mapping --scene indoor --scans 2 --resolution 0.2 --range 5 --threads 1,2 --runs 2 --json {}",
        path.display()
    ));
    let output = json(&path);
    assert_eq!(output["scans"], 2);
    if let Some(reason) = output["octomap_skipped"].as_str() {
        assert!(text.contains("OctoMap skipped"), "{text}");
        eprintln!("skipped: {reason}");
        return;
    }
    let differences = &output["differences"];
    let (known, equal) = (differences["known"].as_f64().unwrap(), differences["equal"].as_f64().unwrap());
    // Rounding may put a ray on the other side of an edge.
    assert!(known > 10_000.0 && equal / known > 0.999, "{differences}");
    // Three presets, single rays and the whole robot, each with one thread and with two, and OctoMap.
    assert_eq!(output["mappers"].as_array().unwrap().len(), 11);
}

#[test]
fn who_joins_at_the_end_of_a_day_gets_all_of_it() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("day.json");
    let text = good(&format!("day --robots 2 --metres 20 --json {}", path.display()));
    assert!(text.contains("It held all") && text.contains("Its fused map is that of robot 1."), "{text}");
    let output = json(&path);
    let robots = output["robots"].as_array().unwrap();
    assert_eq!(robots.len(), 3, "the late joiner is one of them");
    assert!(robots.iter().all(|row| row["is_same"] == true && row["blocks_dropped"] == 0), "{robots:?}");
    let seen: Vec<u64> = robots.iter().map(|row| row["voxels"].as_u64().unwrap()).collect();
    assert!(seen[0] > 500_000 && seen[1] > 500_000 && seen[0] != seen[1], "{seen:?}");
    assert_eq!(seen[2], 0);
    let joiner = &output["joiner"];
    assert_eq!(robots[2]["voxels_of_others"], seen[0] + seen[1]);
    for stream in joiner["streams"].as_array().unwrap() {
        assert_eq!(stream["packages"], stream["packages_published"]);
        assert!(["lacking", "beyond", "different"].iter().all(|name| stream["difference"][name] == 0));
    }
    let times = output["times"].as_array().unwrap();
    assert!(times.iter().all(|row| row["packing"]["median_ms"].as_f64().unwrap() > 0.0), "{times:?}");
    assert_eq!(output["calls"].as_array().unwrap().len(), 5, "two that fly, then three");

    let alone = good("day --robots 1 --metres 5 --no-joiner");
    assert!(alone.contains("all agree") && !alone.contains("late joiner"), "{alone}");
}

#[test]
fn what_drifted_is_put_right_for_the_bytes_of_poses() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("loops.json");
    let flight = "loops forest --seconds 12 --submap-length 3 --closures 2 --steps 2 --drift 8 --loss 0.2";
    let text = good(&format!("{flight} --json {}", path.display()));
    assert!(text.contains("submaps at the end: all where they were put"), "{text}");
    let output = json(&path);
    assert!(output["is_right"] == true && output["submaps"].as_u64().unwrap() >= 2, "{output}");
    let found: Vec<f64> =
        output["maps"].as_array().unwrap().iter().map(|map| map["found"].as_f64().unwrap()).collect();
    assert!(found[0] == 1.0 && found[1] < found[3], "put right at last: {found:?}");
    let [map, closure] = ["map_bytes", "closure_bytes"].map(|name| output[name].as_u64().unwrap());
    assert!(closure > 0 && closure < map / 50, "{closure} of {map} bytes");
}
