//! Time goes on: a robot does not want to be called, or to send, without end at one moment.

use super::Finding;

const NAME: &str = "still";

/// Calls at one moment of time. A full budget of 2 MB/s leaves in some thousand datagrams.
const CALLS_MAX: u32 = 20_000;

/// Counts calls of one robot at one moment.
#[derive(Default)]
pub(in crate::swarm) struct Still {
    at: i64,
    calls: u32,
}

impl Still {
    pub(in crate::swarm) fn called(&mut self, now: i64) -> Option<Finding> {
        if now != self.at {
            (self.at, self.calls) = (now, 0);
        }
        self.calls += 1;
        (self.calls > CALLS_MAX).then(|| {
            Finding::new(NAME, format!("at most {CALLS_MAX} calls and datagrams at one moment"), "one more")
        })
    }
}
