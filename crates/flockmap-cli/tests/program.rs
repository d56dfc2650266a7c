//! The program as a user runs it, on small generated flights.

mod common;

use std::path::Path;

use common::{fails, flockmap, good, json};
use serde_json::Value;

const SMALL: &str = "--resolution 0.25 --range 6 --seconds 2";

#[test]
fn a_replay_with_loss_and_reordering_agrees_on_every_voxel() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().display();
    let text = good(&format!(
        "replay indoor {SMALL} --robots 3 --loss 0.2 --delay-ms 50 --jitter-ms 20 --out {out}"
    ));
    assert!(text.contains("agreement 100 %"), "{text}");
    let report = json(&folder.path().join("report.json"));
    assert_eq!(report["agreement_all"], 1.0);
    assert_eq!(report["complete"], true);
    assert_eq!(report["agreement"].as_array().unwrap().len(), 9);
    for robot in report["robots"].as_array().unwrap() {
        assert_eq!(robot["layers"].as_array().unwrap().len(), 3);
        assert!(robot["total_bytes"].as_u64().unwrap() > 1_000, "{robot}");
    }
    assert!(
        report["robots"].as_array().unwrap().iter().any(|r| r["resent"].as_u64().unwrap() > 0),
        "nothing was repaired"
    );
    assert!(report["age_occupied"]["voxels"].as_u64().unwrap() > 100);
    assert!(report["racer"]["total_bytes"].as_u64() > report["sum"]["total_bytes"].as_u64());

    let page = std::fs::read_to_string(folder.path().join("report.html")).unwrap();
    assert!(
        !page.contains("http:") && !page.contains("https:") && !page.contains("src=\"/"),
        "the page needs no other file"
    );
    let images = page.matches("data:image/png;base64,").count();
    assert_eq!(
        images,
        9 + 2,
        "three robots at three moments, and what the first one saw beside what it knows"
    );
    let maps = std::fs::read_to_string(folder.path().join("maps.svg")).unwrap();
    assert_eq!(maps.matches("data:image/png;base64,").count(), 2);
    assert_eq!(maps.matches("class=\"path self\"").count(), 2, "the robot's own path in both panels");
    assert_eq!(maps.matches("class=\"path mate\"").count(), 2, "the paths of the two others in one");
    assert!(page.contains("viewport") && page.contains("<svg"));
    assert!(page.contains("flockmap replay indoor"), "the command that made it");
}

#[test]
fn a_plan_of_a_radio_says_whether_it_fits_in_words_in_json_and_by_its_exit_code() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("plan.json");
    let text = good(&format!("plan-radio --radio wifi --robots 5 --json {}", file.display()));
    assert!(text.contains("It fits"), "{text}");
    assert_eq!(json(&file)["fits"], true);
    let output = flockmap("plan-radio --radio lora --robots 20");
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stdout).contains("It does not fit"));
}

/// What stands between two strings, each time.
fn between<'a>(text: &'a str, from: &str, to: &str) -> Vec<&'a str> {
    text.split(from).skip(1).filter_map(|rest| Some(rest.split_once(to)?.0)).collect()
}

/// The headings of columns and rows in a piece of a page.
fn headings_in(page: &str) -> Vec<&str> {
    between(page, "<th", "</th>").iter().map(|cell| cell.split_once('>').unwrap().1).collect()
}

#[test]
fn every_word_of_the_report_is_explained_where_it_stands() {
    let folder = tempfile::tempdir().unwrap();
    good(&format!("replay forest {SMALL} --loss 0.1 --out {}", folder.path().display()));
    let page = std::fs::read_to_string(folder.path().join("report.html")).unwrap();
    let sections = between(&page, "<section", "</section>");
    assert_eq!(sections.len(), 9);
    let mut headings = 0;
    for section in &sections {
        let explained = between(section, "<dt>", "</dt>");
        // The table of settings explains itself.
        for heading in between(section, "<thead>", "</thead>").into_iter().flat_map(headings_in) {
            let is_setting = ["option", "value", "what it is"].contains(&heading);
            assert!(
                is_setting || explained.contains(&heading),
                "`{heading}` is not explained: {explained:?}"
            );
            headings += 1;
        }
    }
    assert!(headings > 25, "{headings}");
    let explained = [between(&page, "<dt>", "</dt>"), headings_in(sections[8])].concat().join("; ");
    for word in [
        "agreement",
        "age",
        "batch",
        "codec",
        "fused map",
        "KB",
        "layer",
        "mapper",
        "on the wire",
        "packages",
        "publish period",
        "RACER",
        "relayed",
        "requests",
        "resent",
        "the paper",
        "voxel",
        "sending",
    ] {
        assert!(page.contains(word), "{word} does not occur any more");
        assert!(explained.contains(word), "{word} is not explained: {explained}");
    }
    for word in ["snapshot", "overhead", "epoch", "digest", "backed off", "t_l"] {
        assert!(!page.contains(word), "`{word}` is not explained anywhere");
    }
}

#[test]
fn fused_maps_are_compared_where_agreement_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().display();
    let text = good(&format!("replay indoor {SMALL} --robots 3 --out {out}"));
    let at = |what: &str| text.find(what).unwrap_or_else(|| panic!("{what}: {text}"));
    assert!(at("Good: agreement 100 %") < at("fused maps:"), "{text}");
    let report = json(&folder.path().join("report.json"));
    let fused = &report["fused"];
    assert_eq!(fused["pairs"].as_array().unwrap().len(), 3);
    let [known, equal, seen, seen_equal] =
        ["known", "equal", "seen", "seen_equal"].map(|what| fused[what].as_u64().unwrap());
    assert!(known > 10_000 && equal <= known && seen < known && seen_equal <= seen, "{fused}");
    let share = fused["share"].as_f64().unwrap();
    assert!((share - equal as f64 / known as f64).abs() < 1e-12 && share > 0.9, "{share}");
    let page = std::fs::read_to_string(folder.path().join("report.html")).unwrap();
    assert!(page.contains("fused maps need not be"));
    assert!(!page.contains("class=\"verdict failure\""), "nothing failed");
}

#[test]
fn rivals_are_counted_as_flockmap_is() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.json");
    good(&format!("replay forest {SMALL} --json {}", path.display()));
    let report = json(&path);
    let wire = |what: &str| {
        let [payload, headers] = ["total_bytes", "ip_udp_bytes"].map(|of| report[what][of].as_u64().unwrap());
        assert_eq!(headers, 28 * report[what]["datagrams"].as_u64().unwrap(), "{what}");
        (payload + headers) as f64
    };
    let series =
        |what: &str| -> f64 { report[what].as_array().unwrap().iter().map(|kb| kb.as_f64().unwrap()).sum() };
    for (what, kb_per_second) in
        [("sum", "kb_per_second"), ("racer", "racer_kb_per_second"), ("paper_whole", "paper_kb_per_second")]
    {
        assert!((series(kb_per_second) * 1024.0 - wire(what)).abs() < 1.0, "{what}");
        let ratio = report[what]["ratio"].as_f64().unwrap_or(1.0);
        assert!((ratio - wire(what) / wire("sum")).abs() < 1e-9, "{what}");
    }
    // A datagram of the paper carries 1,472 bytes, one of RACER 1,052.
    let least = |what: &str, bytes: f64| {
        let datagrams = report[what]["datagrams"].as_f64().unwrap();
        assert!(datagrams >= (report[what]["total_bytes"].as_f64().unwrap() / bytes).ceil(), "{what}");
    };
    least("paper_whole", 1_472.0);
    least("racer", 1_052.0);
}

#[test]
fn the_same_replay_sends_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let run = |name: &str| {
        let path = folder.path().join(name);
        good(&format!("replay forest {SMALL} --loss 0.3 --seed 5 --json {}", path.display()));
        let report = json(&path);
        (report["sum"].clone(), report["kb_per_second"].clone(), report["robots"][0]["layers"].clone())
    };
    assert_eq!(run("a.json"), run("b.json"));
}

#[test]
fn info_shows_what_is_in_a_store() {
    use flockmap::{Pose, Resolution, Robot, RobotConfig, RobotId, Scan, Stamp};
    use flockmap_node::store::{Identity, Store, StoreOptions};
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("store");
    let resolution = Resolution::from_metres(0.25).unwrap();
    let identity = Identity { swarm: 9, robot: RobotId(4), resolution };
    let mut store = Store::open_folder(&path, identity, StoreOptions::default()).unwrap().start(7).unwrap();
    let config = RobotConfig { epoch: 7, ..RobotConfig::new(RobotId(4), resolution, 6.0) };
    let mut robot = Robot::new(config, Stamp(0)).unwrap();
    for second in 1..=3i64 {
        let point = [second as f32, 2.0, 0.0];
        let scan = Scan { stamp: Stamp(second * 1_000_000), points: vec![point], no_returns: Vec::new() };
        robot.insert_scan(scan.stamp, &scan, &Pose::IDENTITY).unwrap();
        robot.flush(scan.stamp);
    }
    while let Some(event) = robot.poll_event() {
        store.note(Stamp(0), &event);
    }
    drop(store);
    // A crash amid a record.
    let segment = path.join("00000001-00000000000000000007.log");
    let bytes = std::fs::read(&segment).unwrap();
    std::fs::write(&segment, &bytes[..bytes.len() - 1]).unwrap();

    let facts = folder.path().join("facts.json");
    let text = good(&format!("info {} --json {}", path.display(), facts.display()));
    assert!(text.contains("robot 4, swarm 9, voxels of 0.25 m"), "{text}");
    assert!(text.contains("robot 4 epoch 7: holds 1–2; 2 packages"), "{text}");
    assert!(text.contains("bytes at its end half written"), "{text}");
    let content = &json(&facts)["content"];
    assert_eq!(content["streams"][0]["held"], serde_json::json!([[1, 2]]));
    assert_eq!(content["segments"][0]["records"], 2);
}

#[test]
fn broadcast_costs_less_than_unicast_among_three() {
    let folder = tempfile::tempdir().unwrap();
    let total = |cast: &str| {
        let path = folder.path().join(cast);
        good(&format!("replay forest {SMALL} --robots 3 --cast {cast} --json {}", path.display()));
        json(&path)["sum"]["total_bytes"].as_f64().unwrap()
    };
    assert!(total("broadcast") < 0.7 * total("unicast"));
}

#[test]
fn the_demo_flies_over_sockets_and_a_radio_that_loses() {
    let folder = tempfile::tempdir().unwrap();
    let fly = |name: &str, radio: &str| {
        let out = folder.path().join(name);
        let text = good(&format!("demo --scene indoor --robots 3 {SMALL} {radio} --out {}", out.display()));
        assert!(text.contains("agreement 100 %"), "{text}");
        assert!(out.join("report.html").exists() && out.join("maps.svg").exists());
        let report = json(&out.join("report.json"));
        assert_eq!((&report["agreement_all"], &report["complete"]), (&Value::from(1.0), &Value::from(true)));
        for what in ["t_map", "t_pack", "t_recv2insert"] {
            assert!(report[what]["count"].as_u64().unwrap() > 0, "{what}");
        }
        for robot in report["robots"].as_array().unwrap() {
            assert_eq!(robot["layers"].as_array().unwrap().len(), 3);
            assert!(robot["total_bytes"].as_u64().unwrap() > 1_000, "{robot}");
        }
        report
    };
    let resent = |report: &Value| -> u64 {
        report["robots"].as_array().unwrap().iter().map(|robot| robot["resent"].as_u64().unwrap()).sum()
    };
    let radio = |report: &Value| report["settings"]["radio"].as_str().unwrap().to_owned();
    let lossy = fly("lossy", "");
    assert!(radio(&lossy).starts_with("20 % of datagrams lost ("), "{}", radio(&lossy));
    assert!(resent(&lossy) > 0, "nothing was repaired");
    let bare = fly("bare", "--loss 0");
    assert!(radio(&bare).contains("nothing between them"), "{}", radio(&bare));
}

#[test]
fn a_record_can_be_looked_into_mapped_exported_and_converted() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let record = path("robot1.mcap");
    let mut writer = flockmap_io::RecordWriter::create(&record, "robot1").unwrap();
    for number in 0..5i64 {
        let points = (-20..20).map(|y| [3.05, y as f32 * 0.1 + 0.05, 0.05]).collect();
        let scan =
            flockmap::Scan { stamp: flockmap::Stamp(number * 100_000), points, no_returns: Vec::new() };
        writer.write(&scan, &flockmap::Pose::IDENTITY).unwrap();
    }
    writer.finish().unwrap();

    assert!(good(&format!("info {record}")).contains("5 frames"));
    good(&format!("export {record} --to {} --resolution 0.1 --range 7", path("map.bt")));
    let facts = path("facts.json");
    good(&format!("info {} --json {facts}", path("map.bt")));
    let facts = json(Path::new(&facts));
    assert_eq!(facts["content"]["occupied"], 40);
    let free = facts["content"]["free"].as_u64().unwrap();
    assert!(free > 500, "{facts}");
    let written = good(&format!("export {} --to {}", path("map.bt"), path("map.pcd")));
    assert!(written.contains(": 40 voxels"), "{written}");
    let written = good(&format!("export {} --to {} --free", path("map.bt"), path("all.ply")));
    assert!(
        written.contains(": ")
            && good(&format!("info {}", path("all.ply")))
                .contains(&format!("40 points, {free} more of free space"))
    );
    good(&format!("export {} --to {}", path("map.pcd"), path("again.bt")));
    let again = good(&format!("info {}", path("again.bt")));
    assert!(again.contains("40 occupied and 0 free"), "{again}");
    // From above, of the record and of the map: the wall is 40 cells.
    for from in [&record, &path("map.bt")] {
        let said = good(&format!("export {from} --to {} --band 0 0.1 --resolution 0.1", path("flat.pgm")));
        assert!(said.contains("40 occupied cells") && said.contains("flat.yaml"), "{said}");
        let picture = std::fs::read(path("flat.pgm")).unwrap();
        assert_eq!(picture.iter().filter(|shade| **shade == 0).count(), 40);
        assert!(std::fs::read_to_string(path("flat.yaml")).unwrap().contains("image: \"flat.pgm\"\n"));
    }
    let said = good(&format!("export {} --to {} --product heights", path("map.bt"), path("heights.png")));
    assert!(said.contains("0.10 m (blue) to 0.10 m (orange)"), "{said}");
    let said = good(&format!("export {} --to {} --product height-values", path("map.bt"), path("deep.png")));
    assert!(said.contains("value in mm"), "{said}");
    // Records can be replayed, too.
    let copy = path("robot2.mcap");
    std::fs::copy(&record, &copy).unwrap();
    assert!(good(&format!("replay {record} {copy}")).contains("agreement 100 %"));
}

#[test]
fn the_bytes_of_a_package_can_be_looked_into() {
    use flockmap::codec::{Batch, Codec, Encoder};
    use flockmap::{Changes, Resolution, RobotId, Stamp, State, Stream, Voxel};
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("package.bin");
    let batch = Batch {
        stream: Stream { origin: RobotId(7), epoch: 3 },
        start: Stamp(0),
        end: Stamp(500_000),
        resolution: Resolution::from_metres(0.1).unwrap(),
        sensor: [0; 3],
    };
    let changes = Changes::from_voxels((0..9).map(|x| (Voxel::new(x, 0, 0), State::Free)));
    let package = Encoder::new().encode_whole(Codec::Paper, &batch, 4, &changes).unwrap();
    std::fs::write(&path, package.bytes()).unwrap();
    let text = good(&format!("info {}", path.display()));
    assert!(text.contains("robot 7, epoch 3, index 4") && text.contains("9 free and 0 occupied"), "{text}");

    let mut damaged = package.bytes().to_vec();
    *damaged.last_mut().unwrap() ^= 1;
    std::fs::write(&path, &damaged).unwrap();
    assert!(fails(&format!("info {}", path.display())).contains("package.bin"));
}

#[test]
fn keys_are_random_and_no_file_is_overwritten() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("swarm.key");
    good(&format!("key --out {}", path.display()));
    let text = std::fs::read_to_string(&path).unwrap();
    assert!(text.parse::<flockmap::sync::SwarmKey>().is_ok());
    assert_ne!(text, good("key"));
    assert!(fails(&format!("key --out {}", path.display())).contains("is there already"));
    assert_eq!(std::fs::read_to_string(&path).unwrap(), text);
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
    }
}

#[test]
fn what_cannot_work_is_said() {
    for (words, expected) in [
        ("replay no-such.mcap", "no-such.mcap"),
        ("replay forest --loss 1.5", "--loss is 1.5"),
        ("replay forest --resolution 0", "--resolution is 0"),
        ("replay forest --range=-1", "--range"),
        ("replay forest other.mcap", "forest is a world"),
        ("replay forest --robots 999", "999"),
        ("replay forest --publish-period 0", "--publish-period is 0"),
        ("replay forest --budget-kb-s 0.01", "--budget-kb-s is 0.01"),
        ("export forest --to map.stl", "map.stl"),
        ("info no-such.bt", "no-such.bt"),
        ("demo --scene nowhere", "nowhere"),
        ("demo --loss 1.5", "--loss"),
        ("node --config no-such.toml", "no-such.toml"),
        ("bench codecs forest --codec all", "-p flockmap-bench -- codecs forest --codec all"),
    ] {
        let error = fails(words);
        assert!(error.contains(expected), "`{words}` says: {error}");
    }
}

#[test]
fn recorded_robots_agree() {
    let data = std::env::var("FLOCKMAP_DATA")
        .unwrap_or_else(|_| concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data").to_owned());
    let record = |n: u32| format!("{data}/hku_mb/robot{n}.mcap");
    if !Path::new(&record(1)).exists() {
        eprintln!("skipped: no data in {data}");
        return;
    }
    let (a, b) = (record(1), record(2));
    let text =
        good(&format!("replay {a} {b} --resolution 0.2 --range 30 --seconds 6 --loss 0.2 --delay-ms 50"));
    assert!(text.contains("agreement 100 %"), "{text}");
}
