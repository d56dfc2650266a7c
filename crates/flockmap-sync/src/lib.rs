//! Keeps the map packages of a swarm in sync: the request–response mechanism of the paper (Sec. IV-B), made
//! whole.
//!
//! A [`Session`] is a state machine without sockets, threads or clocks: datagrams and time go in, datagrams and
//! [`Event`]s come out. It moves packages and never decodes them. What it holds is in its [`Store`]; what it says
//! on the wire is in [`wire`] and, byte by byte, in `WIRE.md`; how it behaves is set by a [`SessionConfig`].
#![forbid(unsafe_code)]

mod broadcasts;
mod clocks;
mod coded;
mod config;
mod counters;
mod crowd;
mod event;
mod identity;
mod inbox;
mod interval_set;
mod item;
mod key;
mod lacks;
mod link;
mod memory;
mod outbox;
mod pacer;
mod path;
mod peer;
mod rate;
mod replay;
mod report;
mod schedule;
mod session;
mod stamp_index;
mod store;
mod timers;
pub mod wire;

pub use config::{BYTES_PER_S_MIN, Cast, ConfigError, InFlight, Order, Relay, SessionConfig};
pub use counters::{Counters, Traffic};
pub use event::{Destination, Event, PublishError, Transmit};
pub use inbox::Verdict;
pub use interval_set::{IntervalSet, TooFragmented};
pub use key::{KeyError, SwarmKey};
pub use path::Path;
pub use report::{Load, Pace, PeerInfo};
pub use session::{Cuts, Session};
pub use store::{RECEIVED_INTERVALS_MAX, Store, StoreLimits, Stored};
