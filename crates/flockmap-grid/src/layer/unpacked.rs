//! The cubes that were unpacked last, for who reads them again.

use std::sync::{Arc, Mutex, TryLockError};

use super::cube::Cube;
use super::packed::PackedCube;

/// Most cubes that are kept: a block and its neighbours lie in eight.
const CUBES_MAX: usize = 8;
/// Most bytes that cubes of layers take which are kept unpacked for who reads them: in a robot, and in each snapshot
/// that is being received. (One cube takes 0.6 MB at most.)
pub const UNPACKED_BYTES_MAX: usize = 1 << 20;

/// Cubes of any number of layers. What is packed does not change, so that it is known by where it lies.
#[derive(Debug, Default)]
pub(crate) struct Unpacked(Mutex<Vec<(Arc<PackedCube>, Arc<Cube>)>>);

impl Unpacked {
    /// A cube to be read. O(blocks of it) if it was not read lately.
    pub(super) fn cube(&self, packed: &Arc<PackedCube>) -> Arc<Cube> {
        let mut kept = match self.0.try_lock() {
            Ok(kept) => kept,
            Err(TryLockError::Poisoned(kept)) => kept.into_inner(),
            // Another thread reads a copy of a layer.
            Err(TryLockError::WouldBlock) => return Arc::new(packed.unpack()),
        };
        if let Some(at) = kept.iter().position(|(of, _)| Arc::ptr_eq(of, packed)) {
            kept[at..].rotate_left(1);
        } else {
            let cube = Arc::new(packed.unpack());
            let mut bytes = packed.open_bytes();
            // The newest come last.
            let fits = kept.iter().rev().take(CUBES_MAX - 1).take_while(|(of, _)| {
                bytes += of.open_bytes();
                bytes <= UNPACKED_BYTES_MAX
            });
            let stay = fits.count();
            let gone = kept.len() - stay;
            kept.drain(..gone);
            kept.push((Arc::clone(packed), cube));
        }
        kept.last().map_or_else(|| Arc::new(packed.unpack()), |(_, cube)| Arc::clone(cube))
    }
}
