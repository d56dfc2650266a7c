use super::*;
use std::collections::BTreeSet;
use std::path::Path;

use flockmap::{Cast, Codec, RobotId};
use serde_json::Value;

use super::places::Places;
use crate::UdpSockets;

const MINIMAL: &str = "id = 1\n[map]\nresolution_m = 0.1\nrange_m = 7.0\n";

fn parse(text: &str) -> Result<NodeConfig, String> {
    text.parse().map_err(|error: ConfigError| error.to_string())
}

/// The example with its commented keys in force, as far as `take` wants them.
fn uncommented(take: impl Fn(&str) -> bool) -> String {
    let is_key = |line: &str| line.starts_with('#') && line[1..].starts_with(|c: char| !c.is_whitespace());
    let lines = EXAMPLE.lines();
    lines
        .map(|line| if is_key(line) && take(line) { &line[1..] } else { line })
        .collect::<Vec<_>>()
        .join("\n")
}

#[test]
fn the_example_is_a_configuration() {
    assert_eq!(parse(EXAMPLE).unwrap(), parse(MINIMAL).unwrap());
}

#[test]
fn the_defaults_in_the_example_are_the_defaults() {
    let in_section = |line: &str| {
        ["#[", "#2 =", "#translation_m", "#quaternion", "#yaw"].iter().any(|s| line.starts_with(s))
    };
    let text = uncommented(|line| {
        !line.contains("# none")
            && !in_section(line)
            && !line.starts_with("#obstacle_period")
            && !line.starts_with("#epoch")
    });
    let (given, default) = (parse(&text).unwrap(), parse(MINIMAL).unwrap());
    assert_eq!(given.robot(9).unwrap(), default.robot(9).unwrap());
    assert_eq!(given.robot_name(), default.robot_name());
    assert_eq!(given.network, default.network);
    assert_eq!(given.sensor, default.sensor);
    assert_eq!(given.map_output, default.map_output);
    assert_eq!(given.metrics, default.metrics);
    assert_eq!(given.record, default.record);
    assert_eq!(given.ros, default.ros);
    assert_eq!(given.output, default.output);
    assert_eq!(given.store, default.store);
    assert_eq!((given.state, given.muted), (default.state, default.muted));
}

#[test]
fn every_key_is_in_the_example_and_every_example_can_be_uncommented() {
    let text = uncommented(|line| !line.starts_with("#yaw"));
    let config = parse(&text).unwrap();
    assert!(config.robot(1).is_ok());
    assert_eq!(config.alignments().unwrap().len(), 1);
    assert_eq!(config.clock_offsets().unwrap(), [(RobotId(2), 12_500)]);

    for (section, key) in keys_of(&schema()) {
        let shown = EXAMPLE.lines().any(|line| {
            let line = line.trim_start_matches('#');
            ["{key} =", "[{key}", "[{section}.{key}]"]
                .iter()
                .any(|form| line.starts_with(&form.replace("{section}", &section).replace("{key}", &key)))
        });
        assert!(shown, "{key} of [{section}] is not in the example");
    }
}

/// Section and name of each key in a schema; keys of the whole file have no section.
fn keys_of(schema: &Value) -> BTreeSet<(String, String)> {
    let properties = |of: &Value| of["properties"].as_object().cloned().unwrap_or_default();
    let mut keys = BTreeSet::new();
    for (section, inside) in properties(schema) {
        // Of a table of robots, those of each.
        let each = inside["patternProperties"].as_object().and_then(|each| each.values().next());
        let names = properties(each.unwrap_or(&inside)).into_iter();
        keys.extend(names.map(|(key, _)| (section.clone(), key)));
        keys.insert((String::new(), section));
    }
    keys
}

/// Whether a value is one that the schema allows, as far as types and names go.
fn check(at: &str, value: &toml::Value, schema: &Value) {
    if let Some(choices) = schema["anyOf"].as_array().or_else(|| schema["oneOf"].as_array()) {
        let name = |choice: &Value| choice["const"].as_str().is_none_or(|name| value.as_str() == Some(name));
        return assert!(choices.iter().any(name), "{at} is {value}, expected {choices:?}");
    }
    let kinds = match &schema["type"] {
        Value::Array(kinds) => kinds.clone(),
        kind => vec![kind.clone()],
    };
    let kind = match value {
        toml::Value::String(_) => "string",
        toml::Value::Integer(_) => "integer",
        toml::Value::Float(_) => "number",
        toml::Value::Boolean(_) => "boolean",
        toml::Value::Array(_) => "array",
        _ => "object",
    };
    let fits = |known: &Value| *known == kind || (*known == "number" && kind == "integer");
    assert!(kinds.iter().any(fits), "{at} is {value}, expected {kinds:?}");
    for (key, value) in value.as_table().into_iter().flatten() {
        let each = schema["patternProperties"].as_object().and_then(|each| each.values().next());
        let inside = schema["properties"].get(key).or(each);
        check(
            &format!("{at}.{key}"),
            value,
            inside.unwrap_or_else(|| panic!("{at}.{key} is not in the schema")),
        );
    }
    for key in schema["required"].as_array().into_iter().flatten().filter_map(Value::as_str) {
        assert!(value.get(key).is_some(), "{at}.{key} is not given");
    }
}

#[test]
fn the_schema_allows_the_example_and_has_every_key_of_the_documents() {
    let schema = schema();
    for text in [EXAMPLE.to_owned(), uncommented(|_| true)] {
        check("", &toml::Value::Table(text.parse().unwrap()), &schema);
    }
    assert_eq!(schema["additionalProperties"], false);
    assert_eq!(schema["properties"]["session"]["additionalProperties"], false);
    assert_eq!(schema["required"], serde_json::json!(["id", "map"]));
    let cast = &schema["properties"]["session"]["properties"]["cast"];
    assert!(cast.to_string().contains("\"broadcast\""), "{cast}");

    let root = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");
    let documents = std::fs::read_dir(format!("{root}/docs")).unwrap().map(|entry| entry.unwrap().path());
    let documents = documents.filter(|path| path.extension().is_some_and(|ending| ending == "md"));
    let mut blocks = 0;
    for path in documents.chain([format!("{root}/README.md").into()]) {
        let text = std::fs::read_to_string(&path).unwrap();
        for block in text.split("```toml\n").skip(1) {
            let block = block.split("```").next().unwrap();
            for (section, keys) in &block.parse::<toml::Table>().unwrap() {
                let inside = &schema["properties"][section];
                assert!(inside.is_object(), "{}: {section} is not in the schema", path.display());
                for key in keys.as_table().into_iter().flat_map(toml::Table::keys) {
                    let known = inside["properties"].get(key).is_some();
                    assert!(known, "{}: {key} of [{section}] is not in the schema", path.display());
                }
            }
            blocks += 1;
        }
        // `[section] key` in a sentence.
        for span in text.split('`').skip(1).step_by(2).filter_map(|span| span.strip_prefix('[')) {
            let Some((section, rest)) = span.split_once("] ") else { continue };
            let key = rest.split(' ').next().unwrap_or_default();
            let known = schema["properties"][section]["properties"].get(key).is_some();
            assert!(known, "{}: {key} of [{section}] is not in the schema", path.display());
        }
    }
    assert!(blocks >= 2, "{blocks} blocks of TOML");
}

#[test]
fn an_unknown_key_is_named_with_its_line_and_the_nearest_known_one() {
    let error = parse(&MINIMAL.replace("resolution_m", "resoluton_m")).unwrap_err();
    assert!(error.contains("line 3"), "{error}");
    assert!(error.contains("`resoluton_m`"), "{error}");
    assert!(error.ends_with("did you mean `resolution_m`?"), "{error}");

    let error = parse(&format!("{MINIMAL}[sesion]\nswarm = 1\n")).unwrap_err();
    assert!(error.contains("line 5") && error.ends_with("did you mean `session`?"), "{error}");

    let error = parse(&format!("{MINIMAL}[batch]\npublish_period_s = 1\n")).unwrap_err();
    assert!(error.ends_with("did you mean `publish_period_ms`?"), "{error}");
    let error = parse(&format!("{MINIMAL}[session]\nswarm_kye_file = \"x\"\n")).unwrap_err();
    assert!(error.ends_with("did you mean `swarm_key_file`?"), "{error}");
}

#[test]
fn a_key_that_has_another_name_now_is_named_by_it() {
    for (text, line, says) in [
        ("[cycle]\nt_l_ms = 500\n", "line 5", "`cycle` is called `batch` now"),
        ("[batch]\nt_l_ms = 500\n", "line 6", "`t_l_ms` is called `publish_period_ms` now"),
        ("[batch]\nt_l_occupied_ms = 500\n", "line 6", "`obstacle_period_ms` now"),
        ("[batch]\nchanges_max = 500\n", "line 6", "`voxels_max` now"),
        ("[session]\npresent_state_kb_min = 64\n", "line 6", "`snapshot_kb_min` now"),
        ("[session]\npresent_state_range_max = 64\n", "line 6", "`snapshot_range_max` now"),
    ] {
        let error = parse(&format!("{MINIMAL}{text}")).unwrap_err();
        assert!(error.contains(line) && error.ends_with(says), "{error}");
    }
}

#[test]
fn a_value_that_cannot_work_is_named_with_what_would() {
    for (text, says) in [
        ("mapper = \"octmap\"\n", ["line 5", "`rog-map`, `racer`, `octomap`", "did you mean `octomap`?"]),
        (
            "[session]\nbudget_kb_s = 0.01\n",
            ["line 6", "[session] budget_kb_s is 0.01", "0 for no limit, or at least 0.02"],
        ),
        (
            "[session]\nrelay = \"all\"\n",
            ["line 6", "[session] relay is \"all\"", "`ranked`, `always`, `never`"],
        ),
        ("[session]\nbehaviour = \"papr\"\n", ["line 6", "`default` or `paper`", "did you mean `paper`?"]),
        ("[alignment.two]\nyaw_deg = 1.0\n", ["line 5", "[alignment.two]", "its id"]),
    ] {
        let error = parse(&format!("{MINIMAL}{text}")).unwrap_err();
        assert!(says.iter().all(|part| error.contains(part)), "{error}");
    }
    let error = parse(&MINIMAL.replace("0.1", "-0.1")).unwrap_err();
    assert!(
        error.contains("line 3: [map] resolution_m is -0.1") && error.contains("0.001 to 100"),
        "{error}"
    );
    let error = parse(&MINIMAL.replace("7.0", "-7")).unwrap_err();
    assert!(error.contains("line 4: [map] range_m is -7, expected more than 0"), "{error}");
    let error = parse(&format!("{MINIMAL}range_min_m = 7.5\n")).unwrap_err();
    assert!(
        error.contains("line 5: [map] range_min_m is 7.5") && error.contains("less than range_m"),
        "{error}"
    );
    let error = parse(&MINIMAL.replace("0.1", "\"fine\"")).unwrap_err();
    assert!(error.contains("line 3"), "{error}");

    let config = parse(&format!("{MINIMAL}[network]\npeers = [\"10.0.0.2\"]\n")).unwrap();
    let error = UdpSockets::bind(&config.network).unwrap_err().to_string();
    assert!(error.contains("\"10.0.0.2\"") && error.contains("ADDRESS:PORT"), "{error}");
    let both = "[alignment.2]\nyaw_deg = 1.0\nquaternion_xyzw = [0.0, 0.0, 0.0, 1.0]\n";
    assert!(parse(&format!("{MINIMAL}{both}")).unwrap_err().contains("[alignment.2] yaw_deg is given"));
    let bad = "[alignment.2]\ntranslation_m = [nan, 0.0, 0.0]\n";
    let error = parse(&format!("{MINIMAL}{bad}")).unwrap_err();
    assert!(error.contains("line 6: [alignment.2] translation_m is [NaN, 0.0, 0.0]"), "{error}");
}

#[test]
fn the_mode_of_the_sensor_socket_is_octal_and_lets_the_owner_in() {
    let mode = |text: &str| {
        let config = parse(&format!("{MINIMAL}[sensor]\nunix_mode = \"{text}\"\n"))?;
        config.unix_mode().map_err(|error| error.to_string())
    };
    assert_eq!(parse(MINIMAL).unwrap().unix_mode().unwrap(), 0o600);
    for (text, expected) in [("0600", 0o600), ("660", 0o660), ("0666", 0o666), ("0777", 0o777)] {
        assert_eq!(mode(text).unwrap(), expected);
    }
    for text in ["", "rw-rw----", "0680", "+660", "0060", "0400", "4660", "0x1b0", "-600"] {
        let error = mode(text).unwrap_err();
        assert!(error.contains("[sensor] unix_mode") && error.contains("\"0660\" for the group"), "{error}");
    }
}

#[test]
fn a_preset_lies_below_what_is_given() {
    let text = "[session]\nbehaviour = \"paper\"\npush = true\nsnapshot_range_max = 0\n";
    let session = parse(&format!("{MINIMAL}{text}")).unwrap().session;
    let expected = SessionConfig { push: true, snapshot_range_max: None, ..SessionConfig::paper() };
    assert_eq!(session, expected);
    let map = parse(&format!("{MINIMAL}mapper = \"racer\"\np_hit = 0.8\nmemory_mb = 1\nthreads = 3\n"));
    let map = map.unwrap().map;
    let preset = MapperConfig::preset(Preset::Racer, map.resolution, 7.0);
    assert_eq!(map, MapperConfig { p_hit: 0.8, memory_bytes_max: 1 << 20, threads: 3, ..preset });
}

#[test]
fn a_node_maps_with_half_of_the_cores_and_four_threads_at_most() {
    let cores = std::thread::available_parallelism().unwrap().get();
    let threads = parse(MINIMAL).unwrap().map.threads;
    assert!((1..=4).contains(&threads) && (threads == 1 || 2 * threads <= cores), "{threads} of {cores}");
    assert!(threads == 4 || 2 * (threads + 1) > cores, "{threads} of {cores}");
    let wrong = parse(&format!("{MINIMAL}threads = 65\n")).unwrap_err();
    assert_eq!(wrong, "line 5: [map] threads is 65, expected 1 to 64");
}

#[test]
fn keys_become_options() {
    let text = format!(
        "name = \"alice\"\nepoch = 7\n{MINIMAL}[batch]\nobstacle_period_ms = 100\n[codec]\nname = \"raw\"\n\
         [session]\nbehaviour = \"paper\"\ncast = \"broadcast\"\nbudget_kb_s = 100\nrelay = \"never\"\n\
         [network]\nbind = \"127.0.0.1:1\"\npeers = [\"127.0.0.1:2\"]\n"
    );
    let config = parse(&text).unwrap();
    let robot = config.robot(99).unwrap();
    assert_eq!((robot.epoch, robot.codec, config.robot_name().as_str()), (99, Codec::Raw, "alice"));
    assert_eq!(config.epoch, Some(7));
    assert_eq!(robot.batch.obstacle_period_ms, Some(100));
    assert_eq!((robot.session.cast, robot.session.push), (Cast::Broadcast, false));
    assert_eq!(robot.session.radio_bytes_per_s, Some(102_400));
    assert_eq!(robot.session.snapshot_range_max, Some(100), "as in the paper");
    assert_eq!(config.network.peers, ["127.0.0.1:2"]);
}

#[test]
fn a_file_that_is_not_there_is_named() {
    let error = NodeConfig::read("no/such/robot.toml").unwrap_err().to_string();
    assert!(error.contains("no/such/robot.toml") && error.contains("a file that is there"), "{error}");
    let error = NodeConfig::read(std::env::temp_dir()).unwrap_err().to_string();
    assert!(error.contains("expected a file"), "{error}");
}

#[cfg(target_os = "linux")]
#[test]
fn a_file_without_an_end_is_no_configuration_and_no_key() {
    let error = NodeConfig::read("/dev/zero").unwrap_err().to_string();
    assert!(error.contains("/dev/zero: longer than 1 MiB"), "{error}");
    let config = parse(&format!("{MINIMAL}[session]\nswarm_key_file = \"/dev/zero\"\n")).unwrap();
    let error = config.swarm_key("robot.toml".as_ref(), None).unwrap_err().to_string();
    assert!(error.contains("nothing but the key"), "{error}");
}

#[test]
fn the_epoch_is_kept_where_the_system_keeps_such_things() {
    let folder = |text: &str, environment: &[(&str, &str)]| {
        let config = parse(&format!("{MINIMAL}{text}")).unwrap();
        let find =
            |name: &str| environment.iter().find(|(known, _)| *known == name).map(|(_, path)| path.into());
        config.state_folder(find).map(|path| path.display().to_string())
    };
    let home = ("HOME", "/home/robot");
    let xdg = ("XDG_STATE_HOME", "/data/state");
    let systemd = ("STATE_DIRECTORY", "/var/lib/flockmap:/var/lib/other");
    assert_eq!(folder("", &[]), None);
    assert_eq!(folder("", &[home]).as_deref(), Some("/home/robot/.local/state/flockmap"));
    assert_eq!(folder("", &[home, xdg]).as_deref(), Some("/data/state/flockmap"));
    assert_eq!(folder("", &[home, xdg, systemd]).as_deref(), Some("/var/lib/flockmap"));
    assert_eq!(folder("[state]\npath = \"/x\"\n", &[home, xdg, systemd]).as_deref(), Some("/x"));
    // What is no path to rely on is as good as none.
    let odd = [("STATE_DIRECTORY", ""), ("XDG_STATE_HOME", "state"), home];
    assert_eq!(folder("", &odd).as_deref(), Some("/home/robot/.local/state/flockmap"));
}

#[test]
fn values_count_in_place_of_those_of_a_file_and_without_any() {
    let folder = tempfile();
    let file = folder.join("robot.toml");
    std::fs::write(&file, "id = 1\n[map]\nresolution_m = 0.1\nrange_m = 7.0\n[sensor]\nrange = 1\n").unwrap();
    let read = |path: Option<&Path>, values: &str| {
        let values: toml::Table = values.parse().unwrap();
        let read = Configuration::read_with(path, &values, "the parameters");
        read.map(|read| read.config).map_err(|error| error.to_string())
    };
    let error = read(Some(&file), "map.range_m = 5.0").unwrap_err();
    let expected = format!("{} and the parameters: `range` is no key of [sensor]", file.display());
    assert!(error.starts_with(&expected), "{error}");
    std::fs::write(&file, "id = 1\n[map]\nresolution_m = 0.1\nrange_m = 7.0\n[store]\npath = \"a\"\n")
        .unwrap();
    let config =
        read(Some(&file), "map.range_m = 5.0\nmap.mapper = \"octomap\"\nros.map_frame = \"m\"").unwrap();
    assert_eq!(config.robot(1).unwrap().mapper.range_m, 5.0);
    assert_eq!(config.ros.map_frame, "m");
    assert_eq!(config.store.path, Some(folder.join("a")));
    let alone = read(None, "id = 3\nmap = { resolution_m = 0.2, range_m = 3.0 }").unwrap();
    assert_eq!(alone.id, RobotId(3));
    let error = read(None, "id = 3").unwrap_err();
    assert!(error.starts_with("the parameters: there is no section [map]"), "{error}");
    let error = read(None, "id = 3\nmap = { resolution_m = 0.2, range_m = -3.0 }").unwrap_err();
    assert!(error.starts_with("the parameters: [map] range_m is -3"), "{error}");
    std::fs::remove_dir_all(&folder).unwrap();
}

/// A folder of its own.
fn tempfile() -> PathBuf {
    let folder = std::env::temp_dir().join(format!("flockmap-values-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    folder
}

#[test]
fn who_brings_scans_says_no_source_of_them() {
    let places = |text: &str| Places::of(&format!("{MINIMAL}{text}"));
    check_applies(&places("[teammates]\nradius_m = 0.5\n[sensor]\nscan_points_max = 9\n"), true).unwrap();
    check_applies(&places("[teammates]\nradius_m = 0.5\n"), false).unwrap_err();
    let error = check_applies(&places("[sensor]\nrecord = \"a\"\n"), true).unwrap_err().to_string();
    assert_eq!(error, "[sensor] record is given, expected none: scans come from ROS here");
}

#[test]
fn submaps_of_a_record_are_its_own_and_played_once() {
    let check = |text: &str| check_applies(&Places::of(&format!("{MINIMAL}{text}")), false);
    let record = "[sensor]\nrecord = \"a\"\nsubmaps_topic = \"/slam/submaps\"\n";
    check(record).unwrap();
    for (text, expected) in [
        (format!("{record}[submaps]\nlength_m = 5.0\n"), "given, and [submaps] length_m too"),
        (format!("{record}repeat = 2\n"), "given, and [sensor] repeat too"),
        ("[sensor]\nsubmaps_topic = \"/slam/submaps\"\n".to_owned(), "expected [sensor] record beside it"),
    ] {
        let error = check(&text).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
}
