//! What of a layer is open, and what is packed.

use std::sync::Arc;

use super::packed::PackedCube;
use super::{Layer, OPEN_BYTES, Open, Place};
use crate::BlockIndex;

/// When blocks were changed so often, it is looked whether some lie cold.
const LOOKED_EVERY: u64 = 256;
/// Blocks that are packed then.
const PACKED_AT_ONCE: usize = 256;
/// A cube is cold to which nothing was applied while blocks were changed four times as often as there are open ones,
/// but between these. So what is changed all the time stays open, however large it is, and what a robot has left
/// behind is packed within half a minute as a rule.
const COLD: [u64; 2] = [32_768, 131_072];

impl Layer {
    /// The cube at a place of the table to write to, unpacked if need be.
    pub(super) fn open(&mut self, at: BlockIndex) -> &mut Open {
        let place = self.cubes.entry(at).or_insert_with(|| {
            self.dropped.note_there(at);
            self.open_bytes += OPEN_BYTES;
            self.queue.push_back((self.changed, at));
            Place::Open(Arc::default())
        });
        if let Place::Packed(packed) = place {
            let cube = self.unpacked.take(packed);
            self.packed_bytes -= packed.memory_bytes();
            self.left_in_copies += place.bytes_in_copies();
            self.open_bytes += OPEN_BYTES + cube.memory_bytes();
            self.open += cube.len();
            self.queue.push_back((self.changed, at));
            *place = Place::Open(Arc::new(Open { cube, touched: 0 }));
        }
        self.left_in_copies += place.bytes_in_copies();
        match place {
            Place::Open(open) => Arc::make_mut(open),
            Place::Packed(_) => unreachable!("it was unpacked"),
        }
    }

    /// Notes that blocks were changed, and packs some of those that lie cold now and then, about 15 µs for each: more
    /// of them where they have lain cold for long.
    pub(super) fn note_changed(&mut self, blocks: usize) {
        let before = self.changed;
        self.changed += blocks as u64;
        if self.changed / LOOKED_EVERY > before / LOOKED_EVERY {
            let cold = (4 * self.open as u64).clamp(COLD[0], COLD[1]);
            let is_behind = self.queue.front().is_some_and(|(noted, _)| noted + 2 * cold < self.changed);
            self.pack_cold(cold, if is_behind { 2 * PACKED_AT_ONCE } else { PACKED_AT_ONCE });
        }
    }

    /// Packs cubes to which nothing was applied by the last `cold` changes of blocks, the longest ago first, until
    /// `blocks_max` blocks are packed. Returns how many blocks it has packed.
    fn pack_cold(&mut self, cold: u64, blocks_max: usize) -> usize {
        let limit = self.changed.saturating_sub(cold);
        let mut packed = 0;
        while packed < blocks_max
            && let Some((_, at)) = self.queue.pop_front_if(|(noted, _)| *noted < limit)
        {
            match self.cubes.get(&at) {
                Some(Place::Open(open)) if open.touched >= limit => self.queue.push_back((open.touched, at)),
                _ => packed += self.pack_cube(at),
            }
        }
        packed
    }

    /// Packs all that is open. O(open blocks).
    pub fn pack(&mut self) {
        self.pack_cold(0, usize::MAX);
    }

    /// Packs whole cubes until `blocks_max` blocks are packed, but none to which something was applied by the last
    /// `cold` changes of blocks: what is written to all the time would be open again at once. Returns how many blocks
    /// it has packed, some 15 µs each.
    pub(crate) fn make_room(&mut self, cold: u64, blocks_max: usize) -> usize {
        self.pack_cold(cold, blocks_max)
    }

    /// How often blocks were changed.
    pub(crate) const fn changed(&self) -> u64 {
        self.changed
    }

    /// Whether nothing is open.
    pub(crate) fn is_packed(&self) -> bool {
        self.queue.is_empty()
    }

    /// Packs an open cube. Returns the number of its blocks.
    fn pack_cube(&mut self, at: BlockIndex) -> usize {
        let Some(place) = self.cubes.get_mut(&at) else { return 0 };
        let Place::Open(open) = place else { return 0 };
        let (blocks, bytes) = (open.cube.len(), OPEN_BYTES + open.cube.memory_bytes());
        let packed = PackedCube::pack(&open.cube);
        self.left_in_copies += place.bytes_in_copies();
        self.open_bytes -= bytes;
        self.open -= blocks;
        self.packed_bytes += packed.memory_bytes();
        *place = Place::Packed(Arc::new(packed));
        blocks
    }
}
