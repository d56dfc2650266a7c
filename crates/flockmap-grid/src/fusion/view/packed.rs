//! A region of the fused map in which nothing changes, in a quarter of the bytes or less, as a rule.

use flockmap_coder::{BitReader, BitWriter};

use crate::changes::bounding_box;
use crate::fusion::region::{REGION_SIDE, Region, ViewBlock, bytes_of, indices, place_of};
use crate::packing::StatePacking;
use crate::unpacked::Packed;
use crate::{BlockIndex, Plane, StateBlock, VoxelBox, bit_of, set_bits, varint};

/// What a [`Region`] holds, exactly, and what is asked of a whole map. Kept in memory alone: its form is not promised to
/// anybody.
#[derive(Debug)]
pub(super) struct PackedRegion {
    /// By how much the version of each block is another one than that before, the first than that of the region. Then
    /// the states of those of which something is known, as bits of the coder.
    bytes: Box<[u8]>,
    places: Plane,
    /// Places of blocks of which nothing is known, if there are any.
    emptied: Option<Box<Plane>>,
    version: u64,
    bounding_box: Option<VoxelBox>,
    /// Free and Occupied voxels.
    counts: [u32; 2],
}

/// Bytes on the heap beside those of the bits: itself, and two counts of references.
const PACKED_BYTES: usize = size_of::<PackedRegion>() + 2 * size_of::<usize>();

impl PackedRegion {
    /// Packs a region that has a block. `at` is its own index. Some 7 µs for each block; the model learns anew in each
    /// region.
    pub(super) fn pack(at: BlockIndex, region: &Region) -> Self {
        let (mut bytes, mut emptied, mut counts) = (Vec::new(), Plane::default(), [0; 2]);
        put_versions(&mut bytes, region.version(), region.parts().iter().map(|block| block.version));
        let mut bits = BitWriter::new(&mut bytes);
        let mut packing = StatePacking::<REGION_SIDE>::new();
        for (place, block) in set_bits(region.places()).zip(region.parts()) {
            if block.states.is_empty() {
                emptied[place / 64] |= 1 << (place % 64);
                continue;
            }
            packing.block(&mut bits, bit_of(place).map(|at| at as usize), &block.states, |_, _, _| ());
            for (count, plane) in counts.iter_mut().zip([block.states.free(), block.states.occupied()]) {
                *count += plane.iter().map(|slice| slice.count_ones()).sum::<u32>();
            }
        }
        bits.finish();
        let blocks = indices(at, region.places()).zip(region.parts());
        Self {
            bytes: bytes.into_boxed_slice(),
            places: *region.places(),
            emptied: (emptied != Plane::default()).then(|| Box::new(emptied)),
            version: region.version(),
            bounding_box: bounding_box(blocks.map(|(index, block)| (index, block.states.known()))),
            counts,
        }
    }

    /// The same without the blocks of which nothing is known. O(blocks): states stay packed.
    pub(super) fn without_emptied(&self) -> Self {
        let (versions, states) = self.parts();
        let kept = set_bits(&self.places).zip(versions).filter(|(place, _)| !self.is_emptied(*place));
        let mut bytes = Vec::new();
        put_versions(&mut bytes, self.version, kept.map(|(_, version)| version));
        bytes.extend_from_slice(states);
        let emptied = self.emptied.as_deref().copied().unwrap_or_default();
        Self {
            bytes: bytes.into_boxed_slice(),
            places: core::array::from_fn(|z| self.places[z] & !emptied[z]),
            emptied: None,
            ..*self
        }
    }

    /// Of the block that changed last.
    pub(super) const fn version(&self) -> u64 {
        self.version
    }

    /// The blocks with the versions at which they changed last. O(blocks): states stay packed.
    pub(super) fn versions(&self, at: BlockIndex) -> Vec<(BlockIndex, u64)> {
        indices(at, &self.places).zip(self.parts().0).collect()
    }

    /// Number of blocks.
    pub(super) fn len(&self) -> usize {
        self.places.iter().map(|layer| layer.count_ones() as usize).sum()
    }

    /// Whether there is a block of which nothing is known.
    pub(super) const fn has_emptied(&self) -> bool {
        self.emptied.is_some()
    }

    /// Whether something is known of a block, which is in this region.
    pub(super) fn is_known(&self, index: BlockIndex) -> bool {
        let place = place_of(index);
        self.places[place / 64] >> (place % 64) & 1 == 1 && !self.is_emptied(place)
    }

    /// The smallest box that holds every known voxel.
    pub(super) const fn bounding_box(&self) -> Option<VoxelBox> {
        self.bounding_box
    }

    /// Number of Free and of Occupied voxels.
    pub(super) const fn counts(&self) -> [u32; 2] {
        self.counts
    }

    /// Bytes on the heap, itself included.
    pub(super) const fn memory_bytes(&self) -> usize {
        let emptied = if self.has_emptied() { size_of::<Plane>() } else { 0 };
        self.bytes.len() + emptied + PACKED_BYTES
    }

    fn is_emptied(&self, place: usize) -> bool {
        self.emptied.as_ref().is_some_and(|emptied| emptied[place / 64] >> (place % 64) & 1 == 1)
    }

    /// The versions of the blocks, and the bits of the states.
    fn parts(&self) -> (Vec<u64>, &[u8]) {
        let (mut bytes, mut version) = (&*self.bytes, self.version);
        let versions = (0..self.len()).map(|_| {
            version = version.wrapping_add(unfolded(varint::take(&mut bytes)) as u64);
            version
        });
        let versions = versions.collect();
        (versions, bytes)
    }
}

impl Packed for PackedRegion {
    type Open = Region;

    /// The region again, equal to the one that was packed. Some 7 µs for each block.
    fn unpack(&self) -> Region {
        let (versions, bits) = self.parts();
        let mut bits = BitReader::new(bits);
        let mut packing = StatePacking::<REGION_SIDE>::new();
        let mut blocks = Vec::with_capacity(self.len());
        blocks.extend(set_bits(&self.places).zip(versions).map(|(place, version)| {
            let states = if self.is_emptied(place) {
                StateBlock::default()
            } else {
                let at = bit_of(place).map(|at| at as usize);
                packing.block(&mut bits, at, &StateBlock::default(), |_, _, _| ())
            };
            ViewBlock { states, version }
        }));
        Region::from_parts(self.places, blocks, self.version)
    }

    fn open_bytes(&self) -> usize {
        bytes_of(self.len())
    }
}

/// Each as the difference to the one before, the first one to that of the region.
fn put_versions(bytes: &mut Vec<u8>, of_region: u64, versions: impl Iterator<Item = u64>) {
    let mut before = of_region;
    for version in versions {
        varint::put(bytes, folded(version.wrapping_sub(before) as i64));
        before = version;
    }
}

/// What is near 0, on both sides, as a small number.
const fn folded(number: i64) -> u64 {
    ((number << 1) ^ (number >> 63)) as u64
}

const fn unfolded(folded: u64) -> i64 {
    (folded >> 1) as i64 ^ -((folded & 1) as i64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::State;
    use proptest::prelude::*;

    fn region() -> impl Strategy<Value = Region> {
        let version = prop_oneof![8 => 0..400u64, 1 => any::<u64>()];
        let block = (any::<[u64; 3]>(), 0..4u8, version);
        prop::collection::btree_map(0..512usize, block, 1..60).prop_map(|blocks| {
            let mut region = Region::default();
            for (place, ([a, b, c], kind, version)) in blocks {
                let states = match kind {
                    0 => StateBlock::default(),
                    1 => StateBlock::new([a & b; 8], [c & !(a & b); 8]),
                    _ => StateBlock::new(
                        [u64::MAX, a, 0, a & b, 0, 0, 0, 0],
                        [0, 0, a & b & c, 0, 0, 0, b & c, 0],
                    ),
                };
                region.set(
                    indices(BlockIndex::new(0, 0, 0), &[u64::MAX; 8]).nth(place).unwrap(),
                    states,
                    version,
                );
            }
            region
        })
    }

    proptest! {
        #[test]
        fn what_is_unpacked_is_what_was_packed(mut region in region(), at in -5..5i32) {
            let at = BlockIndex::new(at, -at, 3);
            let packed = PackedRegion::pack(at, &region);
            prop_assert_eq!(&packed.unpack(), &region);
            prop_assert!(packed.unpack().memory_bytes() <= packed.open_bytes());
            let versions: Vec<_> = indices(at, region.places()).zip(region.parts().iter().map(|b| b.version)).collect();
            prop_assert_eq!(packed.versions(at), versions);
            prop_assert_eq!((packed.version(), packed.len()), (region.version(), region.parts().len()));
            prop_assert_eq!(packed.has_emptied(), region.has_emptied());
            for index in indices(at, &[u64::MAX; 8]) {
                prop_assert_eq!(packed.is_known(index), region.block(index).is_some_and(|b| !b.is_empty()));
            }
            let voxels = || region.parts().iter().flat_map(|b| (0..512).map(|bit| b.states.get(bit)));
            let counts = [State::Free, State::Occupied].map(|state| voxels().filter(|s| *s == state).count() as u32);
            prop_assert_eq!(packed.counts(), counts);
            let packed = packed.without_emptied();
            region.forget_emptied();
            prop_assert_eq!(&packed.unpack(), &region);
            prop_assert!(!packed.has_emptied());
        }
    }
}
