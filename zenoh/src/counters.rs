//! What was counted beyond the radio, by name: served with the counters of the node.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// A counter that only goes up.
#[derive(Clone, Debug, Default)]
pub(crate) struct Counter(Arc<AtomicU64>);

impl Counter {
    pub(crate) fn add(&self, count: u64) {
        self.0.fetch_add(count, Ordering::Relaxed);
    }
}

/// The counters of a swarm in this process.
#[derive(Clone, Debug, Default)]
pub(crate) struct Counters {
    /// Put: packages and chunks, and their bytes.
    pub(crate) put: Counter,
    pub(crate) put_bytes: Counter,
    /// Not put, since too many waited, or Zenoh refused. Who asks gets them.
    pub(crate) put_failed: Counter,
    /// Came as they were put: packages and chunks, and their bytes.
    pub(crate) taken: Counter,
    pub(crate) taken_bytes: Counter,
    /// The same as answers to what was asked.
    pub(crate) fetched: Counter,
    pub(crate) fetched_bytes: Counter,
    /// Refused: under a key that says something else, or no package at all; longer than a package; a delete.
    pub(crate) refused: Counter,
    /// Dropped, since too many waited, or the robot has no room. They are asked for again.
    pub(crate) dropped: Counter,
    /// Queries that were answered, with bytes of the answers; and those that were refused.
    pub(crate) answered: Counter,
    pub(crate) answered_bytes: Counter,
    pub(crate) queries_refused: Counter,
    /// Runs that could not be told when all were asked for.
    pub(crate) untold: Counter,
    /// Snapshots that were coded for answers.
    pub(crate) snapshots: Counter,
}

impl Counters {
    /// All of them, by name, as a node takes them.
    pub(crate) fn for_node(&self) -> Vec<(&'static str, Arc<AtomicU64>)> {
        let all = [
            ("zenoh_put", &self.put),
            ("zenoh_put_bytes", &self.put_bytes),
            ("zenoh_put_failed", &self.put_failed),
            ("zenoh_taken", &self.taken),
            ("zenoh_taken_bytes", &self.taken_bytes),
            ("zenoh_fetched", &self.fetched),
            ("zenoh_fetched_bytes", &self.fetched_bytes),
            ("zenoh_refused", &self.refused),
            ("zenoh_dropped", &self.dropped),
            ("zenoh_answered", &self.answered),
            ("zenoh_answered_bytes", &self.answered_bytes),
            ("zenoh_queries_refused", &self.queries_refused),
            ("zenoh_untold", &self.untold),
            ("zenoh_snapshots", &self.snapshots),
        ];
        all.map(|(name, counter)| (name, Arc::clone(&counter.0))).to_vec()
    }
}
