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
        "mapping --scene indoor --scans 2 --resolution 0.2 --range 5 --json {}",
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
    assert_eq!(output["mappers"].as_array().unwrap().len(), 4);
}
