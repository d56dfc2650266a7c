//! Reading a configuration: an error names the key, where it stands, and what was probably meant.

use std::fs::File;
use std::io::{self, Read as _};
use std::path::Path;
use std::str::FromStr;

use flockmap::{MapperConfig, Resolution, SessionConfig};
use serde::Deserialize;
use serde::de::Error as _;
use toml::Spanned;
use toml::de::{DeTable, DeValue, ValueDeserializer};

use super::error::ConfigError;
use super::explain::explain;
use super::places::Places;
use super::schema::{OWN_KEYS, REQUIRED};
use super::{Behaviour, NodeConfig};
use crate::advice::read_error;

/// A file with more than this is no configuration.
const CONFIG_BYTES_MAX: u64 = 1 << 20;

impl NodeConfig {
    /// Reads a configuration file of at most 1 MiB. Relative paths in it are taken from its folder.
    ///
    /// # Errors
    /// An unknown key is an error that names the key, its line, and the nearest known one.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, ConfigError> {
        read_with_places(path.as_ref()).map(|(config, _)| config)
    }

    /// Takes the relative paths in it from this folder.
    fn in_folder(mut self, folder: &Path) -> Self {
        let Self { sensor, map_output, output, store, state, swarm_key_file, .. } = &mut self;
        for file in [
            swarm_key_file,
            &mut sensor.record,
            &mut sensor.poses,
            &mut sensor.listen_unix,
            &mut map_output.listen_unix,
            &mut output.save_map_at_end,
            &mut output.report_json,
            &mut store.path,
            &mut state.path,
        ] {
            *file = file.take().map(|file| folder.join(file));
        }
        self
    }
}

/// A configuration file, and where its keys stand.
pub(crate) fn read_with_places(path: &Path) -> Result<(NodeConfig, Places), ConfigError> {
    let fail = |error| ConfigError::Read { path: path.to_owned(), error: read_error(error) };
    let in_file = |text: &str| ConfigError::Parse { text: format!("{}: {text}", path.display()) };
    let text = read_text(path, CONFIG_BYTES_MAX).map_err(fail)?;
    let text = text.ok_or_else(|| in_file("longer than 1 MiB, so no configuration"))?;
    let config: NodeConfig = text.parse().map_err(|error: ConfigError| in_file(&error.to_string()))?;
    let places = Places::of(&text).in_file(path);
    Ok((config.in_folder(path.parent().unwrap_or_else(|| Path::new(""))), places))
}

impl FromStr for NodeConfig {
    type Err = ConfigError;

    fn from_str(text: &str) -> Result<Self, ConfigError> {
        let places = Places::of(text);
        let config = read(text).map_err(|error| explain(text, &places, &error))?;
        let checked = config.check().map_err(|error| places.locate(&error.to_string()));
        checked.map(|()| config).map_err(|text| ConfigError::Parse { text })
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
