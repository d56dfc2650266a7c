//! Which run of which robot this is, and what of its name is used up.

use crate::replay::Replays;
use flockmap_grid::{RobotId, Stamp, Stream};
use std::collections::BTreeMap;

/// Which run of which robot this is, and what of its name is used up.
#[derive(Debug)]
pub(crate) struct Identity {
    pub(crate) own: Stream,
    pub(crate) anew: Anew,
    pub(crate) same_identity_sent: Option<Stamp>,
    pub(crate) sealed: SealedCounters,
    pub(crate) exhausted_sent: bool,
    pub(crate) replays: Replays,
}

impl Identity {
    pub(crate) fn new(own: Stream) -> Self {
        Self {
            own,
            anew: Anew::default(),
            same_identity_sent: None,
            sealed: SealedCounters::default(),
            exhausted_sent: false,
            replays: Replays::default(),
        }
    }
}

/// Whether and when this robot has begun anew.
#[derive(Debug, Default)]
pub(crate) struct Anew {
    pub(crate) times: u32,
    pub(crate) not_before: Option<Stamp>,
}

/// The counters of the datagrams that this run has sealed. At most one for each robot that was ever a peer.
#[derive(Debug, Default)]
pub(crate) struct SealedCounters {
    pub(crate) for_all: u64,
    for_one: BTreeMap<RobotId, u64>,
    /// One of them has reached its end.
    pub(crate) is_exhausted: bool,
}

impl SealedCounters {
    /// The number of the last datagram that was sealed for this recipient.
    pub(crate) fn last_mut(&mut self, recipient: Option<RobotId>) -> &mut u64 {
        match recipient {
            None => &mut self.for_all,
            Some(robot) => self.for_one.entry(robot).or_default(),
        }
    }
}
