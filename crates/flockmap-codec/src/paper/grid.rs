//! A box of 2-bit codes, one a byte: where the order of blocks meets the order of a codec.

use flockmap_grid::{Changes, Plane, Voxel, VoxelBox};

use super::codes::{FREE, OCCUPIED};

/// The codes of a box, x fastest, then y, then z (the order of the bits of a block). Keeps its memory between
/// uses: one byte for each voxel of the largest box so far.
#[derive(Default)]
pub(crate) struct CodeGrid {
    codes: Vec<u8>,
}

impl CodeGrid {
    /// All codes of the box as [`Self::fill`] set them up.
    pub(crate) fn codes(&self) -> &[u8] {
        &self.codes
    }

    /// The codes of `states`, all inside `region`; `background` for the voxels that are in no state.
    pub(crate) fn fill(&mut self, states: &Changes, region: &VoxelBox, background: u8) {
        self.codes.clear();
        self.codes.resize(region.volume() as usize, background);
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
}

/// The place of a voxel of `region` among its codes.
pub(crate) fn place(region: &VoxelBox, voxel: Voxel) -> usize {
    let (min, size) = (region.min(), region.size().map(|s| s as usize));
    let [x, y, z] = [voxel.x - min.x, voxel.y - min.y, voxel.z - min.z].map(|d| d as usize);
    (z * size[1] + y) * size[0] + x
}

/// The columns along z of a box in nested order (x slowest, z fastest): the first linear index of each.
/// Within a column the indices are `size[0] * size[1]` apart.
pub(crate) fn nested_columns(size: [usize; 3]) -> impl Iterator<Item = usize> {
    (0..size[0]).flat_map(move |x| (0..size[1]).map(move |y| y * size[0] + x))
}
