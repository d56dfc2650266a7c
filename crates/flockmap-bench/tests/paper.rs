//! The paper's evaluation as a user runs it, on the smallest scale.

mod common;

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};

use common::{command, json};
use flockmap_cli::options::SourceArgs;
use flockmap_cli::robot_record::{RobotRecord, prepare_folder};
use flockmap_cli::sources;
use serde_json::Value;

/// Rows of a CSV file, each with as many fields as the first. No field of ours holds a quoted comma in these
/// tests' tables.
fn csv(path: &Path) -> Vec<Vec<String>> {
    let text = std::fs::read_to_string(path).expect("the file is there");
    let rows: Vec<Vec<String>> = text.lines().map(fields).collect();
    assert!(rows.len() > 1, "{text}");
    assert!(rows.iter().all(|row| row.len() == rows[0].len()), "{text}");
    rows
}

/// The fields of a line, quotes taken off.
fn fields(line: &str) -> Vec<String> {
    let (mut fields, mut quoted) = (vec![String::new()], false);
    for c in line.chars() {
        match c {
            '"' => quoted = !quoted,
            ',' if !quoted => fields.push(String::new()),
            c => fields.last_mut().expect("there is always one").push(c),
        }
    }
    fields
}

/// Every element that is opened is closed, in the right order.
fn assert_well_formed(page: &str) {
    let body = page.split("</style>").nth(1).expect("a style comes first");
    let mut open = vec!["html".to_owned(), "head".to_owned()];
    for tag in body.split('<').skip(1).map(|rest| rest.split('>').next().unwrap_or("")) {
        let name = tag.split_whitespace().next().unwrap_or("").to_owned();
        if let Some(closed) = name.strip_prefix('/') {
            assert_eq!(open.pop().as_deref(), Some(closed), "in {tag}");
        } else if !tag.ends_with('/') && name != "img" {
            open.push(name);
        }
    }
    assert!(open.is_empty(), "{open:?} left open");
}

/// Short flights through the two scenes, in a folder as `--flights` takes it.
fn fly(folder: &Path) {
    for (scene, robots) in [("forest", 2), ("indoor", 5)] {
        let out = folder.join(scene);
        let source = SourceArgs { robots, seconds: Some(1.0), see_team_mates: true, ..SourceArgs::default() };
        prepare_folder(&out, robots).unwrap();
        for source in sources::open_scene(Path::new(scene), &source, 7.0).unwrap().robots {
            let mut record = RobotRecord::create(&out, &source.name).unwrap();
            source.frames.for_each(|frame| record.scan(&frame.scan, &frame.pose).unwrap());
            record.finish().unwrap();
        }
    }
}

#[test]
fn a_tiny_evaluation_makes_a_whole_report() {
    let flights = tempfile::tempdir().unwrap();
    fly(flights.path());
    let flights = flights.path().display();
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().display();
    let words = format!(
        "paper --quick --flights {flights} --threads 2 --only table1,table2,table3,table4 --out {out}"
    );
    let output = command(&words).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{text}\n{errors}");
    assert!(errors.contains("stage 1 of 5") && errors.contains("stage 5 of 5"), "{errors}");

    let report = json(&folder.path().join("report.json"));
    assert_eq!((&report["quick"], &report["interrupted"]), (&Value::Bool(true), &Value::Bool(false)));
    let tables = &report["tables"];
    let first = tables["table1"].as_array().unwrap();
    assert_eq!(first.len(), 8, "four rows, each here and in the paper");
    assert_eq!(first[1]["volume_ratio"].as_f64().map(|ratio| (ratio * 10.0).round()), Some(96.0));
    for number in 1..=4 {
        let id = format!("table1_row{number}");
        let rows = tables[&id].as_array().unwrap();
        let bytes = |name: &str| {
            let row = rows.iter().find(|row| row["method"] == name);
            row.unwrap_or_else(|| panic!("{id} has no {name}"))["total_bytes"].as_u64().unwrap()
        };
        assert!(bytes("racer") > bytes("paper") && bytes("paper") > 100, "{id}");
        for row in rows.iter().filter(|row| row["lossless"] == "yes") {
            assert_eq!(row["agreement"], 1.0, "{row}");
        }
        assert_eq!(csv(&folder.path().join(format!("{id}.csv"))).len(), rows.len() + 1);
    }
    for id in ["flights", "table1", "table2", "table3", "table4", "effort"] {
        csv(&folder.path().join(format!("{id}.csv")));
    }
    let page = std::fs::read_to_string(folder.path().join("report.html")).unwrap();
    assert_well_formed(&page);
    assert!(
        !page.contains("http:") && !page.contains("https:") && !page.contains("src=\"/"),
        "it needs no other file"
    );
    assert!(page.contains("id=\"fig6\"") && page.contains("data:image/png;base64,") && page.contains("<svg"));
    assert!(!page.contains("NaN") && !page.contains("inf KB"));
    let left: Vec<_> =
        std::fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert!(left.iter().all(|name| !name.to_string_lossy().starts_with('.')), "flights are left: {left:?}");

    // Again on one thread, and a part of it only: the same figures.
    let again = tempfile::tempdir().unwrap();
    let out = again.path().display();
    let words = format!("paper --quick --flights {flights} --threads 1 --only table2,table3 --out {out}");
    assert!(command(&words).output().unwrap().status.success());
    let one = json(&again.path().join("report.json"));
    for id in ["table2", "table3"] {
        assert_eq!(one["tables"][id], tables[id]);
    }
    assert_eq!(one["tables"]["flights"][0], tables["flights"][0]);
}

#[test]
fn ctrl_c_ends_with_a_partial_report_that_says_so() {
    let folder = tempfile::tempdir().unwrap();
    fly(&folder.path().join("flights"));
    let out = folder.path().display();
    let words = format!("paper --flights {out}/flights --only table1,table2,application --out {out}");
    let mut program = command(&words).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(program.stderr.take().unwrap()).lines();
    assert!(lines.by_ref().map_while(Result::ok).any(|line| line.starts_with("stage 2 of")));
    assert!(Command::new("kill").args(["-INT", &program.id().to_string()]).status().unwrap().success());
    lines.map_while(Result::ok).for_each(drop);
    assert_eq!(program.wait().unwrap().code(), Some(130));
    let report = json(&folder.path().join("report.json"));
    assert_eq!(report["interrupted"], true);
    assert!(!report["missing"].as_array().unwrap().is_empty());
    let page = std::fs::read_to_string(folder.path().join("report.html")).unwrap();
    assert!(page.contains("Partial: ended by Ctrl-C"));
    assert_well_formed(&page);
}
