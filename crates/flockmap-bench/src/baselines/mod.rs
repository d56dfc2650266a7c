//! Methods of sending others what a robot maps, ours and other people's, all behind the same two traits: a
//! [`Sender`] that makes messages and a [`Receiver`] that makes a map of them, from nothing but the bytes.
//!
//! Every rival is shown at its best, and every lossy or stale behaviour that it has is kept:
//! [`Method::about`] says in a sentence what is sent, what is kept, and where it comes from.

mod address_delta;
mod bytes;
mod colag;
mod gvp;
mod method;
mod morton;
mod octomap_diff;
mod package;
pub mod racer_code;
mod relay_points;
mod scan_relay;
mod state_map;
#[cfg(test)]
mod tests;
mod traits;

pub use method::Method;
pub use traits::{Messages, Observation, Receiver, Sender};
