//! What the tiles of a present state said so far.

use flockmap_grid::{Layer, PresentState};

use crate::check::check_present;
use crate::work::{self, Work};
use crate::{Codec, ContentKind, Decoder, Package, PackageError, flock};

/// The tiles of one set that have been read, from the first on. In [`Codec::Flock`] each tile is told against those before it;
/// in the other codecs each can be read alone. Holds as much as a [`Layer`] of what was read.
#[derive(Clone, Debug, Default)]
pub struct TilesRead {
    told: Layer,
    next: u32,
}

impl TilesRead {
    /// The number of the tile that can be read now.
    pub const fn next(&self) -> u32 {
        self.next
    }

    /// Blocks told of so far.
    pub fn block_count(&self) -> usize {
        self.told.block_count()
    }

    /// Bytes that it holds. O(1).
    pub fn memory_bytes(&self) -> usize {
        self.told.memory_bytes()
    }

    /// Bytes that it may hold at most while and after this tile is read, beside the stamps of the voxels of the tile: it adds at most as many
    /// blocks as its bytes may ask for. O(1).
    pub fn memory_bytes_with(&self, tile: &Package) -> usize {
        let blocks = work::limit(tile.payload().len()) / work::BLOCK_STEPS;
        self.told.memory_bytes_with(usize::try_from(blocks).unwrap_or(usize::MAX))
    }
}

impl Decoder {
    /// The content of a tile of [`Codec::Flock`] that continues those read before; it then counts among them.
    ///
    /// # Errors
    /// [`PackageError::TileMissing`] if it is not the tile that comes next; then nothing has changed. After any other error
    /// `before` is as if nothing had been read: what the tiles said is safe, but all of them are needed again to go on.
    pub fn decode_tile(
        &mut self,
        package: &Package,
        before: &mut TilesRead,
    ) -> Result<PresentState, PackageError> {
        let header = package.header();
        let ContentKind::Present { tile, .. } = header.content else {
            return Err(PackageError::Header { rule: "a tile is of a present state" });
        };
        if tile != before.next || header.codec != Codec::Flock {
            return Err(PackageError::TileMissing { tile: before.next });
        }
        let TilesRead { mut told, next } = core::mem::take(before);
        let ends = [header.cycle_start, header.cycle_end];
        let payload = package.payload();
        let mut work = Work::new(header.codec, payload.len());
        let state =
            flock::present::decode(&mut self.flock, &mut told, payload, &header.region, ends, &mut work);
        self.note_steps(work.taken());
        let state = state?;
        let found = check_present(&package.checked(), &state);
        if found != package.check() {
            return Err(PackageError::Check { stated: package.check(), found });
        }
        *before = TilesRead { told, next: next.saturating_add(1) };
        Ok(state)
    }
}
