//! What is done is said on stderr, a line a step.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

/// Steps of one kind, done in any order by any thread.
pub struct Steps {
    what: &'static str,
    total: usize,
    done: AtomicUsize,
    start: Instant,
}

impl Steps {
    pub fn new(what: &'static str, total: usize) -> Self {
        Self { what, total, done: AtomicUsize::new(0), start: Instant::now() }
    }

    /// One more is done.
    pub fn done(&self, step: &str) {
        let done = self.done.fetch_add(1, Ordering::Relaxed) + 1;
        let seconds = self.start.elapsed().as_secs();
        eprintln!("{}: {done} of {} after {seconds} s ({step})", self.what, self.total);
    }
}
