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
        Configuration::read(path.as_ref()).map(|read| read.config)
    }

    /// Takes the relative paths in it from this folder.
    fn in_folder(mut self, folder: &Path) -> Self {
        let Self { sensor, map_output, record, output, store, state, swarm_key_file, .. } = &mut self;
        for file in [
            swarm_key_file,
            &mut sensor.record,
            &mut sensor.poses,
            &mut sensor.listen_unix,
            &mut map_output.listen_unix,
            &mut record.path,
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

/// A configuration, where it is from, and where its keys stand.
#[derive(Clone, Debug)]
pub struct Configuration {
    /// What it says.
    pub config: NodeConfig,
    pub(crate) places: Places,
    /// The file, if there is one.
    pub(crate) path: PathBuf,
}

impl Configuration {
    /// Reads a configuration file, as [`NodeConfig::read`].
    ///
    /// # Errors
    /// As there.
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let text = read_file(path)?;
        let in_file = |error: ConfigError| parse_error(format!("{}: {error}", path.display()));
        let config: NodeConfig = text.parse().map_err(in_file)?;
        let places = Places::of(&text).in_file(path);
        Ok(Self { config: config.in_folder(folder_of(path)), places, path: path.to_owned() })
    }

    /// The same with values that count in place of those of the file, or beside them, or without any file.
    /// They come as tables, as in a file. `source` says where they are from, for errors.
    ///
    /// # Errors
    /// As of [`Self::read`], without a line where values are wrong.
    pub fn read_with(path: Option<&Path>, values: &toml::Table, source: &str) -> Result<Self, ConfigError> {
        if let (Some(path), true) = (path, values.is_empty()) {
            return Self::read(path);
        }
        let (mut table, folder) = match path {
            Some(path) => {
                let text = read_file(path)?;
                let no_toml = |error: toml::de::Error| explain(&text, &Places::default(), &error);
                let in_file = |error: ConfigError| parse_error(format!("{}: {error}", path.display()));
                (text.parse::<toml::Table>().map_err(no_toml).map_err(in_file)?, folder_of(path))
            }
            None => (toml::Table::new(), Path::new("")),
        };
        overlay(&mut table, values);
        // Lines of this text are those of no file.
        let text = table.to_string();
        let places = Places::of(&text).without_lines();
        let file = path.map(|path| format!("{} and ", path.display())).unwrap_or_default();
        let config =
            parse(&text, &places).map_err(|error| parse_error(format!("{file}{source}: {error}")))?;
        Ok(Self {
            config: config.in_folder(folder),
            places,
            path: path.unwrap_or_else(|| Path::new("")).to_owned(),
        })
    }
}

/// Values in place of others, and beside them.
fn overlay(table: &mut toml::Table, values: &toml::Table) {
    for (key, value) in values {
        match (table.get_mut(key), value) {
            (Some(toml::Value::Table(inside)), toml::Value::Table(values)) => overlay(inside, values),
            _ => drop(table.insert(key.clone(), value.clone())),
        }
    }
}

fn read_file(path: &Path) -> Result<String, ConfigError> {
    let fail = |error| ConfigError::Read { path: path.to_owned(), error: read_error(error) };
    let too_long = || parse_error(format!("{}: longer than 1 MiB, so no configuration", path.display()));
    read_text(path, CONFIG_BYTES_MAX).map_err(fail)?.ok_or_else(too_long)
}

fn folder_of(path: &Path) -> &Path {
    path.parent().unwrap_or_else(|| Path::new(""))
}

const fn parse_error(text: String) -> ConfigError {
    ConfigError::Parse { text }
}

impl FromStr for NodeConfig {
    type Err = ConfigError;

    fn from_str(text: &str) -> Result<Self, ConfigError> {
        parse(text, &Places::of(text))
    }
}

fn parse(text: &str, places: &Places) -> Result<NodeConfig, ConfigError> {
    let config = read(text).map_err(|error| explain(text, places, &error))?;
    let checked = config.check().map_err(|error| places.locate(&error.to_string()));
    checked.map(|()| config).map_err(parse_error)
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
    let mapper =
        MapperConfig { threads: threads(), ..MapperConfig::preset(preset(file, "map", "mapper"), ANY, 0.0) };
    Ok([("map", toml::to_string(&mapper)?), ("session", toml::to_string(&session)?)])
}

/// Threads of the mapper unless the file says how many: half of the cores, at most 4.
fn threads() -> usize {
    std::thread::available_parallelism().map_or(1, |cores| (cores.get() / 2).clamp(1, 4))
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
