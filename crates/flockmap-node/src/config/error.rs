//! What is wrong with a configuration.

use std::io;
use std::path::PathBuf;

use flockmap::RobotError;

/// A configuration that cannot be used. The user is at fault, and the text says what to change.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read {path}: {error}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// It is no TOML, or has a key or a value that cannot be there.
    #[error("{text}")]
    Parse {
        /// What and where, with the line of the file, and what was probably meant.
        text: String,
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
    #[error("{}", with_section(.0))]
    Robot(RobotError),
}

/// What a part of the robot says of an option, with the section that this stands in.
fn with_section(error: &RobotError) -> String {
    match error {
        RobotError::Mapper(error) => format!("[map] {error}"),
        RobotError::Session(error) => format!("[session] {error}"),
        RobotError::Batch { option } => format!("[batch] {option} is 0, expected at least 1"),
        other => other.to_string(),
    }
}
