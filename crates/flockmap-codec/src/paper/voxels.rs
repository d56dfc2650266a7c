//! The voxels that a box of codes sets: found group by group, so that what says nothing costs next to
//! nothing.

use flockmap_grid::{Changes, StateBlock, VoxelBox};

use super::blocks::Blocks;
use super::codes::{Codes, FREE, GROUP_BYTES, OCCUPIED, PER_BYTE};
use super::hilbert::{Leaf, Pick, Places, walk_some};
use crate::codec::Codec;
use crate::error::PackageError;
use crate::work::Work;

/// The voxels of `codes`, in the order of a codec: that of the paper along the Hilbert walk, the others
/// nested.
pub(crate) fn voxels(
    codec: Codec,
    codes: Codes<'_>,
    region: &VoxelBox,
    work: &mut Work,
    rule: &'static str,
) -> Result<Changes, PackageError> {
    work.take(codes.steps())?;
    let size = region.size().map(|side| side as usize);
    let wrong = PackageError::Payload { codec, rule };
    let mut found = Found { blocks: Blocks::new(region, work), wrong };
    if codec == Codec::Paper {
        let groups: Vec<usize> = codes.groups().map(|(first, _)| first * PER_BYTE).collect();
        walk_some(size, &mut Walk { codes, groups: &groups, places: Places::of(size), found: &mut found });
    } else {
        let [_, depth, height] = size.map(|side| side as u32);
        for (byte, at) in codes.groups().flat_map(|(first, group)| group.iter().zip(first..)) {
            if *byte == codes.nothing {
                continue;
            }
            // A box has at most 2²⁷ voxels.
            let first = (at * PER_BYTE) as u32;
            let (mut xy, mut z) = (first / height, first % height);
            for at in 0..PER_BYTE {
                let code = byte >> (2 * at) & 3;
                if code != codes.nothing & 3 {
                    found.set([xy / depth, xy % depth, z].map(|at| at as i32), code);
                }
                z += 1;
                if z == height {
                    (xy, z) = (xy + 1, 0);
                }
            }
        }
    }
    let blocks = found.blocks.finish()?.into_iter();
    Ok(Changes::from_blocks(
        blocks.map(|((_, index), [free, occupied])| (index, StateBlock::new(free, occupied))).collect(),
    ))
}

/// What was found.
struct Found<'w> {
    blocks: Blocks<'w, ()>,
    /// What codes that are no states are refused with.
    wrong: PackageError,
}

impl Found<'_> {
    /// `place` is in the box.
    #[inline]
    fn set(&mut self, place: [i32; 3], code: u8) {
        let Some((planes, bit)) = self.blocks.at((), place) else { return };
        let plane = match code {
            FREE => 0,
            OCCUPIED => 1,
            _ => {
                self.blocks.fault.get_or_insert_with(|| self.wrong.clone());
                return;
            }
        };
        planes[plane][bit >> 6 & 7] |= 1 << (bit & 63);
    }
}

/// Voxels with a code, along the Hilbert walk.
struct Walk<'a, 'b, 'w> {
    codes: Codes<'a>,
    /// The first code of each group that sets a voxel, from the one that comes next.
    groups: &'a [usize],
    places: Places,
    found: &'b mut Found<'w>,
}

impl Pick for Walk<'_, '_, '_> {
    #[inline]
    fn next(&mut self, step: usize) -> usize {
        while let Some((first, later)) = self.groups.split_first() {
            if first + GROUP_BYTES * PER_BYTE > step {
                return if self.found.blocks.fault.is_some() { usize::MAX } else { *first.max(&step) };
            }
            self.groups = later;
        }
        usize::MAX
    }

    fn leaf(&mut self, step: usize, leaf: &Leaf<'_>) {
        let Codes { packed, nothing } = self.codes;
        let (mut at, end) = (step, step + leaf.len());
        while at < end {
            let bytes = packed.get(at / PER_BYTE..).unwrap_or_default();
            // Eight bytes that set nothing, or one.
            if bytes.first_chunk::<8>().is_some_and(|bytes| *bytes == [nothing; 8]) {
                at = (at / PER_BYTE + 8) * PER_BYTE;
                continue;
            }
            let byte = bytes.first().copied().unwrap_or(nothing);
            let next = ((at / PER_BYTE + 1) * PER_BYTE).min(end);
            if byte != nothing {
                for at in at..next {
                    let code = byte >> (2 * (at % PER_BYTE)) & 3;
                    if code != nothing & 3 {
                        self.found.set(self.places.place(leaf.voxel(at - step)), code);
                    }
                }
            }
            at = next;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::paper::codes::{UNCHANGED, UNKNOWN, pack};
    use crate::paper::hilbert::hilbert_order;
    use flockmap_grid::{State, Voxel};
    use proptest::prelude::*;

    /// The codes of a box in some order of its voxels, most of them `background`.
    fn draw(volume: usize, background: u8, one_of: u64, seed: u64) -> Vec<u8> {
        let mut random = seed | 1;
        let mut next = || {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            random >> 33
        };
        (0..volume)
            .map(|_| match next() % one_of {
                0 => (next() % 2) as u8,
                _ => background,
            })
            .collect()
    }

    proptest! {
        #[test]
        fn what_is_found_is_what_going_through_all_voxels_finds(
            size in prop_oneof![prop::array::uniform3(1..30u32), (1..4_000u32, 1..3u32, 1..3u32).prop_map(|(x, y, z)| [y, z, x])],
            corner in prop::array::uniform3(-40..40i32),
            is_snapshot: bool,
            one_of in prop_oneof![Just(1u64), Just(2), Just(40), Just(3_000)],
            seed: u64,
        ) {
            let region = VoxelBox::new(Voxel::new(corner[0], corner[1], corner[2]), size).unwrap();
            let background = if is_snapshot { UNKNOWN } else { UNCHANGED };
            let list = draw(region.volume() as usize, background, one_of, seed);
            let mut packed = Vec::new();
            pack(&list, &mut packed);
            if !list.len().is_multiple_of(4) {
                *packed.last_mut().unwrap() |= (background * 0x55) << (2 * (list.len() % 4));
            }
            let nested = (0..size[0]).flat_map(|x| (0..size[1]).flat_map(move |y| (0..size[2]).map(move |z| [x, y, z])));
            for (codec, order) in [(Codec::Paper, hilbert_order(size)), (Codec::NestedZlib, nested.collect())] {
                let voxels = order.iter().zip(&list).filter(|(_, code)| **code != background);
                let voxels = voxels.map(|(at, code)| {
                    let [x, y, z] = [0, 1, 2].map(|axis| corner[axis] + at[axis] as i32);
                    (Voxel::new(x, y, z), if *code == OCCUPIED { State::Occupied } else { State::Free })
                });
                let expected = Changes::from_voxels(voxels);
                let mut work = Work::new(codec, 1 << 20);
                let codes = Codes::new(&packed, background);
                let found = super::voxels(codec, codes, &region, &mut work, "none");
                prop_assert_eq!(found.as_ref(), Ok(&expected));

                let is_known = |codes: &&[u8]| codes.iter().any(|code| *code != background);
                let groups = list.chunks(512).filter(is_known).count();
                let bytes = list.chunks(4).filter(is_known).count();
                let steps = 128 * groups + 12 * bytes + 128 * expected.blocks().len();
                prop_assert_eq!(work.taken(), steps as u64);
            }
        }
    }

    #[test]
    fn a_code_that_is_no_state_is_refused() {
        let region = VoxelBox::new(Voxel::new(0, 0, 0), [4, 4, 4]).unwrap();
        let mut packed = [0xff; 16];
        packed[7] = 0xfe;
        for codec in [Codec::Raw, Codec::Paper] {
            let mut work = Work::new(codec, 1_000);
            let found = voxels(codec, Codes::new(&packed, UNCHANGED), &region, &mut work, "a rule");
            assert_eq!(found, Err(PackageError::Payload { codec, rule: "a rule" }));
        }
    }
}
