//! The map of a running robot as a stream of bytes, and the mirror that a reader keeps of it.
//!
//! A node gives its fused map out over a socket, and any planner in another process reads it. Here are both
//! ends, sans-IO: [`Feed`] says what one reader gets next, [`Mirror`] makes a [`MapView`](flockmap_grid::MapView)
//! of the bytes. [`Client`] is a mirror over TCP or a Unix socket with the standard library alone. The bytes
//! are described in `docs/map-output.md`, for mirrors in other languages.
//!
//! The stream is one of states, not of steps: each block goes out as it is at the moment, in the order in which
//! blocks changed last. So no queue builds up for a slow reader, and what a reader has is said by one number.
#![forbid(unsafe_code)]

mod bytes;
mod client;
mod error;
mod feed;
mod message;
mod mirror;
mod origins;
mod splitter;

pub use client::{Address, AddressError, Client, ClientError};
pub use error::FeedError;
pub use feed::{Feed, Next};
pub use message::{
    Block, Blocks, FEED_VERSION, FRAME_BYTES_MAX, HELLO_BYTES_MAX, Have, Link, Message, NodeCounts,
    NodeHello, Playback, ReaderHello, RobotPose, RunSubmaps, SeenScan,
};
pub use mirror::{Event, Mirror, MirrorOptions};
pub use splitter::Splitter;
