//! What prose says of a default is what the code has: each "Default …" in the documentation of a field is
//! compared with the value that the type has by default. One that nobody compares is an error too.

use std::collections::BTreeMap;
use std::fmt::Debug;
use std::path::Path;

use flockmap::{
    BatchConfig, FusionConfig, MapperConfig, Preset, Resolution, RobotConfig, RobotId, SessionConfig,
};
use flockmap_autonomy::application::{ApplicationOptions, SeriesOptions};
use flockmap_autonomy::{ExploreOptions, MotionLimits, NavigationConfig};
use flockmap_feed::MirrorOptions;
use flockmap_io::{ExportOptions, RecordOptions};
use flockmap_netsim::{Link, RadioConfig};
use flockmap_node::store::StoreOptions;
use flockmap_node::{EndOptions, NodeConfig, StateSection, UdpOptions};
use flockmap_plan::{FieldConfig, FrontierConfig};
use flockmap_worlds::{ObstacleOptions, ScanOptions, TrajectoryOptions};

/// Crates whose options are those of a program: its help has most defaults from the code.
const PROGRAMS: [&str; 2] = ["flockmap-cli", "flockmap-bench"];

/// The types that have a default, as `Debug` shows it.
fn defaults() -> BTreeMap<&'static str, String> {
    fn shown(value: impl Debug) -> String {
        format!("{value:#?}")
    }
    let resolution = Resolution::from_micrometres(100_000).unwrap();
    let robot = RobotConfig::new(RobotId(1), resolution, 7.0);
    let node: NodeConfig = "id = 1\n[map]\nresolution_m = 0.1\nrange_m = 7.0\n".parse().unwrap();
    BTreeMap::from([
        ("ApplicationOptions", shown(ApplicationOptions::default())),
        ("BatchConfig", shown(BatchConfig::default())),
        ("EndOptions", shown(EndOptions::default())),
        ("ExploreOptions", shown(ExploreOptions::default())),
        ("ExportOptions", shown(ExportOptions::default())),
        ("FieldConfig", shown(FieldConfig::default())),
        ("FrontierConfig", shown(FrontierConfig::default())),
        ("FusionConfig", shown(FusionConfig::default())),
        ("Link", shown(Link::default())),
        ("MapperConfig", shown(MapperConfig::preset(Preset::default(), resolution, 7.0))),
        ("MirrorOptions", shown(MirrorOptions::default())),
        ("MotionLimits", shown(MotionLimits::default())),
        ("NavigationConfig", shown(NavigationConfig::new(resolution, [[0.0; 3]; 2]))),
        ("NodeConfig", shown(node)),
        ("ObstacleOptions", shown(ObstacleOptions::default())),
        ("RadioConfig", shown(RadioConfig::default())),
        ("RecordOptions", shown(RecordOptions::default())),
        ("RobotConfig", shown(robot)),
        ("ScanOptions", shown(ScanOptions::default())),
        ("SeriesOptions", shown(SeriesOptions::default())),
        ("SessionConfig", shown(SessionConfig::default())),
        ("StateSection", shown(StateSection::default())),
        ("StoreOptions", shown(StoreOptions::default())),
        ("TrajectoryOptions", shown(TrajectoryOptions::default())),
        ("UdpOptions", shown(UdpOptions::default())),
    ])
}

/// Defaults that are said in words: what the words mean in the code.
const WORDS: &[(&str, &str, &str)] = &[
    ("ApplicationOptions", "sync", "Radio { rate_bytes_per_s: None, loss: 0.0, delay_ms: 20, }"),
    (
        "ExploreOptions",
        "scan",
        "ScanOptions { range_m: 30.0, min_range_m: 0.3, no_returns: true, range_noise_m: 0.0, drop_out: 0.0, motion: false, \
         rendering: Cast, seed: 0, }",
    ),
    (
        "ExploreOptions",
        "limits",
        "MotionLimits { speed_m_s: 2.0, acceleration_m_s2: 2.0, yaw_rate_rad_s: 2.0, }",
    ),
    ("ExploreOptions", "region_m", "None"),
    ("ExportOptions", "free", "false"),
    ("MirrorOptions", "blocks_max", "1048576"),
    ("NodeConfig", "name", "None"),
    ("RadioConfig", "is_shared", "false"),
    ("RecordOptions", "points_topic", "None"),
    ("RecordOptions", "odometry_topic", "None"),
    ("RecordOptions", "map_frame", "None"),
    ("RecordOptions", "submaps_topic", "None"),
    ("RecordOptions", "poses", "None"),
    ("RecordOptions", "scan_period_s", "None"),
    ("SessionConfig", "in_flight", "RoundTrip"),
    ("StateSection", "path", "None"),
    ("UdpOptions", "multicast_interface", "None"),
];

/// Every public field that says its default: its type, its name, and what follows the word.
fn statements(source: &Path) -> Vec<(String, String, String)> {
    let file = syn::parse_file(&std::fs::read_to_string(source).unwrap()).unwrap();
    let structs =
        file.items.iter().filter_map(|item| if let syn::Item::Struct(of) = item { Some(of) } else { None });
    let mut found = Vec::new();
    for of in structs {
        for field in &of.fields {
            let Some(name) = &field.ident else { continue };
            let text = documentation(field);
            let text = text.replace("Default", "default");
            for (at, _) in text.match_indices("default") {
                let rest = text[at + "default".len()..].trim_start_matches(':');
                // Not where it is part of another word, or talks of something else.
                if rest.starts_with(' ')
                    && text[..at].ends_with(['.', ' ', ';', '\n'])
                    && says_a_value(&text[..at])
                {
                    found.push((of.ident.to_string(), name.to_string(), rest.trim().to_owned()));
                }
            }
        }
    }
    found
}

/// A statement begins a sentence, or follows a semicolon or a comma.
fn says_a_value(before: &str) -> bool {
    let before = before.trim_end();
    before.is_empty() || before.ends_with(['.', ';', ',', ')'])
}

fn documentation(field: &syn::Field) -> String {
    let lines = field.attrs.iter().filter(|attr| attr.path().is_ident("doc")).filter_map(|attr| {
        let syn::Meta::NameValue(pair) = &attr.meta else { return None };
        let syn::Expr::Lit(syn::ExprLit { lit: syn::Lit::Str(text), .. }) = &pair.value else { return None };
        Some(text.value().trim().to_owned())
    });
    lines.collect::<Vec<_>>().join(" ")
}

/// The fields of a value as `{:#?}` shows it.
fn fields(shown: &str) -> BTreeMap<&str, String> {
    let mut fields: BTreeMap<&str, String> = BTreeMap::new();
    let mut last = None;
    for line in shown.lines() {
        let inner = line.strip_prefix("    ").filter(|inner| !inner.starts_with([' ', '}', ']', ')']));
        if let Some((name, value)) = inner.and_then(|inner| inner.split_once(": ")) {
            last = Some(name);
            fields.insert(name, value.to_owned());
        } else if line != "}"
            && let Some(value) = last.and_then(|name| fields.get_mut(name))
        {
            value.push(' ');
            value.push_str(line.trim());
        }
    }
    fields.into_iter().map(|(name, value)| (name, value.trim_end_matches(',').to_owned())).collect()
}

/// Whether a statement says what a value is.
fn agrees(field: &str, said: &str, value: &str) -> bool {
    if let Some(name) = said.trim_start_matches('[').strip_prefix('`').and_then(|said| said.split('`').next())
    {
        let name = name.rsplit("::").next().filter(|_| said.starts_with('[')).unwrap_or(name);
        return plain(name) == plain(value.trim_matches('"'));
    }
    let first = said.split([' ', '.', ',', ';', ':']).next().unwrap_or_default();
    match first {
        "yes" | "true" => return value == "true",
        "no" | "false" => return value == "false",
        "never" | "none" => return value == "None",
        _ => {}
    }
    let (numbers, unit) = numbers_of(said);
    if numbers.is_empty() {
        return !first.is_empty() && plain(value).starts_with(&plain(first));
    }
    let factor = match unit.as_str() {
        "KiB" => 1024.0,
        "KB/s" => 1024.0,
        "MiB" => 1_048_576.0,
        "s" if field.ends_with("micros") => 1e6,
        "ms" if value.ends_with('s') || field.ends_with("micros") => 1e-3,
        _ => 1.0,
    };
    let factor = if unit == "ms" && field.ends_with("micros") { 1e3 } else { factor };
    let expected: Vec<f64> = numbers.iter().map(|number| number * factor).collect();
    // As a span: 500ms.
    let scale = if value.ends_with("ms") { 1e-3 } else { 1.0 };
    let got: Vec<f64> = numbers_in(value).iter().map(|number| number * scale).collect();
    expected.len() == got.len() && expected.iter().zip(&got).all(|(a, b)| (a - b).abs() <= 1e-9 * b.abs())
}

/// A name without what differs between prose and code.
fn plain(name: &str) -> String {
    name.chars().filter(|c| !['-', '_', ' '].contains(c)).flat_map(char::to_lowercase).collect()
}

/// The numbers at the start of a statement, and the unit of the last.
fn numbers_of(said: &str) -> (Vec<f64>, String) {
    let mut numbers = Vec::new();
    let mut unit = String::new();
    for word in said.split(' ') {
        let number = word.trim_end_matches([',', '.', ';', ':']);
        let is_last = word.ends_with(['.', ';', ':']);
        if let Ok(number) = number.replace(',', "").parse::<f64>() {
            numbers.push(number);
        } else if !["to", "and"].contains(&number) {
            if !numbers.is_empty() && !number.starts_with('(') {
                unit = number.to_owned();
            }
            break;
        }
        if is_last {
            break;
        }
    }
    (numbers, unit)
}

fn numbers_in(value: &str) -> Vec<f64> {
    let words = value.split(|c: char| !(c.is_ascii_digit() || c == '.' || c == '-' || c == 'e'));
    words.filter_map(|word| word.trim_matches('.').parse().ok()).collect()
}

fn sources(of: impl Fn(&str) -> bool) -> Vec<std::path::PathBuf> {
    fn walk(folder: &Path, into: &mut Vec<std::path::PathBuf>) {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                walk(&path, into);
            } else if path.extension().is_some_and(|end| end == "rs") {
                into.push(path);
            }
        }
    }
    let mut found = Vec::new();
    for entry in std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/..")).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() && of(&path.file_name().unwrap().to_string_lossy()) {
            walk(&path.join("src"), &mut found);
        }
    }
    found
}

#[test]
fn a_default_that_is_written_down_is_the_default() {
    let defaults = defaults();
    let mut faults = Vec::new();
    let (mut types, mut words) = (Vec::new(), Vec::new());
    let sources = sources(|name| !PROGRAMS.contains(&name));
    let statements: Vec<_> = sources.iter().flat_map(|source| statements(source)).collect();
    for (of, field, said) in &statements {
        let place = format!("{of}::{field}");
        let Some(shown) = defaults.get(of.as_str()) else {
            faults.push(format!(
                "{place} says \"default {said}\", and {of} is not among the types of this test"
            ));
            continue;
        };
        types.push(of.as_str());
        let fields = fields(shown);
        let Some(value) = fields.get(field.as_str()) else {
            faults.push(format!("{place}: not in {shown}"));
            continue;
        };
        let in_words = WORDS.iter().find(|(a, b, _)| (*a, *b) == (of.as_str(), field.as_str()));
        let is_right = match in_words {
            Some((_, _, meant)) => {
                words.push((of.as_str(), field.as_str()));
                value == meant
            }
            None => agrees(field, said, value),
        };
        if !is_right {
            faults.push(format!("{place} says \"default {said}\", and it is {value}"));
        }
    }
    faults
        .extend(defaults.keys().filter(|of| !types.contains(of)).map(|of| format!("{of} states no default")));
    faults.extend(
        WORDS
            .iter()
            .filter(|(a, b, _)| !words.contains(&(a, b)))
            .map(|(a, b, _)| format!("{a}::{b}: no such words")),
    );
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    assert!(statements.len() > 100, "{} statements", statements.len());
}

#[test]
fn prose_and_code_that_differ_are_found() {
    for (field, said, value) in [
        ("codec", "`flock`.", "Flock"),
        ("memory_bytes_max", "512 MiB.", "536870912"),
        ("period_ms", "2,000: longer than that.", "2000"),
        ("own_priority_micros", "1 s.", "1000000"),
        ("linger", "500 ms.", "500ms"),
        ("sync_period", "1 s.", "1s"),
        ("limit", "`None`: no limit.", "None"),
        ("push", "yes; the paper does not.", "true"),
        ("size_m", "0.6 to 0.8.", "[ 0.6, 0.8, ]"),
        ("bytes", "65,536; more is more.", "Some( 65536, )"),
    ] {
        assert!(agrees(field, said, value), "{field}: {said} is {value}");
        for other in ["7", "Paper", "[ 0.6, 0.9, ]", "None", "false", "501ms", "2s"] {
            assert!(other == value || !agrees(field, said, other), "{field}: {said} is not {other}");
        }
    }
}

/// Most numbers in a help text are from the code. Of those that are written there, what they are in it.
#[test]
fn a_number_in_a_help_text_is_the_default() {
    let (session, flight) = (SessionConfig::default(), TrajectoryOptions::default());
    let kib = (session.radio_bytes_per_s.unwrap() / 1_024).into();
    let explorer = ExploreOptions::default().limits.speed_m_s;
    let known = BTreeMap::from([
        ("budget_kb_s", vec![kib]),
        ("seconds", vec![flight.duration_s]),
        ("speed", vec![flight.speed_m_s, explorer]),
        // A rule of `sources.rs` for files, and no option of a library.
        ("world_resolution", vec![0.1, 0.2]),
    ]);
    let mut checked = 0;
    for source in sources(|name| name == "flockmap-cli") {
        for (of, field, said) in statements_in_help(&source) {
            let said = said.split(']').next().unwrap().replace(',', "");
            let numbers: Vec<f64> = said.split([' ', ';']).filter_map(|word| word.parse().ok()).collect();
            // What is drawn is drawn.
            if numbers.is_empty() || said.starts_with("drawn") {
                continue;
            }
            assert_eq!(known.get(field.as_str()), Some(&numbers), "{of}::{field} says [default: {said}]");
            checked += 1;
        }
    }
    assert!(checked >= 4, "{checked}");
}

fn statements_in_help(source: &Path) -> Vec<(String, String, String)> {
    let file = syn::parse_file(&std::fs::read_to_string(source).unwrap()).unwrap();
    let structs =
        file.items.iter().filter_map(|item| if let syn::Item::Struct(of) = item { Some(of) } else { None });
    let said = |of: &syn::ItemStruct, field: &syn::Field| {
        let text = documentation(field);
        let (_, said) = text.split_once("[default: ")?;
        Some((of.ident.to_string(), field.ident.as_ref()?.to_string(), said.to_owned()))
    };
    structs.flat_map(|of| of.fields.iter().filter_map(move |field| said(of, field))).collect()
}
