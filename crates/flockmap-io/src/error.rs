//! What went wrong with a file, where in it, and what was expected there.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

/// A file that cannot be read, or not to its end: which file, the place in it, and what was expected and found.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
#[error("{}: {place}{problem}", path.display())]
pub struct ReadError {
    /// The file or folder.
    pub path: PathBuf,
    /// Where in the file.
    pub place: Place,
    /// What is wrong there.
    pub problem: Problem,
}

/// A place in a file.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub enum Place {
    /// The file as a whole.
    #[default]
    Whole,
    /// Offset from the start of the file.
    Byte(u64),
    /// Line of a text file or text header, counted from 1.
    Line(u64),
    /// Message of a record.
    Message {
        /// Topic of the message.
        topic: Box<str>,
        /// Number of the message on its topic, counted from 1 through all files of the record.
        number: u64,
        /// Offset from the start of the message, if one byte of it is meant.
        byte: Option<u64>,
    },
}

/// What is wrong with a file.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Problem {
    /// The operating system could not deliver the file.
    #[error("cannot read: {message}")]
    Io {
        /// Its kind of error.
        kind: io::ErrorKind,
        /// Its words.
        message: String,
    },
    /// The file breaks the rules of its own format.
    #[error("damaged: expected {expected}, found {found}")]
    Damaged {
        /// What the format asks for.
        expected: String,
        /// What is there.
        found: String,
    },
    /// The file ends before it is complete.
    #[error("ends too early: expected {expected}, found {found}")]
    Truncated {
        /// What should have followed.
        expected: String,
        /// What is left.
        found: String,
    },
    /// The file may be in order, but it is not one that can be used here.
    #[error("cannot be used: expected {expected}, found {found}")]
    Foreign {
        /// What can be used.
        expected: String,
        /// What the file has.
        found: String,
    },
    /// There are several topics and nothing tells which one is meant.
    #[error("cannot be used: expected one topic of {of}, or the name of the one to take, found {}", topics.join(", "))]
    SeveralTopics {
        /// What they are topics of.
        of: TopicOf,
        /// Their names, at most 64.
        topics: Vec<String>,
    },
    /// The file asks for more than the limit. Raise the limit in the options where there is one.
    #[error("{what} is {found}, the limit is {limit}")]
    TooLarge {
        /// What is too large.
        what: &'static str,
        /// Its size.
        found: u64,
        /// The limit.
        limit: u64,
    },
}

/// What a topic of a record may be needed for.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum TopicOf {
    /// The scans ([`RecordOptions::points_topic`](crate::RecordOptions::points_topic)).
    Scans,
    /// Their poses ([`RecordOptions::odometry_topic`](crate::RecordOptions::odometry_topic)).
    Odometry,
}

impl fmt::Display for TopicOf {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Scans => "scans",
            Self::Odometry => "odometry for the scans",
        })
    }
}

/// A file that could not be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WriteError {
    /// The operating system refused.
    #[error("{}: cannot write: {error}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The reason.
        error: io::Error,
    },
    /// The writer of MCAP files refused.
    #[error("{}: cannot write MCAP: {error}", path.display())]
    Mcap {
        /// The file.
        path: PathBuf,
        /// The reason.
        error: mcap::McapError,
    },
    /// The file has reached the size that it may have.
    #[error("{}: full: it may have {bytes_max} bytes", path.display())]
    Full {
        /// The file.
        path: PathBuf,
        /// The limit.
        bytes_max: u64,
    },
    /// The format cannot hold what it was given.
    #[error("{}: {what} cannot be written: {why}", path.display())]
    Unfit {
        /// The file.
        path: PathBuf,
        /// What does not fit.
        what: String,
        /// Why, and what would fit.
        why: String,
    },
}

impl WriteError {
    pub(crate) fn io(path: &Path) -> impl FnOnce(io::Error) -> Self + '_ {
        move |error| Self::Io { path: path.to_owned(), error }
    }

    pub(crate) fn mcap(path: &Path) -> impl FnOnce(mcap::McapError) -> Self + '_ {
        // What the system says is said, and not that it said something.
        move |error| match error {
            mcap::McapError::Io(error) => Self::io(path)(error),
            error => Self::Mcap { path: path.to_owned(), error },
        }
    }

    pub(crate) fn unfit(path: &Path, what: impl Into<String>, why: impl Into<String>) -> Self {
        Self::Unfit { path: path.to_owned(), what: what.into(), why: why.into() }
    }
}

/// What is wrong with bytes that are not, or not yet known to be, of a file: a [`ReadError`] without its path.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
#[error("{place}{problem}")]
pub struct Fault {
    /// Where in the bytes.
    pub place: Place,
    /// What is wrong there.
    pub problem: Problem,
}

impl Fault {
    pub(crate) fn damaged(place: Place, expected: impl Into<String>, found: impl Into<String>) -> Self {
        Self { place, problem: Problem::Damaged { expected: expected.into(), found: found.into() } }
    }

    pub(crate) fn truncated(place: Place, expected: impl Into<String>, found: impl Into<String>) -> Self {
        Self { place, problem: Problem::Truncated { expected: expected.into(), found: found.into() } }
    }

    pub(crate) fn foreign(place: Place, expected: impl Into<String>, found: impl Into<String>) -> Self {
        Self { place, problem: Problem::Foreign { expected: expected.into(), found: found.into() } }
    }

    pub(crate) fn too_large(place: Place, what: &'static str, found: u64, limit: u64) -> Self {
        Self { place, problem: Problem::TooLarge { what, found, limit } }
    }

    pub(crate) fn io(error: &io::Error) -> Self {
        Self { place: Place::Whole, problem: Problem::Io { kind: error.kind(), message: error.to_string() } }
    }

    pub(crate) fn in_file(self, path: &Path) -> ReadError {
        ReadError { path: path.to_owned(), place: self.place, problem: self.problem }
    }

    /// The same fault with its byte as that of a message.
    pub(crate) fn in_message(self, topic: &str, number: u64) -> Self {
        let byte = match self.place {
            Place::Byte(byte) => Some(byte),
            _ => None,
        };
        Self { place: Place::Message { topic: topic.into(), number, byte }, problem: self.problem }
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Whole => Ok(()),
            Self::Byte(byte) => write!(f, "byte {byte}: "),
            Self::Line(line) => write!(f, "line {line}: "),
            Self::Message { topic, number, byte: None } => write!(f, "message {number} of {topic}: "),
            Self::Message { topic, number, byte: Some(byte) } => {
                write!(f, "message {number} of {topic}, byte {byte}: ")
            }
        }
    }
}

/// Whether there is room for one more of `what` beside those that are held.
pub(crate) fn check_room(what: &'static str, held: usize, most: usize) -> Result<(), Fault> {
    if held >= most {
        return Err(Fault::too_large(Place::Whole, what, held as u64 + 1, most as u64));
    }
    Ok(())
}

/// Text out of a file, made fit for an error message: one line, at most 60 characters.
pub(crate) fn excerpt(bytes: &[u8]) -> String {
    let text = String::from_utf8_lossy(bytes.get(..200).unwrap_or(bytes)).trim().to_owned();
    let mut short: String =
        text.chars().map(|c| if c.is_control() { '\u{b7}' } else { c }).take(60).collect();
    if short.len() < text.len() {
        short.push('…');
    }
    format!("\"{short}\"")
}
