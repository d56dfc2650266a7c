//! How long calls take.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Serialize;

use crate::processor::processor_time;

/// What is called.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Call {
    InsertScan,
    HandleDatagram,
    HandleTimeout,
    PollTransmit,
    Flush,
    Restore,
    SetAlignment,
    SetClockOffset,
    SetMuted,
    Status,
}

impl Call {
    /// As it is called in the code.
    pub const fn name(self) -> &'static str {
        match self {
            Self::InsertScan => "insert_scan",
            Self::HandleDatagram => "handle_datagram",
            Self::HandleTimeout => "handle_timeout",
            Self::PollTransmit => "poll_transmit",
            Self::Flush => "flush",
            Self::Restore => "restore",
            Self::SetAlignment => "set_alignment",
            Self::SetClockOffset => "set_clock_offset",
            Self::SetMuted => "set_muted",
            Self::Status => "status",
        }
    }
}

/// Of one kind of call during one piece of work.
#[derive(Clone, Copy, Default, Debug)]
pub struct Taken {
    pub calls: u64,
    pub longest: Duration,
    pub sum: Duration,
}

/// The calls of one robot during one piece of work.
#[derive(Clone, Default, Debug)]
pub struct Meter(pub BTreeMap<Call, Taken>);

impl Meter {
    /// Does a call and notes how long it took.
    pub fn time<T>(&mut self, call: Call, work: impl FnOnce() -> T) -> T {
        self.timed(call, work).0
    }

    /// The same, and how long it took.
    pub fn timed<T>(&mut self, call: Call, work: impl FnOnce() -> T) -> (T, Duration) {
        let began = processor_time();
        let result = work();
        let took = processor_time().saturating_sub(began);
        let taken = self.0.entry(call).or_default();
        taken.calls += 1;
        taken.longest = taken.longest.max(took);
        taken.sum += took;
        (result, took)
    }

    /// All calls together.
    pub fn sum(&self) -> Duration {
        self.0.values().map(|taken| taken.sum).sum()
    }
}
