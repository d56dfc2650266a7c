//! A box of 2-bit codes, one a byte: where the order of blocks meets the order of a codec.

use flockmap_grid::{BLOCK_SIDE, Changes, Plane, StateBlock, Voxel, VoxelBox};

use crate::pack::{FREE, OCCUPIED};

/// The codes of a box, x fastest, then y, then z (the order of the bits of a block). Keeps its memory between
/// uses: one byte for each voxel of the largest box so far.
#[derive(Default)]
pub(crate) struct CodeGrid {
    codes: Vec<u8>,
}

impl CodeGrid {
    /// All codes of the box as [`Self::fill`] or [`Self::clear`] set it up.
    pub(crate) fn codes(&self) -> &[u8] {
        &self.codes
    }

    /// All codes, to be written.
    pub(crate) fn codes_mut(&mut self) -> &mut [u8] {
        &mut self.codes
    }

    /// `volume` codes, all `background`.
    pub(crate) fn clear(&mut self, volume: usize, background: u8) {
        self.codes.clear();
        self.codes.resize(volume, background);
    }

    /// The codes of `states`, all inside `region`; `background` for the voxels that are in no state.
    pub(crate) fn fill(&mut self, states: &Changes, region: &VoxelBox, background: u8) {
        self.clear(region.volume() as usize, background);
        for (index, block) in states.blocks() {
            let corner = index.corner();
            let known = block.known();
            for z in 0..8 {
                let mut rows = known[z];
                while rows != 0 {
                    let y = rows.trailing_zeros() as usize / 8;
                    let row = |plane: &Plane| (plane[z] >> (8 * y)) as u8;
                    let (known, occupied) = (row(&known), row(block.occupied()));
                    rows &= !(0xff << (8 * y));
                    let first = known.trailing_zeros() as i32;
                    let start = Voxel::new(corner.x + first, corner.y + y as i32, corner.z + z as i32);
                    let start = place(region, start);
                    let Some(codes) = self.codes.get_mut(start..) else { continue };
                    let (mut known, mut occupied) = (known >> first, occupied >> first);
                    for code in codes.iter_mut().take(8) {
                        if known == 0 {
                            break;
                        }
                        if known & 1 != 0 {
                            *code = if occupied & 1 != 0 { OCCUPIED } else { FREE };
                        }
                        known >>= 1;
                        occupied >>= 1;
                    }
                }
            }
        }
    }

    /// The states that the codes say; `None` if a code is neither Free, Occupied nor `background`.
    pub(crate) fn states(&self, region: &VoxelBox, background: u8) -> Option<Changes> {
        let background_row = u64::from_le_bytes([background; 8]);
        let mut blocks = Vec::new();
        for index in region.blocks() {
            let Some(part) = index.voxel_box().intersection(region) else { continue };
            let (low, corner) = (part.min(), index.corner());
            let [width, depth, height] = part.size();
            let (mut free, mut occupied): (Plane, Plane) = ([0; 8], [0; 8]);
            for dz in 0..height as i32 {
                for dy in 0..depth as i32 {
                    let start = place(region, Voxel::new(low.x, low.y + dy, low.z + dz));
                    let row = self.codes.get(start..start + width as usize)?;
                    let row = match row.first_chunk::<8>() {
                        Some(row) => u64::from_le_bytes(*row),
                        None => {
                            let mut padded = [background; 8];
                            padded.iter_mut().zip(row).for_each(|(to, code)| *to = *code);
                            u64::from_le_bytes(padded)
                        }
                    };
                    if row == background_row {
                        continue;
                    }
                    let is = |code: u8| lowest_bits(zero_bytes(row ^ u64::from_le_bytes([code; 8])));
                    let (is_free, is_occupied) = (is(FREE), is(OCCUPIED));
                    if is_free | is_occupied | is(background) != 0xff {
                        return None;
                    }
                    let z = (low.z + dz - corner.z) as usize;
                    let shift = 8 * (low.y + dy - corner.y) + (low.x - corner.x);
                    free[z] |= u64::from(is_free) << shift;
                    occupied[z] |= u64::from(is_occupied) << shift;
                }
            }
            let block = StateBlock::new(free, occupied);
            if !block.is_empty() {
                blocks.push((index, block));
            }
        }
        Some(Changes::from_blocks(blocks))
    }
}

/// The place of a voxel of `region` among its codes.
fn place(region: &VoxelBox, voxel: Voxel) -> usize {
    let (min, size) = (region.min(), region.size().map(|s| s as usize));
    let [x, y, z] = [voxel.x - min.x, voxel.y - min.y, voxel.z - min.z].map(|d| d as usize);
    (z * size[1] + y) * size[0] + x
}

/// The columns along z of a box in nested order (x slowest, z fastest): the first linear index of each.
/// Within a column the indices are `size[0] * size[1]` apart.
pub(crate) fn nested_columns(size: [usize; 3]) -> impl Iterator<Item = usize> {
    (0..size[0]).flat_map(move |x| (0..size[1]).map(move |y| y * size[0] + x))
}

/// 1 in the lowest bit of each byte of `word` that is zero. Bytes must be below 4, as codes are.
const fn zero_bytes(word: u64) -> u64 {
    !(word | word >> 1) & 0x0101_0101_0101_0101
}

/// Bit k of the result is the lowest bit of byte k.
const fn lowest_bits(bytes: u64) -> u8 {
    (bytes.wrapping_mul(0x0102_0408_1020_4080) >> 56) as u8
}

const _: () = assert!(BLOCK_SIDE == 8);
