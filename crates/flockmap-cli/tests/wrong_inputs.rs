//! Wrong inputs, as a new user gives them, and what is said of each.

mod common;

use std::path::Path;

use flockmap::{Pose, Resolution, Scan, Stamp, State, Voxel};
use flockmap_io::{ExportOptions, RecordWriter, export_map};

/// A command line, and what the message says. Paths are in the folder that [`prepare`] fills.
const WRONG: &[(&str, &str)] = &[
    // Missing.
    ("replay", "<RECORD>"),
    ("replay nowhere.mcap", "there is no nowhere.mcap"),
    ("replay nowhere/", "there is no nowhere/"),
    ("replay forrest", "did you mean forest?"),
    ("demo --scene dessert", "expected forest, indoor, or a .bt"),
    ("sim fly --scene Indor", "did you mean indoor?"),
    ("sim explore --scene nowhere.bt", "nowhere.bt: cannot read: No such file"),
    ("replay nowhere.pcd", "nowhere.pcd: cannot read: No such file"),
    ("info nowhere.mcap", "cannot read nowhere.mcap: No such file"),
    ("export nowhere.mcap --to map.ply", "there is no nowhere.mcap"),
    ("export one.mcap", "--to <MAP>"),
    ("render nowhere.bt --out map.png", "nowhere.bt: cannot read: No such file"),
    ("render one.mcap --out map.jpg", "expected a path that ends in .png"),
    ("render one.mcap --out missing/map.png", "there is no folder missing"),
    ("render one.mcap --out map.png --size 10x9000", "such as 1600x1000, 16 to 4096 each"),
    ("render one.mcap --out map.png --elevation 91", "expected -360 to 360 and -90 to 90 degrees"),
    ("render one.mcap --out map.png --heights 2 1", "expected the lower height first"),
    ("mirror", "<ADDRESS>"),
    ("mirror nowhere", "`unix:PATH` or `HOST:PORT`"),
    ("mirror unix:", "`unix:PATH` or `HOST:PORT`"),
    ("mirror localhost:0", "`unix:PATH` or `HOST:PORT`"),
    ("mirror unix:nowhere.sock", "expected a node that gives its map out there"),
    ("mirror unix:nowhere.sock --out map.txt", "expected a path that ends in .ply, .pcd or .bt"),
    ("mirror unix:nowhere.sock --free", "--out <MAP>"),
    ("mirror unix:nowhere.sock --for -3", "0 to 1,000,000,000 expected"),
    ("mirror unix:nowhere.sock --rate-max 0", "--rate-max"),
    ("sim table --check", "--file <FILE>"),
    ("plan-radio --robots 3", "--radio <PRESET>|--rate-kb-s <B>"),
    ("plan-radio --radio lora", "--robots <N>"),
    ("plan-radio --radio loora --robots 3", "known are lan, wifi, wifi_lossy"),
    ("plan-radio --radio lora --robots 0", "--robots is 0, expected 2 to 1,000"),
    ("plan-radio --rate-kb-s -6 --robots 3", "--rate-kb-s is -6"),
    ("sim swarm --file nowhere.txt", "nowhere.txt"),
    // Empty, truncated, of another type.
    ("replay empty.mcap", "empty.mcap"),
    ("replay truncated.mcap one.mcap", "truncated.mcap"),
    ("replay text.mcap", "expected an MCAP file"),
    ("replay text.txt", "text.txt"),
    ("replay emptyfolder", "emptyfolder"),
    ("replay empty.pcd", "empty.pcd"),
    ("replay text.ply", "text.ply"),
    ("replay truncated.bt", "truncated.bt"),
    ("replay text.las", "text.las"),
    ("replay one.mcap/", "one.mcap"),
    ("info text.txt", "text.txt"),
    ("info empty.mcap", "empty.mcap"),
    ("export text.ply --to map.pcd", "text.ply"),
    // Too large.
    ("replay huge.pcd", "huge.pcd"),
    ("replay forest --robots 100000", "--robots is 100000, expected 1 to 64"),
    ("replay forest --seconds 1e9", "--seconds must be more than 0 and at most 86,400"),
    ("replay forest --moving-obstacles 10000000", "--moving-obstacles"),
    ("replay one.mcap --robots 101", "--robots is 101, expected 1 to 100"),
    // Out of range, or of a wrong unit.
    ("replay forest --loss 20", "--loss is 20, expected 0 to 1"),
    ("replay forest --loss -0.1", "--loss is -0.1, expected 0 to 1"),
    ("replay forest --loss 20%", "invalid value '20%' for '--loss <P>'"),
    ("replay forest --loss NaN", "--loss is NaN"),
    ("replay forest --delay-ms -5", "--delay-ms is -5, expected 0 to 60,000"),
    ("replay forest --jitter-ms 1e9", "--jitter-ms is 1000000000"),
    ("replay forest --duplication 7", "--duplication is 7"),
    ("replay forest --budget-kb-s 0.01", "--budget-kb-s is 0.01, expected at least 0.02"),
    ("replay forest --resolution 0", "--resolution is 0, expected 0.001 to 100 m"),
    ("replay forest --resolution 10cm", "invalid value '10cm' for '--resolution <M>'"),
    ("replay forest --range -3", "--range is -3, expected more than 0 and at most 50 m (500 voxels)"),
    ("replay forest --range inf", "--range is inf"),
    ("replay forest --resolution 10", "less than one voxel of 10 m (--resolution is in metres too)"),
    ("replay forest --publish-period 0", "--publish-period is 0, expected 0.001 to 3,600 s"),
    ("replay forest --obstacle-period -1", "--obstacle-period is -1"),
    ("replay forest --batch-limit 0", "--batch-limit is 0"),
    ("replay forest --robots 0", "--robots is 0, expected 1 to 64"),
    ("replay forest --robots -1", "--robots"),
    ("replay forest --seconds 0", "--seconds must be more than 0"),
    ("replay forest --speed 0", "--speed is 0, expected 0.1 to 20 m/s"),
    ("replay forest --speed 400", "--speed is 400"),
    ("replay forest --lidar-range 0", "--lidar-range"),
    ("replay forest --range-noise -1", "--range-noise"),
    ("replay forest --drop-out 2", "--drop-out"),
    ("sim explore --threads 0", "--threads is 0, expected 1 to 64"),
    ("sim explore --seconds-max 0", "--seconds-max is 0, expected 0.1 to 14,400 s"),
    ("sim explore --robots 0", "--robots is 0"),
    ("sim fly --threads 0", "--threads must be 1 to 1,000"),
    ("sim swarm --robots 1", "robots"),
    ("sim table --robots-max 1", "--robots-max must be 2 to 100"),
    ("radio 127.0.0.1:7701", "2 values"),
    ("radio 127.0.0.1:7701 localhost", "invalid value 'localhost'"),
    ("radio 127.0.0.1:7701 127.0.0.1:7702 --loss 30", "--loss"),
    ("radio 127.0.0.1:7701 127.0.0.1:7702 --at heal", "--at"),
    // No such thing.
    ("replay forest --mapper octo", "octomap"),
    ("replay forest --codec zip", "nested-zlib"),
    ("replay forest --cast both", "broadcast"),
    ("replay forest --lidar velodyne", "mid360"),
    ("replay forest --rendering nice", "polar"),
    ("replay forest --looss 0.2", "'--loss'"),
    ("replay one.mcap --points-topic /none", "/none"),
    ("replay one.mcap --odometry-topic /none", "/none"),
    ("replay one.mcap --map-frame mars", "mars"),
    ("sim swarm --radio none", "lora"),
    ("explore", "unrecognized subcommand 'explore'"),
    ("bench codecs forest", "flockmap-bench -- codecs forest"),
    // Not applicable.
    ("replay forest --poses poses.txt", "--poses is for records, and forest is a world"),
    ("replay forest --points-topic /points", "--points-topic is for records"),
    ("replay forest --real-stamps", "--real-stamps is for records, and forest is a world"),
    ("replay one.mcap --lidar mid360", "--lidar is for simulated robots"),
    ("replay one.mcap two.mcap --robots 7", "--robots cuts a single record"),
    ("replay one.mcap two.mcap --speed 2", "--speed is for simulated robots"),
    ("replay forest one.mcap", "forest is a world, not a record"),
    ("replay forest --world-resolution 0.1", "--world-resolution is for point clouds"),
    ("demo --points-topic /points", "unexpected argument '--points-topic'"),
    ("sim fly --publish-period 1", "unexpected argument '--publish-period'"),
    ("sim explore --seconds 3", "'--seconds-max'"),
    ("sim explore --moving-obstacles 3", "unexpected argument '--moving-obstacles'"),
    ("sim explore --no-sync --loss 0.2", "cannot be used with"),
    ("sim swarm --file text.txt --seed 3", "cannot be used with"),
    ("export one.mcap --to map.ply --publish-period 1", "unexpected argument '--publish-period'"),
    (
        "export map.bt --to map.ply --resolution 0.2",
        "--resolution does not apply: map.bt has voxels of 0.1 m",
    ),
    ("export map.bt --to map.ply --range 5", "--range is for records, and map.bt is a map"),
    ("export map.bt --to map.ply --robots 2", "--robots is for records, and map.bt is a map"),
    ("export one.mcap --to map.stl", "expected a path that ends in .ply, .pcd, .bt, .pgm or .png"),
    ("export one.mcap --to map.pgm", "which heights would the robot hit? Give --band LOW HIGH"),
    ("export one.mcap --to map.pgm --band 0.2", "2 values required"),
    ("export one.mcap --to map.pgm --product heights", "heights become a .png"),
    ("export one.mcap --to map.ply --band 0.2 2", "--band is for .pgm and .png, and map.ply holds voxels"),
    ("export one.mcap --to map.png --band 0.2 2 --free", "--free is for .ply and .pcd"),
    ("export map.bt --to map.png --product heights --all-free", "--all-free is for --product occupancy"),
    ("export map.bt --to map.pgm --band 2 0.2", "expected the lower ends first"),
    ("export map.bt --to map.pgm --band 7 9", "nothing is known there: the map reaches from"),
    ("export map.bt --to map.pgm --band NaN 1", "--band [NaN, 1.0]: expected the lower ends first"),
    (
        "export map.bt --to map.pgm --band 0 1 --area 0 0 9000 9000",
        "an occupancy grid of box (0, 0, 0) size 90000 × 90000 × 10 voxels",
    ),
    // Not writable.
    ("replay forest --json missing/a.json", "there is no folder missing: make it first (mkdir -p missing)"),
    ("replay forest --json emptyfolder", "it is a folder, and a file is written"),
    ("replay forest --out text.txt", "text.txt is a file, and a folder is made there"),
    ("demo --out text.txt/report", "text.txt is a file"),
    ("sim fly --out text.txt", "text.txt is a file"),
    ("sim explore --json missing/a.json", "there is no folder missing"),
    ("sim table --file missing/table.txt", "there is no folder missing"),
    ("export one.mcap --to missing/map.ply", "there is no folder missing"),
    ("info one.mcap --json missing/a.json", "there is no folder missing"),
    ("key --out missing/swarm.key", "missing"),
    // Twice.
    ("key --out text.txt", "is there already"),
    ("replay forest --loss 0.1 --loss 0.2", "cannot be used multiple times"),
    ("replay forest indoor", "name one world"),
];

/// Files that are wrong in one way each, and two records that are right.
fn prepare(folder: &Path) {
    let write = |name: &str, bytes: &[u8]| std::fs::write(folder.join(name), bytes).unwrap();
    for name in ["one", "two"] {
        let mut record = RecordWriter::create(folder.join(format!("{name}.mcap")), name).unwrap();
        for number in 0..20 {
            let points =
                (0..200).map(|i| [(i as f32 * 0.03).cos() * 3.0, (i as f32 * 0.03).sin() * 3.0, 0.5]);
            let scan =
                Scan { stamp: Stamp(number * 100_000), points: points.collect(), no_returns: Vec::new() };
            record.write(&scan, &Pose::from_translation([0.1 * number as f64, 0.0, 1.0])).unwrap();
        }
        record.finish().unwrap();
    }
    let one = std::fs::read(folder.join("one.mcap")).unwrap();
    write("truncated.mcap", &one[..40]);
    write("empty.mcap", b"");
    write("empty.pcd", b"");
    for name in ["text.mcap", "text.ply", "text.las", "text.txt"] {
        write(name, b"This is no map, and no record.\n");
    }
    let resolution = Resolution::from_metres(0.1).unwrap();
    let wall = (0..50).map(|i| (Voxel::new(0, i, 0), State::Occupied));
    export_map(folder.join("map.bt"), resolution, wall, &ExportOptions { free: true }).unwrap();
    write("truncated.bt", b"# Octomap OcTree binary file\nid OcTree\nsize 100\nres 0.1\ndata\n\x00\x01");
    write(
        "huge.pcd",
        b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 4000000000\nHEIGHT 1\nPOINTS 4000000000\nDATA binary\n\x00\x00",
    );
    std::fs::create_dir(folder.join("emptyfolder")).unwrap();
}

#[test]
fn wrong_inputs_are_refused_in_words_that_help() {
    let folder = tempfile::tempdir().unwrap();
    prepare(folder.path());
    let before = names(folder.path());
    let mut wrong = Vec::new();
    for (line, expected) in WRONG {
        let output = common::command(line).current_dir(folder.path()).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        let mut faults = Vec::new();
        if output.status.code() != Some(2) {
            faults.push(format!("exit code {:?}", output.status.code()));
        }
        if !said.contains(expected) {
            faults.push(format!("does not say {expected:?}"));
        }
        faults.extend(unreadable(&said));
        if !faults.is_empty() {
            wrong.push(format!("$ flockmap {line}\n{said}  → {}\n", faults.join("; ")));
        }
    }
    assert!(wrong.is_empty(), "{} of {}:\n{}", wrong.len(), WRONG.len(), wrong.join("\n"));
    assert_eq!(names(folder.path()), before, "a refused command leaves nothing behind");
}

/// What no message should have: names from inside of the program, or the same thing twice.
fn unreadable(said: &str) -> Option<String> {
    let inside = ["::", "panicked", "Some(", "None", "Err(", "RUST_BACKTRACE", "os error"];
    if let Some(word) = inside.iter().find(|word| said.contains(**word)) {
        return Some(format!("shows {word:?}"));
    }
    let error = said.lines().find(|line| line.starts_with("error:"))?;
    let parts: Vec<&str> = error.trim_start_matches("error:").split(": ").map(str::trim).collect();
    let twice = parts.iter().enumerate().find(|(i, part)| parts[..*i].contains(part))?;
    Some(format!("says {:?} twice", twice.1))
}

fn names(folder: &Path) -> Vec<std::ffi::OsString> {
    let mut names: Vec<_> =
        std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    names.sort();
    names
}
