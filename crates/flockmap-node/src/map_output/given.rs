//! What the driver, the sockets and the readers share.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

use flockmap::{MapView, Resolution, RobotId, Stamp};
use flockmap_feed::{Link, Message, NodeCounts, ReaderHello, RobotPose, SeenScan};
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
pub(crate) trait Connection: AsyncRead + AsyncWrite + Send + Unpin {}
impl<T: AsyncRead + AsyncWrite + Send + Unpin> Connection for T {}

/// What the driver gives out.
#[derive(Debug)]
pub(super) struct Given {
    pub(super) map: MapView,
    /// When the map came to this version.
    pub(super) stamp: Stamp,
    pub(super) poses: Numbered<Vec<RobotPose>>,
    pub(super) counts: Numbered<NodeCounts>,
    /// For readers that want them, while there are any.
    pub(super) links: Numbered<Vec<Link>>,
    pub(super) scan: Numbered<Option<SeenScan>>,
}

impl Given {
    /// Frames of what is new beside the map, for a reader that has been sent things with these numbers.
    pub(super) fn beside_the_map(&self, hello: &ReaderHello, sent: &mut [u64; 4]) -> Vec<u8> {
        let Self { poses, counts, links, scan, .. } = self;
        let numbers = [poses.number, counts.number, links.number, scan.number];
        let is_new: [bool; 4] = core::array::from_fn(|of| numbers[of] != sent[of]);
        *sent = numbers;
        let messages = [
            is_new[0].then(|| Message::Poses(poses.value.to_vec())),
            is_new[1].then(|| Message::Counters((*counts.value).clone())),
            (is_new[2] && hello.links).then(|| Message::Links(links.value.to_vec())),
            (*scan.value).clone().filter(|_| is_new[3] && hello.scans).map(Message::Scan),
        ];
        messages.into_iter().flatten().flat_map(|message| message.emit()).collect()
    }
}

/// Something that is sent again when its number is another.
#[derive(Clone, Debug, Default)]
pub(super) struct Numbered<T> {
    pub(super) number: u64,
    pub(super) value: Arc<T>,
}

impl<T> Numbered<T> {
    /// Something else is given out from now on.
    pub(super) fn replace(&mut self, value: T) {
        self.number += 1;
        self.value = Arc::new(value);
    }
}

/// What the readers' thread counts for the driver.
#[derive(Debug, Default)]
pub(super) struct Tally {
    /// Readers that have said hello; and of these, that want links, and scans.
    readers: AtomicUsize,
    links: AtomicUsize,
    scans: AtomicUsize,
    pub(super) refused: AtomicU64,
    pub(super) closed: AtomicU64,
    pub(super) bytes_out: AtomicU64,
}

/// A reader counts for as long as this is there.
pub(super) struct Counted {
    tally: Arc<Tally>,
    hello: ReaderHello,
}

impl Tally {
    pub(super) fn readers(&self) -> usize {
        self.readers.load(Ordering::Acquire)
    }

    pub(super) fn wants_links(&self) -> bool {
        self.links.load(Ordering::Acquire) > 0
    }

    pub(super) fn wants_scans(&self) -> bool {
        self.scans.load(Ordering::Acquire) > 0
    }

    pub(super) fn count(self: &Arc<Self>, hello: &ReaderHello) -> Counted {
        for count in self.of(hello) {
            count.fetch_add(1, Ordering::AcqRel);
        }
        Counted { tally: Arc::clone(self), hello: *hello }
    }

    /// Where a reader counts.
    fn of(&self, hello: &ReaderHello) -> impl Iterator<Item = &AtomicUsize> {
        let counts = [(true, &self.readers), (hello.links, &self.links), (hello.scans, &self.scans)];
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

pub(super) fn add(counter: &AtomicU64, count: u64) {
    counter.fetch_add(count, Ordering::Relaxed);
}

pub(super) fn read(counter: &AtomicU64) -> u64 {
    counter.load(Ordering::Relaxed)
}
