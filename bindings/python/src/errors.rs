//! The exceptions. Each has the text of the Rust error that it stands for.

use pyo3::PyErr;
use pyo3::create_exception;
use pyo3::exceptions::PyValueError;

create_exception!(
    flockmap,
    Error,
    PyValueError,
    "Whatever Flockmap refuses. The text says what was wrong and what to do."
);
create_exception!(
    flockmap,
    ConfigError,
    Error,
    "Options that cannot work, or a configuration that cannot be read."
);
create_exception!(flockmap, PoseError, Error, "A pose or a position that is none, or lies beyond the grid.");
create_exception!(
    flockmap,
    DatagramError,
    Error,
    "A datagram that was refused. It is counted already and needs no action."
);
create_exception!(flockmap, FileError, Error, "A file that cannot be read or written, or is damaged.");
create_exception!(flockmap, ClosedError, Error, "A robot, node or record that was used after its end.");

/// An [`Error`] with the text of a Rust error.
pub(crate) fn refused(error: impl std::fmt::Display) -> PyErr {
    Error::new_err(error.to_string())
}

/// A [`ConfigError`] with the text of a Rust error, and of all that it comes from.
pub(crate) fn config(error: impl std::fmt::Display) -> PyErr {
    ConfigError::new_err(format!("{error:#}"))
}

/// A [`PoseError`].
pub(crate) fn pose(error: impl std::fmt::Display) -> PyErr {
    PoseError::new_err(error.to_string())
}

/// A [`FileError`].
pub(crate) fn file(error: impl std::fmt::Display) -> PyErr {
    FileError::new_err(error.to_string())
}
