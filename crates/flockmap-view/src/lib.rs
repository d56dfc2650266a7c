//! Maps live in a browser: a page, the server that serves it, and recordings that it plays.
//!
//! [`ViewServer`] serves the page, the feeds of one or more [`Source`]s over WebSockets, and counters, as
//! `docs/view.md` says. It knows neither robots nor nodes: a source takes one end of a pipe and speaks the feed of
//! `docs/map-output.md` over it. [`Recording`] is a source of its own: the history of a map, which each browser
//! plays by itself, forwards and back.
#![forbid(unsafe_code)]

mod access;
mod page;
mod player;
mod recording;

mod routes;
mod series;
pub mod serve;
mod server;
mod socket;
mod source;

pub use access::{Access, Token, TokenError};

pub use recording::{Recording, Step};
pub use series::{SERIES_STEPS_MAX, Series};
pub use server::{StartError, ViewServer};
pub use source::{Content, Control, Kind, Metrics, Source};
