//! Reading a configuration: an error names the key, where it stands, and what was probably meant.

use std::fs::File;
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use super::NodeConfig;
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
    /// What should be the swarm key is none. Does not tell what it is.
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
            &mut config.session.swarm_key_file,
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

impl FromStr for NodeConfig {
    type Err = ConfigError;

    fn from_str(text: &str) -> Result<Self, ConfigError> {
        toml::from_str(text).map_err(|error| ConfigError::Parse {
            hint: hint(error.message()),
            text: error.to_string().trim_end().to_owned(),
        })
    }
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

/// The nearest known key, for an error about an unknown one.
fn hint(message: &str) -> String {
    // serde's fixed words: unknown field `a`, expected one of `b`, `c`
    let Some(rest) = message.strip_prefix("unknown field ") else { return String::new() };
    let mut words = rest.split('`').skip(1).step_by(2);
    let Some(unknown) = words.next() else { return String::new() };
    nearest(unknown, words).map_or_else(String::new, |known| format!("\ndid you mean `{known}`?"))
}

/// The known word that is most like `word`, if one is at all.
pub(super) fn nearest<'a>(word: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let scored = known.into_iter().map(|known| (strsim::jaro_winkler(word, known), known));
    let best = scored.max_by(|a, b| a.0.total_cmp(&b.0))?;
    (best.0 >= 0.7).then_some(best.1)
}
