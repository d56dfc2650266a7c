//! What the driver, the sockets and the readers share.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

use flockmap::{MapView, Resolution, RobotId, Stamp};
use flockmap_feed::{NodeCounts, RobotPose};
use tokio::io::{AsyncRead, AsyncWrite};

/// What the hello says.
#[derive(Clone, Debug)]
pub(super) struct Identity {
    pub(super) robot: RobotId,
    pub(super) resolution: Resolution,
    pub(super) feed: u64,
    pub(super) name: String,
    pub(super) frame: String,
}

/// A connection of either kind.
pub(super) trait Connection: AsyncRead + AsyncWrite + Send + Unpin {}
impl<T: AsyncRead + AsyncWrite + Send + Unpin> Connection for T {}

/// What the driver gives out.
#[derive(Debug)]
pub(super) struct Given {
    pub(super) map: MapView,
    /// When the map came to this version.
    pub(super) stamp: Stamp,
    pub(super) poses: Numbered<Vec<RobotPose>>,
    pub(super) counts: Numbered<NodeCounts>,
}

/// Something that is sent again when its number is another.
#[derive(Clone, Debug, Default)]
pub(super) struct Numbered<T> {
    pub(super) number: u64,
    pub(super) value: Arc<T>,
}

impl<T> Numbered<T> {
    pub(super) fn replace(&mut self, value: T) {
        self.number += 1;
        self.value = Arc::new(value);
    }
}

/// What the readers' thread counts for the driver.
#[derive(Debug, Default)]
pub(super) struct Tally {
    /// Readers that have said hello.
    readers: AtomicUsize,
    pub(super) refused: AtomicU64,
    pub(super) closed: AtomicU64,
    pub(super) bytes_out: AtomicU64,
}

/// A reader counts for as long as this is there.
pub(super) struct Counted(Arc<Tally>);

impl Tally {
    pub(super) fn readers(&self) -> usize {
        self.readers.load(Ordering::Acquire)
    }

    pub(super) fn count(self: &Arc<Self>) -> Counted {
        self.readers.fetch_add(1, Ordering::AcqRel);
        Counted(Arc::clone(self))
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        self.0.readers.fetch_sub(1, Ordering::AcqRel);
    }
}

pub(super) fn add(counter: &AtomicU64, count: u64) {
    counter.fetch_add(count, Ordering::Relaxed);
}

pub(super) fn read(counter: &AtomicU64) -> u64 {
    counter.load(Ordering::Relaxed)
}
