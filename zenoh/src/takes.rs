//! From Zenoh to the node: what is put, and what was asked for, is checked and given to the robot.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender, SyncSender, channel, sync_channel};
use std::time::Duration;

use flockmap::codec::PACKAGE_BYTES_MAX;
use flockmap::sync::RECEIVED_INTERVALS_MAX;
use flockmap::{Package, RestoreError, Robot, Stamp};
use flockmap_node::NodeHandle;
use flockmap_node::store::Contents;
use zenoh::sample::{Sample, SampleKind};

use crate::counters::Counters;
use crate::held::parse_intervals;
use crate::keys::{Item, Keys};
use crate::puts::{Noted, item_of};

/// Bytes that may wait for the robot of what is put by anybody, and of what was asked for.
const PUT_BYTES_MAX: usize = 8 << 20;
const FETCHED_BYTES_MAX: usize = 64 << 20;
/// What is counted for each beside its bytes.
const OVERHEAD_BYTES: usize = 200;
/// Packages given to the robot in one call.
const AT_ONCE: usize = 64;
/// While the robot still merges what it got.
const PAUSE: Duration = Duration::from_millis(1);
/// Longest text of what a snapshot contains.
const CONTENTS_BYTES_MAX: usize = 22 * RECEIVED_INTERVALS_MAX;

/// Something for the robot.
enum Take {
    Package(Package),
    Contents(Contents),
}

/// Told when all that came before it has been given to the robot, and merged.
struct Fence(SyncSender<()>);

/// What waits, in the order in which it came.
enum Waiting {
    /// For the robot, with what it counts in bytes.
    Take(Take, usize),
    Fence(Fence),
}

/// How something came.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum By {
    /// It was put.
    Put,
    /// It was asked for.
    Answer,
}

/// Where what comes waits for the robot.
pub(crate) struct Intake {
    keys: Keys,
    waiting: Sender<Waiting>,
    waiting_bytes: Arc<AtomicUsize>,
    counters: Counters,
}

impl Intake {
    /// And its other end.
    pub(crate) fn new(keys: Keys, noted: Noted, counters: Counters) -> (Self, Outlet) {
        let (waiting, waiting_in) = channel();
        let waiting_bytes = Arc::<AtomicUsize>::default();
        let outlet = Outlet {
            waiting: waiting_in,
            waiting_bytes: Arc::clone(&waiting_bytes),
            noted,
            counters: counters.clone(),
        };
        (Self { keys, waiting, waiting_bytes, counters }, outlet)
    }

    /// Checks what came; it waits for the robot then. Called in threads of Zenoh: never waits. Whatever the key and the
    /// value are, they are only looked at if they can be of this swarm; a value is copied only if it is short enough.
    pub(crate) fn take(&self, sample: &Sample, by: By) {
        let Self { counters, .. } = self;
        let Some(take) = self.read(sample) else { return counters.refused.add(1) };
        let length = sample.payload().len();
        let bytes = length + OVERHEAD_BYTES;
        let (count, count_bytes, bytes_max) = match by {
            By::Put => (&counters.taken, &counters.taken_bytes, PUT_BYTES_MAX),
            By::Answer => (&counters.fetched, &counters.fetched_bytes, FETCHED_BYTES_MAX),
        };
        count.add(1);
        count_bytes.add(length as u64);
        if self.waiting_bytes.fetch_add(bytes, Ordering::Relaxed) + bytes > bytes_max
            || self.waiting.send(Waiting::Take(take, bytes)).is_err()
        {
            self.waiting_bytes.fetch_sub(bytes, Ordering::Relaxed);
            counters.dropped.add(1);
        }
    }

    /// What a sample says; `None` if nothing, or not what its key says.
    fn read(&self, sample: &Sample) -> Option<Take> {
        if sample.kind() != SampleKind::Put {
            return None;
        }
        let (swarm, item) = Item::parse(sample.key_expr().as_str())?;
        let payload = sample.payload();
        if swarm != self.keys.swarm {
            return None;
        }
        match item {
            Item::Package { .. } | Item::Chunk { .. } => {
                let bytes = (payload.len() <= PACKAGE_BYTES_MAX).then(|| payload.to_bytes())?;
                let package = Package::parse(&bytes).ok().filter(|package| Item::of(package) == item)?;
                Some(Take::Package(package))
            }
            Item::Contents { stream, snapshot_id } => {
                let bytes = (payload.len() <= CONTENTS_BYTES_MAX).then(|| payload.to_bytes())?;
                let held = parse_intervals(core::str::from_utf8(&bytes).ok()?)?;
                let intervals = held.intervals().to_vec();
                Some(Take::Contents(Contents { stream, snapshot_id, intervals }))
            }
        }
    }

    /// Told when the robot has merged what came before; an error once the node has ended.
    pub(crate) fn merged(&self) -> Receiver<()> {
        let (done, is_done) = sync_channel(1);
        // Without an outlet the fence is dropped, which says so.
        let _ = self.waiting.send(Waiting::Fence(Fence(done)));
        is_done
    }

    /// Whether so much waits that no more should be asked for.
    pub(crate) fn is_full(&self) -> bool {
        self.waiting_bytes.load(Ordering::Relaxed) > FETCHED_BYTES_MAX / 2
    }
}

/// Gives what waits to the robot.
pub(crate) struct Outlet {
    waiting: Receiver<Waiting>,
    waiting_bytes: Arc<AtomicUsize>,
    noted: Noted,
    counters: Counters,
}

impl Outlet {
    /// Until the node has ended, or nothing can come any more.
    pub(crate) fn give_all(self, node: &NodeHandle) {
        while let Ok(first) = self.waiting.recv() {
            let more = self.waiting.try_iter().take(AT_ONCE - 1);
            let waiting: Vec<Waiting> = std::iter::once(first).chain(more).collect();
            if !self.give(node, waiting) {
                return;
            }
        }
    }

    /// Whether the node is still there.
    fn give(&self, node: &NodeHandle, waiting: Vec<Waiting>) -> bool {
        let (mut takes, mut fences, mut bytes) = (Vec::new(), Vec::new(), 0);
        for one in waiting {
            match one {
                Waiting::Take(take, counted) => {
                    self.noted.note(take.item());
                    takes.push(take);
                    bytes += counted;
                }
                // Whoever waits may as well wait for what came behind.
                Waiting::Fence(fence) => fences.push(fence),
            }
        }
        let given = node.with_robot(move |robot, now| {
            let refused = takes.into_iter().filter_map(|take| take.give(robot, now).err());
            refused.count() as u64
        });
        self.waiting_bytes.fetch_sub(bytes, Ordering::Relaxed);
        let Some(refused) = given else { return false };
        self.counters.dropped.add(refused);
        // A call merges as much as it has time for; what waits beyond a limit would be dropped.
        loop {
            match node.with_robot(|robot, _| robot.session().has_events()) {
                Some(true) => std::thread::sleep(PAUSE),
                Some(false) => break,
                None => return false,
            }
        }
        for Fence(done) in fences {
            // Who waits may be gone.
            let _ = done.send(());
        }
        true
    }
}

impl Take {
    fn item(&self) -> Item {
        match self {
            Self::Package(package) => Item::of(package),
            Self::Contents(contents) => item_of(contents),
        }
    }

    fn give(self, robot: &mut Robot, now: Stamp) -> Result<(), RestoreError> {
        match self {
            Self::Package(package) => robot.receive_package(now, package),
            Self::Contents(Contents { stream, snapshot_id, intervals }) => {
                // What it says counts when the chunks are merged.
                robot.restore_contents(now, stream, snapshot_id, &intervals);
                Ok(())
            }
        }
    }
}
