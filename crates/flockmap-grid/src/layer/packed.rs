//! A cube of a layer in which nothing changes, in a tenth of the bytes or less.

use flockmap_coder::{BitReader, BitWriter};

use super::block::LayerBlock;
use super::cube::{Cube, places};
use super::packing::{Packing, Voxels};
use super::stamps::BlockStamps;
use crate::unpacked::Packed;
use crate::{BLOCK_VOXELS, BlockIndex, Stamp, set_bits, varint};

/// What a [`Cube`] holds, exactly. Kept in memory alone: its form is not promised to anybody.
#[derive(Debug)]
pub(crate) struct PackedCube {
    /// The palette: how many stamps, the oldest, how much later each of the others is than the one before. Then
    /// the blocks as bits of the coder.
    bytes: Box<[u8]>,
    places: u64,
    /// No voxel is older, and none newer. The first of the palette once more, for who looks at many cubes.
    oldest: Stamp,
    newest: Stamp,
    open_bytes: u32,
}

/// Bytes on the heap beside those of the bits: itself, and two counts of references.
const PACKED_BYTES: usize = size_of::<PackedCube>() + 2 * size_of::<usize>();

impl PackedCube {
    /// Packs a cube that has a block. Some 15 µs for each block; the model learns anew in each cube.
    pub(super) fn pack(cube: &Cube) -> Self {
        let blocks = cube.parts();
        let mut palette: Vec<Stamp> = blocks.iter().map(|block| block.stamps.newest()).collect();
        for block in blocks {
            block.stamps.for_each_in_use(&block.states.known(), |stamp| palette.push(stamp));
        }
        palette.sort_unstable();
        palette.dedup();
        let mut bytes = Vec::new();
        put_palette(&mut bytes, &palette);
        let rank_of = |stamp: Stamp| palette.partition_point(|other| *other < stamp) as u16;
        let mut packing = Packing::new(BitWriter::new(&mut bytes));
        for (place, block) in places(cube.places()).zip(blocks) {
            let mut ranks = [0; BLOCK_VOXELS];
            let mut last = (Stamp(i64::MIN), 0);
            for bit in set_bits(&block.states.known()) {
                let stamp = block.stamps.get(bit);
                if stamp != last.0 {
                    last = (stamp, rank_of(stamp));
                }
                ranks[bit] = last.1;
            }
            let newest = rank_of(block.stamps.newest());
            packing.block(place, &Voxels { states: block.states, ranks, newest, before: block.before });
        }
        packing.into_bits().finish();
        Self {
            bytes: bytes.into_boxed_slice(),
            places: cube.places(),
            oldest: palette.first().copied().unwrap_or_default(),
            newest: palette.last().copied().unwrap_or_default(),
            open_bytes: cube.memory_bytes() as u32,
        }
    }

    /// Calls `found` with each stamp that a voxel has, once, and perhaps with others. O(stamps).
    pub(super) fn for_each_stamp(&self, found: impl FnMut(Stamp)) {
        take_palette(&self.bytes).0.into_iter().for_each(found);
    }

    /// Whether there is a block, which is in this cube.
    pub(super) fn has(&self, index: BlockIndex) -> bool {
        self.places >> super::cube::place_of(index) & 1 == 1
    }

    /// The newest stamp of all blocks.
    pub(super) const fn newest(&self) -> Stamp {
        self.newest
    }

    /// The oldest stamp of all blocks.
    pub(super) const fn oldest(&self) -> Stamp {
        self.oldest
    }

    /// Number of blocks.
    pub(super) const fn len(&self) -> usize {
        self.places.count_ones() as usize
    }

    /// Bytes on the heap, itself included.
    pub(super) const fn memory_bytes(&self) -> usize {
        self.bytes.len() + PACKED_BYTES
    }
}

impl Packed for PackedCube {
    type Open = Cube;

    /// The cube again: equal to the one that was packed, but for stamps in palettes that no voxel has. Some 15 µs
    /// for each block.
    fn unpack(&self) -> Cube {
        let (palette, bits) = take_palette(&self.bytes);
        let mut packing = Packing::new(BitReader::new(bits));
        // Of each stamp: for which block it has a number in its palette, and which.
        let mut numbers = vec![(0u32, 0u16); palette.len()];
        let stamp_of = |rank: u16| palette.get(usize::from(rank)).copied().unwrap_or_default();
        let blocks = (1..).zip(places(self.places)).map(|(count, place)| {
            let voxels = packing.block(place, &Voxels::default());
            let Voxels { states, ranks, newest, before } = voxels;
            let mut own = Vec::new();
            let mut renumbered = [0; BLOCK_VOXELS];
            for bit in set_bits(&states.known()) {
                let rank = ranks[bit];
                if let Some(number) = numbers.get_mut(usize::from(rank)) {
                    if number.0 != count {
                        *number = (count, own.len() as u16);
                        own.push(stamp_of(rank));
                    }
                    renumbered[bit] = number.1;
                }
            }
            if own.is_empty() {
                own.push(stamp_of(newest));
            }
            if own.len() == 1 {
                own.shrink_to_fit();
            }
            let stamps = BlockStamps::from_parts(own, &renumbered, stamp_of(newest));
            LayerBlock { states, stamps, before }
        });
        let mut blocks: Vec<LayerBlock> = blocks.collect();
        blocks.shrink_to_fit();
        Cube::from_parts(self.places, blocks)
    }

    fn open_bytes(&self) -> usize {
        self.open_bytes as usize
    }
}

fn put_palette(bytes: &mut Vec<u8>, palette: &[Stamp]) {
    varint::put(bytes, palette.len() as u64);
    let mut before = palette.first().copied().unwrap_or_default();
    bytes.extend_from_slice(&before.0.to_le_bytes());
    for stamp in palette.iter().skip(1) {
        varint::put(bytes, stamp.0.wrapping_sub(before.0) as u64);
        before = *stamp;
    }
}

/// The palette, and the bytes after it.
fn take_palette(mut bytes: &[u8]) -> (Vec<Stamp>, &[u8]) {
    let count = varint::take(&mut bytes);
    let (first, mut rest) = bytes.split_first_chunk().unwrap_or((&[0; 8], &[]));
    let mut stamp = i64::from_le_bytes(*first);
    let mut palette = vec![Stamp(stamp)];
    for _ in 1..count {
        stamp = stamp.wrapping_add(varint::take(&mut rest) as i64);
        palette.push(Stamp(stamp));
    }
    (palette, rest)
}
