//! `flockmap mirror` beside `flockmap node`, as a user runs them.
#![cfg(unix)]

mod common;

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use common::good;

/// A node with these lines in its configuration, that gives its map out at `map.sock` in the folder; once it does.
fn node(folder: &Path, lines: &str) -> (Child, impl Iterator<Item = String>) {
    let config = folder.join("robot.toml");
    let text = format!(
        "id = 5\nname = \"alpha\"\n[map]\nresolution_m = 0.25\nrange_m = 6.0\n[state]\npath = \"state\"\n\
         [network]\nbind = \"127.0.0.1:0\"\n[map_output]\nlisten_unix = \"map.sock\"\n{lines}"
    );
    std::fs::write(&config, text).unwrap();
    let mut node = Command::new(env!("CARGO_BIN_EXE_flockmap"))
        .args(["node", "--config"])
        .arg(&config)
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(node.stderr.take().unwrap()).lines().map(Result::unwrap);
    assert!(lines.any(|line| line.contains("gives the map out at unix:")), "the node runs");
    (node, lines)
}

#[test]
fn a_mirror_that_follows_to_the_end_has_the_map_that_the_node_saves() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path().display();
    good(&format!(
        "sim fly --scene indoor --robots 1 --seconds 2 --resolution 0.25 --range 6 --no-view --out {at}"
    ));
    let end = "[sensor]\nrecord = \"robot1.mcap\"\n[output]\nsave_map_at_end = \"node.ply\"\nsave_free = true\n\
               report_json = \"end.json\"\nend_when_quiet_s = 3.0\n";
    let (mut node, lines) = node(folder.path(), end);
    let said = good(&format!("mirror unix:{at}/map.sock --origins --free --out {at}/mirror.ply"));
    assert!(lines.last().is_some());
    assert!(node.wait().unwrap().success());
    assert!(said.contains("alpha (robot 5), frame map, voxels of 0.25 m"), "{said}");
    assert!(said.contains(", complete;") && said.contains("1 connection(s)"), "{said}");
    assert!(said.contains("from merge to mirror: median"), "{said}");
    assert!(said.contains("robot 5 saw"), "{said}");
    let [ours, theirs] =
        ["mirror.ply", "node.ply"].map(|name| std::fs::read(folder.path().join(name)).unwrap());
    assert!(ours == theirs, "{} and {} bytes", ours.len(), theirs.len());
    assert!(!folder.path().join("map.sock").exists());
}

#[test]
fn once_ends_with_the_map_of_the_moment_and_an_empty_one_is_one() {
    let folder = tempfile::tempdir().unwrap();
    let (mut node, _lines) = node(folder.path(), "");
    let at = folder.path().display();
    let said = good(&format!("mirror unix:{at}/map.sock --once"));
    assert!(said.contains("0 blocks, 0 free, 0 occupied") && said.contains("complete"), "{said}");
    node.kill().unwrap();
    node.wait().unwrap();
}
