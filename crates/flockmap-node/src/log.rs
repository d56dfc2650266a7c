//! The log of a node, line by line.

use std::fmt;
use std::io::{IsTerminal, Write as _};
use std::sync::{Arc, Mutex, PoisonError};

/// How much a line matters.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub enum Level {
    /// The counters of the moment; each such line replaces the one before.
    Status,
    /// Good to know.
    Info,
    /// Something is wrong that the node can live with.
    Warning,
    /// Something does not work.
    Error,
}

/// Where the lines go.
#[derive(Clone)]
pub struct Log(Arc<Write>);

type Write = dyn Fn(Level, &str) + Send + Sync;

impl Log {
    /// Lines are given to a function. It is called from the threads of the node and should return soon.
    pub fn new(write: impl Fn(Level, &str) + Send + Sync + 'static) -> Self {
        Self(Arc::new(write))
    }

    /// Lines are dropped.
    pub fn silent() -> Self {
        Self::new(|_, _| {})
    }

    /// Lines go to stderr, behind the name of the robot. On a terminal the status is one line that is written
    /// anew.
    pub fn to_stderr(name: &str) -> Self {
        let is_terminal = std::io::stderr().is_terminal();
        let name = name.to_owned();
        let status_shown = Mutex::new(false);
        Self::new(move |level, text| {
            let mut shown = status_shown.lock().unwrap_or_else(PoisonError::into_inner);
            let clear = if *shown { "\r\x1b[K" } else { "" };
            *shown = level == Level::Status && is_terminal;
            let prefix = match level {
                Level::Status | Level::Info => "",
                Level::Warning => "warning: ",
                Level::Error => "error: ",
            };
            let end = if *shown { "" } else { "\n" };
            let mut out = std::io::stderr().lock();
            // There is nowhere else to complain.
            let _ = write!(out, "{clear}{name}: {prefix}{text}{end}").and_then(|()| out.flush());
        })
    }

    /// Says a line.
    pub fn say(&self, level: Level, text: impl AsRef<str>) {
        (self.0)(level, text.as_ref());
    }

    /// Says a line that is worth to know.
    pub fn info(&self, text: impl AsRef<str>) {
        self.say(Level::Info, text);
    }

    /// Says a line that should be looked at.
    pub fn warn(&self, text: impl AsRef<str>) {
        self.say(Level::Warning, text);
    }

    pub(crate) fn error(&self, text: impl AsRef<str>) {
        self.say(Level::Error, text);
    }
}

impl fmt::Debug for Log {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Log")
    }
}
