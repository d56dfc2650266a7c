//! Reading a configuration: an error names the key, where it stands, and what was probably meant.

use std::fs::File;
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use flockmap::{MapperConfig, Resolution, SessionConfig};
use serde::Deserialize;
use serde::de::Error as _;
use toml::Spanned;
use toml::de::{DeTable, DeValue, ValueDeserializer};

use super::{Behaviour, NodeConfig};
use crate::advice::read_error;

/// A file with more than this is no configuration.
const CONFIG_BYTES_MAX: u64 = 1 << 20;

/// A configuration that cannot be used. The user is at fault, and the text says what to change.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read {path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// It is no TOML, or has a key or a value that cannot be there.
    #[error("{text}{hint}")]
    Parse {
        /// What and where, with the line of the file.
        text: String,
        /// What was probably meant; may be empty.
        hint: String,
    },
    /// A value that cannot work.
    #[error("{key} is {got}, expected {expected}")]
    Value {
        /// The key, with its section.
        key: String,
        /// What it is.
        got: String,
        /// What would work.
        expected: String,
    },
    /// What should be the swarm key is none. Does not contain it.
    #[error("{key} (from {place}): {error}")]
    Key {
        /// The key of the configuration, or the environment variable.
        key: String,
        /// Where it was found.
        place: String,
        /// What is wrong with it.
        error: flockmap::sync::KeyError,
    },
    /// A part of the robot refuses its options.
    #[error(transparent)]
    Robot(#[from] flockmap::RobotError),
}

impl NodeConfig {
    /// Reads a configuration file of at most 1 MiB. Relative paths in it are taken from its folder.
    ///
    /// # Errors
    /// An unknown key is an error that names the key, its line, and the nearest known one.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, ConfigError> {
        let path = path.as_ref();
        let fail = |source| ConfigError::Read { path: path.to_owned(), source };
        let Some(text) = read_text(path, CONFIG_BYTES_MAX).map_err(|error| fail(read_error(error)))? else {
            let text = format!("{}: longer than 1 MiB, so no configuration", path.display());
            return Err(ConfigError::Parse { text, hint: String::new() });
        };
        let mut config: Self = text.parse().map_err(|error| match error {
            ConfigError::Parse { text, hint } => {
                ConfigError::Parse { text: format!("{}: {text}", path.display()), hint }
            }
            other => other,
        })?;
        let folder = path.parent().unwrap_or_else(|| Path::new(""));
        let sensor = &mut config.sensor;
        let output = &mut config.output;
        for file in [
            &mut config.swarm_key_file,
            &mut sensor.record,
            &mut sensor.poses,
            &mut sensor.listen_unix,
            &mut output.save_map_at_end,
            &mut output.report_json,
            &mut config.store.path,
            &mut config.state.path,
        ] {
            *file = file.take().map(|file| folder.join(file));
        }
        Ok(config)
    }
}

/// Keys of the node that stand in sections of the robot's options. They are read as keys of the whole file.
pub(super) const OWN_KEYS: [(&str, &str); 5] = [
    ("map", "mapper"),
    ("session", "behaviour"),
    ("session", "swarm_key"),
    ("session", "swarm_key_file"),
    ("fusion", "muted"),
];

/// Keys of `[map]` that no preset can have.
pub(super) const REQUIRED: [&str; 2] = ["resolution_m", "range_m"];

/// What keys were called before.
const RENAMED: [(&str, &str); 6] = [
    ("cycle", "batch"),
    ("t_l_ms", "publish_period_ms"),
    ("t_l_occupied_ms", "obstacle_period_ms"),
    ("changes_max", "voxels_max"),
    ("present_state_kb_min", "snapshot_kb_min"),
    ("present_state_range_max", "snapshot_range_max"),
];

impl FromStr for NodeConfig {
    type Err = ConfigError;

    fn from_str(text: &str) -> Result<Self, ConfigError> {
        read(text).map_err(|mut error| {
            error.set_input(Some(text));
            ConfigError::Parse { hint: hint(error.message()), text: error.to_string().trim_end().to_owned() }
        })
    }
}

/// Reads a configuration, with the values of its presets below its own.
fn read(text: &str) -> Result<NodeConfig, toml::de::Error> {
    let presets = presets(DeTable::parse(text)?.get_ref()).map_err(toml::de::Error::custom)?;
    let mut file = DeTable::parse(text)?;
    for (section, preset) in &presets {
        let Some(given) = section_of(&mut file, section) else { continue };
        for (key, value) in DeTable::parse(preset)?.into_inner() {
            if !REQUIRED.contains(&key.get_ref().as_ref()) {
                given.entry(key).or_insert(value);
            }
        }
    }
    for (section, key) in OWN_KEYS {
        let own = section_of(&mut file, section).and_then(|given| given.remove_entry(key));
        if let Some((name, value)) = own {
            let name = Spanned::new(name.span(), format!("{section}.{key}").into());
            file.get_mut().insert(name, value);
        }
    }
    NodeConfig::deserialize(toml::Deserializer::from(file))
}

fn section_of<'a, 'i>(file: &'a mut Spanned<DeTable<'i>>, section: &str) -> Option<&'a mut DeTable<'i>> {
    match file.get_mut().get_mut(section)?.get_mut() {
        DeValue::Table(section) => Some(section),
        _ => None,
    }
}

/// The values of the presets that a file names, by section.
fn presets(file: &DeTable<'_>) -> Result<[(&'static str, String); 2], toml::ser::Error> {
    const ANY: Resolution = Resolution::from_micrometres(100_000).unwrap();
    let session = match preset(file, "session", "behaviour") {
        Behaviour::Default => SessionConfig::default(),
        Behaviour::Paper => SessionConfig::paper(),
    };
    let mapper = MapperConfig::preset(preset(file, "map", "mapper"), ANY, 0.0);
    Ok([("map", toml::to_string(&mapper)?), ("session", toml::to_string(&session)?)])
}

/// The preset that a key names. One that is none is an error when the whole file is read.
fn preset<'i, T: Default + Deserialize<'i>>(file: &DeTable<'i>, section: &str, key: &str) -> T {
    let name = file.get(section).and_then(|section| section.get_ref().get(key)).cloned();
    name.and_then(|name| T::deserialize(ValueDeserializer::from(name)).ok()).unwrap_or_default()
}

/// A text file; `None` if it is longer than allowed, also where its length is not known before, as of a pipe.
pub(super) fn read_text(path: &Path, bytes_max: u64) -> io::Result<Option<String>> {
    let mut bytes = Vec::new();
    File::open(path)?.take(bytes_max + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > bytes_max {
        return Ok(None);
    }
    String::from_utf8(bytes).map(Some).map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))
}

/// What was probably meant, for an error about an unknown key or name.
fn hint(message: &str) -> String {
    // serde's fixed texts: unknown field `a`, expected one of `b`, `c`
    let unknown = message.strip_prefix("unknown field ").or_else(|| message.strip_prefix("unknown variant "));
    let mut words = unknown.unwrap_or_default().split('`').skip(1).step_by(2);
    let Some(unknown) = words.next() else { return String::new() };
    if let Some((_, new)) = RENAMED.iter().find(|(old, _)| *old == unknown) {
        return format!("\n`{unknown}` is called `{new}` now");
    }
    let known = words.chain(OWN_KEYS.map(|(_, key)| key));
    let scored = known.map(|known| (strsim::jaro_winkler(unknown, known), known));
    let best = scored.max_by(|a, b| a.0.total_cmp(&b.0)).filter(|(score, _)| *score >= 0.7);
    best.map_or_else(String::new, |(_, known)| format!("\ndid you mean `{known}`?"))
}
