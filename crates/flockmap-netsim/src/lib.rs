//! An emulated radio, a [`Network`] of robots in virtual time, and whole swarms watched by checkers ([`swarm`]).
//!
//! Everything is deterministic: the same seed gives the same bytes on every machine.
#![forbid(unsafe_code)]

mod network;
mod radio;
pub mod swarm;

pub use network::{Addressees, Datagram, Network, Node, Watch};
pub use radio::{Burst, Delivery, IP_UDP_BYTES, Link, RadioConfig, RadioEmulator, To, Traffic};
