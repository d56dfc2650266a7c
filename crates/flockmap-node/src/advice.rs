//! What to do when the system refuses something.

use std::fmt::Display;
use std::io::{self, ErrorKind};

/// The error of a socket that cannot listen, with what to do; `option` is where its address was given.
pub(crate) fn listen_error(option: &str, error: io::Error) -> io::Error {
    let advice = match error.kind() {
        ErrorKind::AddrInUse => {
            format!("another program listens there: stop that one, or choose another port in {option}")
        }
        ErrorKind::AddrNotAvailable => {
            format!("no interface of this machine has that address: give one that has in {option}")
        }
        ErrorKind::PermissionDenied => {
            format!("this user may not: choose a port of 1024 or more in {option}")
        }
        _ => return error,
    };
    with(error, advice)
}

/// The error of a file that cannot be read, with what to do.
pub(crate) fn read_error(error: io::Error) -> io::Error {
    match error.kind() {
        ErrorKind::NotFound => with(error, "expected the path of a file that is there"),
        ErrorKind::IsADirectory => with(error, "expected a file"),
        ErrorKind::PermissionDenied => with(
            error,
            "this user may not read it: change its permissions, or start as the user it belongs to",
        ),
        ErrorKind::InvalidData => with(error, "expected text in UTF-8"),
        _ => error,
    }
}

/// The same error with a sentence more.
pub(crate) fn with(error: io::Error, advice: impl Display) -> io::Error {
    io::Error::new(error.kind(), format!("{error}: {advice}"))
}
