//! Counts of readers.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

use flockmap_feed::ReaderHello;

/// Readers that there are, and what became of others.
#[derive(Debug, Default)]
pub struct Tally {
    /// Readers that have said hello; and of these, that want links, scans, and submaps.
    readers: AtomicUsize,
    links: AtomicUsize,
    scans: AtomicUsize,
    submaps: AtomicUsize,
    refused: AtomicU64,
    closed: AtomicU64,
    bytes_out: AtomicU64,
}

/// A reader counts for as long as this is there.
pub(crate) struct Counted {
    tally: Arc<Tally>,
    hello: ReaderHello,
}

impl Tally {
    /// Readers that have said hello.
    pub fn readers(&self) -> usize {
        self.readers.load(Ordering::Acquire)
    }

    /// Whether any of them wants links.
    pub fn wants_links(&self) -> bool {
        self.links.load(Ordering::Acquire) > 0
    }

    /// Whether any of them wants scans.
    pub fn wants_scans(&self) -> bool {
        self.scans.load(Ordering::Acquire) > 0
    }

    /// Whether any of them wants submaps.
    pub fn wants_submaps(&self) -> bool {
        self.submaps.load(Ordering::Acquire) > 0
    }

    /// A connection was not served.
    pub fn note_refused(&self) {
        self.refused.fetch_add(1, Ordering::Relaxed);
    }

    /// A reader was closed for what it did.
    pub fn note_closed(&self) {
        self.closed.fetch_add(1, Ordering::Relaxed);
    }

    pub(crate) fn note_bytes(&self, count: usize) {
        self.bytes_out.fetch_add(count as u64, Ordering::Relaxed);
    }

    /// Connections that were not served, readers that were closed, bytes that went out.
    pub fn totals(&self) -> [u64; 3] {
        [&self.refused, &self.closed, &self.bytes_out].map(|count| count.load(Ordering::Relaxed))
    }

    pub(crate) fn count(self: &Arc<Self>, hello: &ReaderHello) -> Counted {
        for count in self.of(hello) {
            count.fetch_add(1, Ordering::AcqRel);
        }
        Counted { tally: Arc::clone(self), hello: *hello }
    }

    /// Where a reader counts.
    fn of(&self, hello: &ReaderHello) -> impl Iterator<Item = &AtomicUsize> {
        let counts = [
            (true, &self.readers),
            (hello.links, &self.links),
            (hello.scans, &self.scans),
            (hello.submaps, &self.submaps),
        ];
        counts.into_iter().filter(|(is_wanted, _)| *is_wanted).map(|(_, count)| count)
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        for count in self.tally.of(&self.hello) {
            count.fetch_sub(1, Ordering::AcqRel);
        }
    }
}
