use super::*;
use flockmap::{Cast, Codec, RobotId};

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
    assert_eq!(given.udp().unwrap(), default.udp().unwrap());
    assert_eq!(given.sensor, default.sensor);
    assert_eq!(given.metrics, default.metrics);
    assert_eq!(given.output, default.output);
    assert_eq!(given.store, default.store);
}

#[test]
fn every_key_is_in_the_example_and_every_example_can_be_uncommented() {
    let text = uncommented(|line| !line.starts_with("#yaw"));
    let config = parse(&text).unwrap();
    assert!(config.robot(1).is_ok() && config.udp().is_ok());
    assert_eq!(config.alignments().unwrap().len(), 1);
    assert_eq!(config.clock_offsets().unwrap(), [(RobotId(2), 12_500)]);

    let sections =
        ["", "map", "batch", "codec", "session", "fusion", "store", "state", "network", "sensor", "metrics"];
    for section in sections.iter().chain(&["alignment.2", "teammates", "output"]) {
        // An error about an unknown key lists the known ones.
        let text = match *section {
            "" => format!("nonsense = 1\n{MINIMAL}"),
            "map" => format!("{MINIMAL}nonsense = 1\n"),
            _ => format!("{MINIMAL}[{section}]\nnonsense = 1\n"),
        };
        let error = parse(&text).unwrap_err();
        let known =
            error.lines().find_map(|line| line.strip_prefix("unknown field `nonsense`, expected ")).unwrap();
        for key in known.split('`').skip(1).step_by(2) {
            let shown = EXAMPLE.lines().any(|line| {
                let line = line.trim_start_matches('#');
                line.starts_with(&format!("{key} =")) || line.starts_with(&format!("[{key}"))
            });
            assert!(shown, "{key} of [{section}] is not in the example");
        }
    }
}

#[test]
fn an_unknown_key_is_named_with_its_line_and_the_nearest_known_one() {
    let error = parse(&MINIMAL.replace("resolution_m", "resoluton_m")).unwrap_err();
    assert!(error.contains("line 3"), "{error}");
    assert!(error.contains("`resoluton_m`"), "{error}");
    assert!(error.ends_with("did you mean `resolution_m`?"), "{error}");

    let error = parse(&format!("{MINIMAL}[sesion]\nswarm = 1\n")).unwrap_err();
    assert!(error.contains("line 5") && error.ends_with("did you mean `session`?"), "{error}");

    let error = parse(&format!("{MINIMAL}[batch]\nt_l_s = 1\n")).unwrap_err();
    assert!(error.ends_with("did you mean `publish_period_ms`?"), "{error}");
}

#[test]
fn a_value_that_cannot_work_is_named_with_what_would() {
    let robot = |text: &str| parse(text).unwrap().robot(1).unwrap_err().to_string();
    let error = robot(&format!("{MINIMAL}mapper = \"octmap\"\n"));
    assert!(error.contains("[map] mapper") && error.contains("did you mean \"octomap\"?"), "{error}");
    let error = robot(&format!("{MINIMAL}[session]\nbudget_kb_s = 0.4\n"));
    assert!(error.contains("budget_kb_s is 0.4") && error.contains("at least 0.49"), "{error}");
    let error = robot(&MINIMAL.replace("0.1", "-0.1"));
    assert!(error.contains("resolution_m is -0.1"), "{error}");
    let error = parse(&MINIMAL.replace("0.1", "\"fine\"")).unwrap_err();
    assert!(error.contains("line 3"), "{error}");

    let config = parse(&format!("{MINIMAL}[network]\npeers = [\"10.0.0.2\"]\n")).unwrap();
    let error = config.udp().unwrap_err().to_string();
    assert!(error.contains("\"10.0.0.2\"") && error.contains("ADDRESS:PORT"), "{error}");
    let config = parse(&format!("{MINIMAL}[alignment.two]\nyaw_deg = 1.0\n")).unwrap();
    assert!(config.alignments().unwrap_err().to_string().contains("two"));
    let both = "[alignment.2]\nyaw_deg = 1.0\nquaternion_xyzw = [0.0, 0.0, 0.0, 1.0]\n";
    assert!(parse(&format!("{MINIMAL}{both}")).unwrap().alignments().is_err());
    let bad = "[alignment.2]\ntranslation_m = [nan, 0.0, 0.0]\n";
    assert!(parse(&format!("{MINIMAL}{bad}")).unwrap().alignments().is_err());
}

#[test]
fn the_mode_of_the_sensor_socket_is_octal_and_lets_the_owner_in() {
    let mode =
        |text: &str| parse(&format!("{MINIMAL}[sensor]\nunix_mode = \"{text}\"\n")).unwrap().unix_mode();
    assert_eq!(parse(MINIMAL).unwrap().unix_mode().unwrap(), 0o600);
    for (text, expected) in [("0600", 0o600), ("660", 0o660), ("0666", 0o666), ("0777", 0o777)] {
        assert_eq!(mode(text).unwrap(), expected);
    }
    for text in ["", "rw-rw----", "0680", "+660", "0060", "0400", "4660", "0x1b0", "-600"] {
        let error = mode(text).unwrap_err().to_string();
        assert!(error.contains("[sensor] unix_mode") && error.contains("\"0660\" for the group"), "{error}");
    }
}

#[test]
fn words_become_options() {
    let text = format!(
        "name = \"alice\"\nepoch = 7\n{MINIMAL}[batch]\nt_l_occupied_ms = 100\n[codec]\nname = \"raw\"\n\
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
    assert_eq!(config.udp().unwrap().peers, ["127.0.0.1:2".parse().unwrap()]);
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
