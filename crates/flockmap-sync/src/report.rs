//! What a session reports to its driver when asked.

use crate::Counters;
use crate::counters::Traffic;
use crate::event::Event;
use core::time::Duration;
use flockmap_grid::{Stamp, Stream};
use std::collections::VecDeque;

/// What waits to be reported, and what was counted.
#[derive(Debug, Default)]
pub(crate) struct Report {
    pub(crate) events: VecDeque<Event>,
    pub(crate) counters: Counters,
}

/// What [`Session::peers`](crate::Session::peers) reports of a peer.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[non_exhaustive]
pub struct PeerInfo {
    /// The peer and its run.
    pub stream: Stream,
    /// When it was last heard, on the own clock.
    pub last_heard: Stamp,
    /// Whether it hears this robot, as far as its last request says.
    pub hears_us: bool,
    /// Smoothed round trip, once measured.
    pub round_trip: Option<Duration>,
    /// Its clock minus the own clock in microseconds: as given, else as measured.
    pub clock_offset_micros: Option<i64>,
    /// Packages sent to it and not yet confirmed.
    pub in_flight: usize,
    /// Share of the packages sent to it that were found lost, smoothed over some 64, in parts of 65,536.
    pub loss: u32,
    /// Heard from it.
    pub traffic_in: Traffic,
    /// Sent to it alone.
    pub traffic_out: Traffic,
}

/// What a budget leaves for own packages.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Pace {
    /// There is no budget, or nobody who listens: whatever is published waits for nothing.
    Free,
    /// Published packages have all been sent.
    AllSent {
        /// So much of own packages reaches everybody who listens, if nothing else is sent.
        bytes_per_s: u32,
    },
    /// Published packages wait for the budget, for the first time or again. What is published now waits
    /// behind them, or builds on them.
    Waiting {
        /// As above.
        bytes_per_s: u32,
    },
}

/// Sizes of what a [`Session`](crate::Session) keeps because of others.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
#[non_exhaustive]
pub struct Load {
    /// Peers known: at most `peers_max`.
    pub peers: usize,
    /// Streams known beside the own one: at most `streams_max`.
    pub streams: usize,
    /// Packages and chunks that wait for what they build on, or for the driver's verdict: at most 4,096.
    pub pending: usize,
    /// Of these: packages that wait for those that they build on: at most 1,024.
    pub waiting: usize,
    /// Bytes that these take, with 400 bytes of bookkeeping for each: at most 1 MiB.
    pub waiting_bytes: usize,
    /// Packages and chunks that were rejected a moment ago: at most 1,024.
    pub backed_off: usize,
    /// Snapshots being received: at most `transfers_max`.
    pub transfers: usize,
    /// Packages sent to one peer and not yet confirmed, of the peer with the most: at most `in_flight_max`,
    /// by broadcast twice as many.
    pub in_flight_most: usize,
}
