//! The cubes that were unpacked last, for who reads them again.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError};

use super::cube::Cube;
use super::packed::PackedCube;

/// Most cubes that are kept: what lies around a robot that changes little of it is read with every batch.
const CUBES_MAX: usize = 64;
/// Most bytes that cubes of layers take which are kept unpacked for who reads them: in a robot, and in each snapshot
/// that is being received. (One cube takes 0.6 MB at most.)
pub const UNPACKED_BYTES_MAX: usize = 2 << 20;

/// Cubes of any number of layers, those that were read last at the end. What is packed does not change, so that it is
/// known by where it lies.
#[derive(Debug, Default)]
pub(crate) struct Unpacked(Mutex<Kept>);

type Kept = Vec<(Arc<PackedCube>, Arc<Cube>)>;

impl Unpacked {
    /// A cube to be read. O(blocks of it) if it was not read lately.
    pub(super) fn cube(&self, packed: &Arc<PackedCube>) -> Arc<Cube> {
        let Some(mut kept) = self.kept() else { return Arc::new(packed.unpack()) };
        if let Some(at) = position(&kept, packed) {
            kept[at..].rotate_left(1);
            return kept.last().map_or_else(|| Arc::new(packed.unpack()), |(_, cube)| Arc::clone(cube));
        }
        let cube = Arc::new(packed.unpack());
        let mut bytes = packed.open_bytes();
        let fits = kept.iter().rev().take(CUBES_MAX - 1).take_while(|(of, _)| {
            bytes += of.open_bytes();
            bytes <= UNPACKED_BYTES_MAX
        });
        let gone = kept.len() - fits.count();
        kept.drain(..gone);
        kept.push((Arc::clone(packed), Arc::clone(&cube)));
        cube
    }

    /// A cube to be changed, which is not read as it was any more.
    pub(super) fn take(&self, packed: &Arc<PackedCube>) -> Cube {
        let found = self.kept().and_then(|mut kept| {
            let at = position(&kept, packed)?;
            Some(kept.remove(at).1)
        });
        found.map_or_else(|| packed.unpack(), Arc::unwrap_or_clone)
    }

    /// `None` while another thread reads a copy of a layer.
    fn kept(&self) -> Option<MutexGuard<'_, Kept>> {
        match self.0.try_lock() {
            Ok(kept) => Some(kept),
            Err(TryLockError::Poisoned(kept)) => Some(PoisonError::into_inner(kept)),
            Err(TryLockError::WouldBlock) => None,
        }
    }
}

fn position(kept: &[(Arc<PackedCube>, Arc<Cube>)], packed: &Arc<PackedCube>) -> Option<usize> {
    kept.iter().rposition(|(of, _)| Arc::ptr_eq(of, packed))
}
