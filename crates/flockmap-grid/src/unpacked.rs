//! What was unpacked last, for who reads it again.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Something that is kept packed.
pub(crate) trait Packed {
    /// What it is when it is read or changed.
    type Open: Clone + core::fmt::Debug;

    fn unpack(&self) -> Self::Open;

    /// The most bytes of the heap that it takes unpacked.
    fn open_bytes(&self) -> usize;
}

/// Most that are kept: what lies around a robot that changes little of it is read with every batch.
const KEPT_MAX: usize = 256;
/// Most bytes that parts of layers take which are kept unpacked for who reads them: in a robot, and in each snapshot
/// that is being received; and as many parts of the fused map. (A cube of a layer takes 0.6 MB at most, a region of the
/// map 70 kB.)
pub const UNPACKED_BYTES_MAX: usize = 2 << 20;

/// Parts of any number of layers or maps, those that were read last at the end. What is packed does not change, so that
/// it is known by where it lies.
#[derive(Debug)]
pub(crate) struct Unpacked<P: Packed> {
    kept: Mutex<Kept<P>>,
    count: AtomicUsize,
}

type Kept<P> = Vec<(Arc<P>, Arc<<P as Packed>::Open>)>;

impl<P: Packed> Default for Unpacked<P> {
    fn default() -> Self {
        Self { kept: Mutex::default(), count: AtomicUsize::new(0) }
    }
}

impl<P: Packed> Unpacked<P> {
    /// To be read. O(blocks of it) if it was not read lately.
    pub(crate) fn read(&self, packed: &Arc<P>) -> Arc<P::Open> {
        if let Some(open) = self.find(packed) {
            return open;
        }
        // Other threads read meanwhile what is there.
        self.count.fetch_add(1, Ordering::Relaxed);
        let open = Arc::new(packed.unpack());
        let mut kept = self.kept();
        let mut bytes = packed.open_bytes();
        let fits = kept.iter().rev().take(KEPT_MAX - 1).take_while(|(of, _)| {
            bytes += of.open_bytes();
            bytes <= UNPACKED_BYTES_MAX
        });
        let gone = kept.len() - fits.count();
        kept.drain(..gone);
        if position(&kept, packed).is_none() {
            kept.push((Arc::clone(packed), Arc::clone(&open)));
        }
        open
    }

    /// To be read, if it was read lately.
    pub(crate) fn find(&self, packed: &Arc<P>) -> Option<Arc<P::Open>> {
        let mut kept = self.kept();
        let at = position(&kept, packed)?;
        kept[at..].rotate_left(1);
        kept.last().map(|(_, open)| Arc::clone(open))
    }

    /// To be changed; it is not read as it was any more.
    pub(crate) fn take(&self, packed: &Arc<P>) -> P::Open {
        let found = {
            let mut kept = self.kept();
            position(&kept, packed).map(|at| kept.remove(at).1)
        };
        found.map_or_else(|| packed.unpack(), Arc::unwrap_or_clone)
    }

    /// It is not read any more.
    pub(crate) fn forget(&self, packed: &Arc<P>) {
        let mut kept = self.kept();
        if let Some(at) = position(&kept, packed) {
            kept.remove(at);
        }
    }

    /// How often something was unpacked to be read: what that cost.
    pub(crate) fn count(&self) -> usize {
        self.count.load(Ordering::Relaxed)
    }

    /// Never held while something is unpacked.
    fn kept(&self) -> MutexGuard<'_, Kept<P>> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn position<P: Packed>(kept: &Kept<P>, packed: &Arc<P>) -> Option<usize> {
    kept.iter().rposition(|(of, _)| Arc::ptr_eq(of, packed))
}
